"""Nothing is cut off in any panel, at any size of window that people have."""

from collections.abc import Callable

import pytest
from cut_off import cut_off
from viewer_canvas import eventually
from viewer_tab import Tab

from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp

pytestmark = pytest.mark.browser

TABS = ("Optimize", "Review", "Values", "Jobs", "Live", "Export", "Help")
FOLDERS = {"Optimize": ("Free parameters",), "Review": ("Find", "Masks of others")}
"""What is folded at first, by the tab that it lies in."""


@pytest.mark.parametrize("window", [(1280, 800), pytest.param((1920, 1080), marks=pytest.mark.slow), (390, 844)])
def test_no_number_table_or_label_is_cut_off_in_any_tab(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab], window: tuple[int, int]
) -> None:
    app = open_viewer(cameras=("left", "right"), domains=("regular", "smoke"), width=160, height=120)
    tab = open_tab(app, window)
    tab.place_in_viewer.put(intents.Perturb(2.0, 0))
    tab.place_in_viewer.put(intents.SetRange((0, 1)))
    app.wait_until_shown()
    if window[0] < 600:
        # On a phone all panels are one sheet below the picture, which makes room for it; the tabs are above the rest.
        tab.page.get_by_role("button", name="All controls").click()
        tab.page.get_by_text("Optimize · Review").click()

        def image_above_sheet() -> bool:
            sheet = tab.page.get_by_role("tab", name="Review", exact=True).bounding_box()
            canvas, image = tab.page.locator("canvas").first.bounding_box(), tab.page.evaluate("carts.imageOnScreen()")
            assert sheet is not None and canvas is not None
            return canvas["y"] + image["top"] + image["height"] < sheet["y"] < window[1] / 2

        eventually(image_above_sheet, bool)
    tab.place_in_viewer.put(intents.Export("csv", "All"))
    tab.page.get_by_text("Paint", exact=True).first.click()
    found = {}
    for name in TABS:
        tab.page.get_by_role("tab", name=name, exact=True).click()
        for folder in FOLDERS.get(name, ()):
            tab.page.get_by_text(folder, exact=True).click()
        found[name] = eventually(lambda: cut_off(tab.page), lambda cut: not cut)
    assert found == {name: [] for name in TABS}


@pytest.mark.parametrize("window", [pytest.param((1280, 800), marks=pytest.mark.slow), (390, 844)])
def test_the_curves_of_a_run_leave_the_panel_as_wide_as_it_is(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab], window: tuple[int, int]
) -> None:
    app = open_viewer(cameras=("left", "right"))
    tab = open_tab(app, window)
    if window[0] < 600:
        tab.page.get_by_role("button", name="All controls").click()
        tab.page.get_by_text("Optimize · Review").click()
    tab.place_in_viewer.put(intents.Run())
    eventually(lambda: tab.state.verdict, bool, timeout=120)
    tab.page.locator(".uplot").first.wait_for(state="visible")
    eventually(lambda: cut_off(tab.page), lambda cut: not cut)


def test_what_is_cut_off_is_found(open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]) -> None:
    tab = open_tab(open_viewer())
    tab.page.add_style_tag(content=".mantine-Slider-root + .mantine-NumberInput-root { width: 1.2rem !important }")
    tab.page.add_style_tag(content=".carts-caption { white-space: nowrap !important }")
    found = cut_off(tab.page)
    assert any("INPUT" in line and "too narrow" in line for line in found)
    assert any("outside of" in line for line in found)
