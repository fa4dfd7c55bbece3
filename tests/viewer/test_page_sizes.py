"""Nothing is cut off in any panel, at any size of window that people have."""

from collections.abc import Callable

import pytest
from cut_off import cut_off
from viewer_tab import Tab

from carts_viewer import intents
from carts_viewer.app import ViewerApp

pytestmark = pytest.mark.browser

TABS = ("Optimize", "Review", "Values", "Jobs", "Live", "Export", "Help")


@pytest.mark.parametrize("window", [(1280, 800), (1920, 1080)])
def test_no_number_table_or_label_is_cut_off_in_any_tab(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab], window: tuple[int, int]
) -> None:
    app = open_viewer(cameras=("left", "right"), domains=("regular", "smoke"), width=160, height=120)
    tab = open_tab(app, window)
    tab.place_in_viewer.put(intents.Perturb(2.0, 0))
    tab.place_in_viewer.put(intents.SetRange((0, 1)))
    app.wait_until_shown()
    for folder in ("Free parameters", "Find", "Masks of others", "Paint"):
        for fold in tab.page.get_by_text(folder, exact=True).all():
            if fold.is_visible():
                fold.click()
    found = {}
    for name in TABS:
        tab.page.get_by_role("tab", name=name, exact=True).click()
        tab.page.wait_for_timeout(150)
        found[name] = cut_off(tab.page)
    assert found == {name: [] for name in TABS}


def test_what_is_cut_off_is_found(open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]) -> None:
    tab = open_tab(open_viewer())
    tab.page.add_style_tag(content=".mantine-Slider-root + .mantine-NumberInput-root { width: 1.2rem !important }")
    tab.page.add_style_tag(content=".carts-caption { white-space: nowrap !important }")
    found = cut_off(tab.page)
    assert any("INPUT" in line and "too narrow" in line for line in found)
    assert any("outside of" in line for line in found)
