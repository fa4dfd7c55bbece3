"""What people who tried the page stumbled over, in a real browser."""

import re
import threading
from collections.abc import Callable

import pytest
from playwright.sync_api import expect
from viewer_canvas import eventually
from viewer_tab import Tab
from waiting import wait_for, wait_in

from carts_core.optimization import SequenceOptimizer
from carts_core.project import ReviewState
from carts_viewer.actions import intents
from carts_viewer.actions.sequence import PropagatingHandler
from carts_viewer.app import ViewerApp
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
    wait_in(tab.page, "document.activeElement === document.body")
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
    shown = eventually(lambda: tab.page.evaluate(_FIT), lambda fit: fit > 0)
    tab.place_in_viewer.put(intents.Step())
    eventually(lambda: app.state.run.phase, lambda phase: phase is Phase.PAUSED, timeout=90)
    assert app.state.unsaved
    eventually(lambda: tab.page.evaluate(_FIT), lambda fit: fit == 0)
    expect(check).to_be_enabled()
    tab.place_in_viewer.put(intents.Reset())
    eventually(lambda: tab.page.evaluate(_FIT), lambda fit: fit == shown)


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
    codes = "[0, 6 + 8 + 96 + 5 * 65536]"
    tab.page.evaluate(f"carts.setTimeline({{ whole: false, codes: {codes}, solving: null, traced: false }})")
    status = tab.page.locator(".carts-strip output")
    expect(status).to_have_text("001 of 12 · solved together · mask good")
    expect(status).to_have_attribute("title", "001 of 12 · solved together · mask good, 4 joints not determined")
    assert not status.evaluate(_CUT_OFF)
    # The panel's scrollbar lies beside its fields.
    bar = tab.page.locator(".mantine-ScrollArea-scrollbar[data-orientation=vertical]").first.bounding_box()
    redo = tab.page.get_by_role("button", name="Redo", exact=True).bounding_box()
    assert bar is not None and redo is not None and bar["x"] > redo["x"] + redo["width"]
    # A picture that is zoomed keeps its name and fit in view, below the tool bar.
    wait_in(tab.page, "carts.shown().cameras.length == 2 && carts.imageOnScreen(1)")
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


def test_a_range_begins_at_the_very_edge_of_the_strip_and_panels_are_still_resized(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=12, width=160, height=120)
    tab = open_tab(app)
    mouse, strip = tab.page.mouse, tab.page.locator(".carts-strip canvas")
    box = strip.bounding_box()
    assert box is not None
    y, right = box["y"] + box["height"] / 2, box["x"] + box["width"] - 1
    tab.page.keyboard.down("Shift")
    mouse.move(box["x"] + 1, y)
    mouse.down()
    mouse.move(right - 20, y, steps=4)
    mouse.move(right, y)
    mouse.up()
    tab.page.keyboard.up("Shift")
    expect(tab.page.locator(".carts-range")).to_have_text("001 – 012")
    assert strip.bounding_box() == box
    for edge, side in ((box["x"] - 2, 1), (box["x"] + box["width"] + 2, -1)):
        before = strip.bounding_box()
        mouse.move(edge, 400)
        mouse.down()
        mouse.move(edge + 60 * side, 400, steps=4)
        mouse.up()
        eventually(lambda before=before: strip.bounding_box()["width"] < before["width"] - 30, bool)  # type: ignore[index]


def test_a_suspected_calibration_is_mended_where_it_is_said_and_frames_are_solved_again_where_it_ends(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab], monkeypatch: pytest.MonkeyPatch
) -> None:
    app = open_viewer(width=160, height=120)
    tab = open_tab(app)
    monkeypatch.setattr(SequenceOptimizer, "base_frame_gain", lambda self: 0.4)
    tab.page.get_by_role("tab", name="Review", exact=True).click()
    expect(tab.page.get_by_text("The calibration may be off")).to_have_count(0)
    tab.button("Solve all")
    expect(tab.page.get_by_text("The calibration may be off")).to_be_visible(timeout=120_000)
    tab.button("Calibrate on 3 frames")
    expect(tab.page.get_by_text("The calibration may be off")).to_have_count(0, timeout=120_000)
    said = tab.page.get_by_role("status").get_by_text("run or solve again what was fitted before")
    expect(said.locator("visible=true")).to_have_count(1, timeout=120_000)
    expect(said.locator("visible=true")).to_contain_text("Moved: T_world_base of PSM1 by ")
    tab.page.get_by_role("tab", name="Jobs", exact=True).click()
    solved = len(app.state.jobs)
    tab.button("Solve all")
    jobs = eventually(lambda: app.state.jobs, lambda jobs: len(jobs) > solved and jobs[-1].over, timeout=120)
    assert jobs[-1].kind == "solve"
    expect(tab.page.get_by_role("button", name="Solve all", exact=True)).to_have_count(0)


def test_jobs_take_the_range_that_is_chosen_until_it_is_dropped_or_something_else_is_chosen(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=12, width=160, height=120)
    tab = open_tab(app)
    tab.page.get_by_role("tab", name="Jobs", exact=True).click()
    frames = tab.page.locator(f"[id='{app.page.element_id(tab.find('Which frames'))}']")
    expect(frames).to_have_value("Unreviewed")
    tab.place_in_viewer.put(intents.SetRange((4, 7)))
    expect(frames).to_have_value("Range in the timeline")
    tab.place_in_viewer.put(intents.SetRange(None))
    expect(frames).to_have_value("Unreviewed")
    tab.choose("Which frames", "All")
    tab.place_in_viewer.put(intents.SetRange((4, 7)))
    expect(tab.page.locator(".carts-range")).to_have_text("005 – 008")
    expect(frames).to_have_value("All")


@pytest.mark.parametrize("size", [(1280, 800), (390, 844)])
def test_a_note_covers_neither_the_names_of_the_pictures_nor_what_is_pressed(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab], size: tuple[int, int]
) -> None:
    app = open_viewer(cameras=("left", "right"), width=320, height=240)
    tab = open_tab(app, size)
    tab.place_in_viewer.put(intents.Download(1))
    note = tab.page.locator(".mantine-Notification-root", has_text="Nothing has been exported yet")
    expect(note).to_be_visible()
    wait_for(lambda: note.evaluate("one => one.getAnimations({subtree: true}).length === 0"))
    box = note.bounding_box()
    others = tab.page.locator(".carts-cell-label, .carts-review-bar button, .carts-strip canvas").all()
    assert box is not None and len(others) >= 3
    for other in others:
        where = other.bounding_box()
        assert where is None or (where["y"] + where["height"] <= box["y"] or where["y"] >= box["y"] + box["height"]), (
            other.text_content()
        )


def test_what_is_unusual_about_the_files_of_a_recording_is_under_sequence(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(edit=lambda text: re.sub(r"K = \[\[[^,]*,", "K = [[20.0,", text))
    page = open_tab(app).page
    page.get_by_text("1 remark on the files").click()
    expect(page.get_by_text("left: its calibration has focal lengths of 20 and")).to_be_visible()
