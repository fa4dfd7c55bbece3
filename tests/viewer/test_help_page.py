"""What the page says of itself: tooltips, and the tour."""

from collections.abc import Callable

import pytest
from playwright.sync_api import expect
from viewer_canvas import eventually
from viewer_tab import Tab

from carts_viewer.app import ViewerApp
from carts_viewer.panels.help import HINTS, explain

pytestmark = pytest.mark.browser

SCROLLED = "[...document.querySelectorAll('.mantine-ScrollArea-viewport')].map((one) => one.scrollTop)"


@pytest.mark.parametrize("masks", [True, False])
def test_every_number_key_chooses_the_layer_that_the_sheet_of_keys_says(
    masks: bool, open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    tab = open_tab(open_viewer(masks=masks, width=160, height=120))
    tab.page.keyboard.press("?")
    rows = tab.page.locator(".carts-sheet tr").filter(has_text="Overlay: ").all_inner_texts()
    tab.page.keyboard.press("Escape")
    assert [row.split()[0] for row in rows] == list("123456789")
    for key, _, *name in (row.split() for row in rows):
        tab.page.keyboard.press(key)
        eventually(lambda: str(tab.state.layer).lower(), lambda layer, name=name: layer == " ".join(name))
        expect(tab.page.locator(f"[id='{tab.app.page.element_id(tab.find('Layer'))}']")).to_have_value(tab.state.layer)


def test_every_control_says_what_it_does_when_the_pointer_rests_on_it(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(cameras=("left", "right"), domains=("regular", "smoke"), width=160, height=120)
    tab = open_tab(app)
    view = tab.place_in_viewer.view
    assert view is not None
    assert len(view.page.widgets()) > 120 and explain(view.page) == []
    # It is seen over buttons, also greyed out, and over labels and fields; of a joint with its unit and limits.
    joint = view.layout.joints.slider("PSM1", 0)
    assert joint.hint is not None and "[°], limits" in joint.hint
    for name in ("Run", "Pause", "Accept + next", "Export mask"):
        if name == "Accept + next":
            tab.page.get_by_role("tab", name="Review", exact=True).click()
        if name == "Export mask":
            tab.page.get_by_role("tab", name="Export", exact=True).click()
        tab.page.mouse.move(640, 5)
        tab.page.get_by_role("button", name=name, exact=True).hover(force=True)
        expect(tab.page.get_by_role("button", name=name, exact=True)).to_have_attribute("title", HINTS[name])
    for handle in (joint, view.page.find("Seed"), view.page.find("Layer")):
        element = app.page.element_id(handle)
        expect(tab.page.locator(f"label[for='{element}']")).to_have_attribute("title", str(handle.hint))
        tab.page.locator(f"[id='{element}']").first.hover(force=True)
        expect(tab.page.get_by_role("tooltip").filter(has_text=str(handle.hint))).to_be_visible()
        tab.page.mouse.move(640, 5)
    # Our own buttons and bars have titles, too.
    bare = "button:not([title]):not([aria-label]), select:not([title])"
    for bar in (".carts-bar", ".carts-strip"):
        assert tab.page.locator(bar).locator(bare).count() == 0


def test_the_tour_is_offered_once_goes_over_the_page_and_can_be_left_at_any_time(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    tab = open_tab(open_viewer(width=160, height=120), new=True)
    # It stays until it is answered, and the next visit knows nothing else; somebody who does not want it has answered.
    stored = "localStorage.getItem('carts-tour')"
    expect(tab.page.locator(".carts-offer")).to_be_visible()
    assert tab.page.evaluate(stored) is None
    tab.page.get_by_role("button", name="No tour").click()
    expect(tab.page.locator(".carts-offer")).to_have_count(0)
    assert tab.page.evaluate(stored) == "declined"
    # Nor is somebody who does not want it asked again.
    tab.page.reload()
    tab.wait_until_ready()
    tab.page.wait_for_timeout(2500)
    expect(tab.page.locator(".carts-offer")).to_have_count(0)
    tab.page.evaluate("localStorage.removeItem('carts-tour')")
    # What it speaks of is in view, whatever was unfolded before.
    tab.page.reload()
    tab.wait_until_ready()
    tab.page.get_by_text("Paint", exact=True).click()
    expect(tab.page.get_by_role("button", name="Polygon", exact=True)).to_be_visible()
    before = tab.page.evaluate(SCROLLED)
    tab.page.get_by_role("button", name="Take the tour").click()
    card, frame = tab.page.get_by_role("dialog", name="Tour"), tab.page.locator(".carts-tour-frame")
    seen = []
    while card.count():
        title = card.locator("b").inner_text()
        box = card.bounding_box()
        assert box is not None and box["x"] >= 0 and box["y"] >= 0
        assert box["x"] + box["width"] <= 1280 and box["y"] + box["height"] <= 800
        expect(frame).to_be_visible()
        shown = frame.bounding_box()
        assert shown is not None and shown["y"] >= 0 and shown["y"] + shown["height"] <= 800 and shown["height"] > 10
        seen.append(title)
        card.locator("[data-do=next]").click()
    assert len(seen) == 9 and seen[0] == "The picture" and len(set(seen)) == 9
    assert tab.page.evaluate(stored) == "begun"
    # It leaves panels scrolled as they were.
    assert tab.page.evaluate(SCROLLED) == before
    # Not a second time, unless somebody asks for it.
    tab.page.reload()
    tab.wait_until_ready()
    tab.page.wait_for_timeout(2500)
    expect(tab.page.locator(".carts-offer")).to_have_count(0)
    tab.page.keyboard.press("?")
    tab.page.get_by_role("button", name="Take the tour").click()
    tab.page.keyboard.press("ArrowRight")
    expect(card).to_contain_text("The verdict")
    tab.page.keyboard.press("Escape")
    expect(card).to_have_count(0)
    expect(frame).to_have_count(0)


@pytest.mark.parametrize("window", [pytest.param((1280, 800), marks=pytest.mark.slow), (390, 844)])
def test_all_that_the_tour_speaks_of_is_in_view_whatever_was_unfolded_before(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab], window: tuple[int, int]
) -> None:
    tab = open_tab(open_viewer(width=160, height=120), window)
    if window[0] > 600:
        tab.page.get_by_text("Paint", exact=True).click()
        expect(tab.page.get_by_role("button", name="Polygon", exact=True)).to_be_visible()
    tab.page.evaluate("carts.startTour()")
    card, frame = tab.page.get_by_role("dialog", name="Tour"), tab.page.locator(".carts-tour-frame")
    steps = int(card.locator("span").inner_text().split(" of ")[1])
    assert steps == (9 if window[0] > 600 else 4)
    for _ in range(steps):
        box = frame.bounding_box()
        assert box is not None and box["y"] >= 0 and box["y"] + box["height"] <= window[1]
        assert box["height"] > 10, card.inner_text()
        card.locator("[data-do=next]").click()
    expect(card).to_have_count(0)
