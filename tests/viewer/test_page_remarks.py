"""What people who tried the page stumbled over, in a real browser."""

import threading
from collections.abc import Callable

import pytest
from playwright.sync_api import expect
from viewer_canvas import eventually
from viewer_tab import Tab

from carts_core.project import ReviewState
from carts_viewer import intents
from carts_viewer.app import ViewerApp
from carts_viewer.handlers.propagating import PropagatingHandler
from carts_viewer.state import Phase

pytestmark = pytest.mark.browser

_FIT = "(carts.timeline().code(0) >> 3) & 3"
_CUT_OFF = "one => one.scrollWidth > one.clientWidth"


@pytest.mark.parametrize("key", ["Enter", "Escape"])
def test_a_field_that_was_left_with_a_key_gives_the_letters_back_to_the_page(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab], key: str
) -> None:
    app = open_viewer(frames=12, width=160, height=120)
    tab = open_tab(app)
    field = tab.page.locator(f"[id='{app.page.element_id(tab.find('Frame'))}'] + * input")
    field.click()
    field.press("Control+a")
    field.press_sequentially("5", delay=60)
    eventually(lambda: app.state.index, lambda index: index == 4)
    field.press(key)
    tab.page.wait_for_function("document.activeElement === document.body")
    tab.page.keyboard.press("g")
    eventually(lambda: app.state.project.review(4).state, lambda state: state is ReviewState.ACCEPTED)


def test_the_timeline_drops_an_old_verdict_while_a_run_moves_the_frame_and_brings_it_back_with_a_reset(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(width=160, height=120)
    tab = open_tab(app)
    check = tab.page.get_by_role("button", name="Check the fit", exact=True)
    check.click()
    eventually(lambda: app.state.verdict, lambda verdict: verdict is not None, timeout=90)
    # The button says why it cannot be pressed.
    expect(tab.page.get_by_role("button", name="The fit is checked", exact=True)).to_be_disabled()
    told = eventually(lambda: tab.page.evaluate(_FIT), lambda fit: fit > 0)
    tab.place_in_viewer.put(intents.Step())
    eventually(lambda: app.state.run.phase, lambda phase: phase is Phase.PAUSED, timeout=90)
    assert app.state.unsaved
    eventually(lambda: tab.page.evaluate(_FIT), lambda fit: fit == 0)
    expect(check).to_be_enabled()
    tab.place_in_viewer.put(intents.Reset())
    eventually(lambda: tab.page.evaluate(_FIT), lambda fit: fit == told)


def test_with_a_range_solving_and_exporting_say_what_they_are_about(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=12, width=160, height=120)
    tab = open_tab(app)
    tab.place_in_viewer.put(intents.SetReview(ReviewState.ACCEPTED))
    tab.place_in_viewer.put(intents.SetRange((4, 7)))
    tab.page.get_by_role("tab", name="Review", exact=True).click()
    between, whole = (
        tab.page.get_by_role("button", name=name, exact=True) for name in ("Solve between", "Solve range")
    )
    expect(tab.page.get_by_text("keeps to the range, and this frame lies outside of it")).to_be_visible()
    expect(between).to_be_disabled()
    expect(whole).to_be_enabled()
    tab.place_in_viewer.put(intents.Solve())
    expect(tab.page.get_by_text("the shown frame lies outside of it").last).to_be_visible()
    tab.place_in_viewer.put(intents.DismissError())
    tab.place_in_viewer.put(intents.ShowFrame(5))
    expect(tab.page.get_by_text("none is kept in the range")).to_be_visible()
    tab.place_in_viewer.put(intents.SetReview(ReviewState.ACCEPTED))
    expect(tab.page.get_by_text("Solve between, 005 to 008: 3 frames would be fitted, 1 kept")).to_be_visible()
    # What the range is most likely chosen for is the bright button.
    assert (tab.find("Solve range").color, tab.find("Solve between").color) == ("teal", "gray")
    tab.page.get_by_role("tab", name="Export", exact=True).click()
    expect(tab.page.get_by_text("1 accepted frame outside of the range is left out")).to_be_visible()
    tab.page.get_by_label("Only the range").uncheck()
    expect(tab.page.get_by_text("outside of the range")).to_be_hidden()
    tab.place_in_viewer.put(intents.SetRange(None))
    eventually(lambda: tab.find("Solve between").color, lambda color: color == "teal")


@pytest.mark.parametrize("fails", [False, True])
def test_solving_shows_that_it_has_begun_before_what_it_needs_is_there(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab], monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    go_on, make = threading.Event(), PropagatingHandler._make

    def slowly(*arguments):
        assert go_on.wait(60)
        if fails:
            raise OSError("The disk is gone.")
        return make(*arguments)

    app = open_viewer(width=160, height=120)
    tab = open_tab(app)
    monkeypatch.setattr(PropagatingHandler, "_make", slowly)
    tab.page.get_by_role("tab", name="Review", exact=True).click()
    tab.button("Solve all")
    try:
        expect(tab.page.get_by_text("Preparing", exact=True)).to_be_visible(timeout=4_000)
        expect(tab.page.get_by_role("button", name="Solve all", exact=True)).to_be_disabled()
        expect(tab.page.get_by_role("button", name="Stop and keep", exact=True)).to_be_visible()
    finally:
        go_on.set()
    if fails:
        expect(tab.page.get_by_text("The disk is gone").first).to_be_visible()
        expect(tab.page.get_by_role("button", name="Solve all", exact=True)).to_be_enabled()
    else:
        eventually(lambda: app.state.solve and app.state.solve.running, lambda running: running is False, timeout=120)


def test_nothing_in_the_window_covers_or_cuts_off_what_stands_beside_it(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=12, cameras=("left", "right"), width=160, height=120)
    tab = open_tab(app, (1280, 800))
    tab.place_in_viewer.put(intents.SetRange((4, 7)))
    expect(tab.page.locator(".carts-range")).to_have_text("005 – 008")
    # The longest status that solving leaves: solved together, good.
    tab.page.evaluate("carts.setTimeline({ whole: false, codes: [0, 6 + 8 + 96], solving: null, traced: false })")
    status = tab.page.locator(".carts-strip output")
    expect(status).to_have_text("001 of 12 · solved together · good")
    assert not status.evaluate(_CUT_OFF)
    # The panel's scrollbar lies beside its fields.
    bar = tab.page.locator(".mantine-ScrollArea-scrollbar[data-orientation=vertical]").first.bounding_box()
    redo = tab.page.get_by_role("button", name="Redo", exact=True).bounding_box()
    assert bar is not None and redo is not None and bar["x"] > redo["x"] + redo["width"]
    # A picture that is zoomed keeps its name and fit in view, below the tool bar.
    tab.page.wait_for_function("carts.shown().cameras.length == 2 && carts.imageOnScreen(1)")
    tab.page.evaluate("carts.zoomAt(4, 0.5, 0.25)")
    canvas, tools = (tab.page.locator(name).first.bounding_box() for name in ("canvas", ".carts-bar"))
    assert canvas is not None and tools is not None
    label = tab.page.locator(".carts-marks [data-camera=left] .carts-cell-label")

    def in_view() -> bool:
        box = label.bounding_box()
        return box is not None and box["x"] >= canvas["x"] and box["y"] >= tools["y"] + tools["height"] - 1

    eventually(in_view, bool)
    # The palette names the keys that the page listens to itself.
    tab.page.keyboard.press("Control+k")
    tab.page.keyboard.type("range at this")
    found = tab.page.locator("[class*=Spotlight-action]").filter(has_text="Begin the range at this frame")
    expect(found.first).to_contain_text("(")
