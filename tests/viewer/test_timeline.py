"""The timeline in headless Chromium: status, thumbnails, curves and the range."""

import numpy as np
import pytest
from playwright.sync_api import expect
from viewer_tab import OpenTab, OpenViewer, Tab, box_of
from waiting import eventually, wait_in

from carts_viewer.actions import intents

pytestmark = pytest.mark.browser


def check_status(tab: Tab) -> None:
    """The status is of the shown frame, a label at the pointer of the frame there."""
    page, status, tip = tab.page, tab.page.locator(".carts-strip output"), tab.page.locator(".carts-tip")
    box = box_of(page.locator(".carts-strip canvas"))
    expect(status).to_contain_text("001 of 60 · untouched")
    expect(tip).to_be_hidden()
    x = box["x"] + box["width"] * 30.5 / 60
    page.mouse.move(x, box["y"] + 30)
    expect(tip).to_have_text("031 of 60 · untouched")
    label = box_of(tip)
    assert abs(label["x"] + label["width"] / 2 - x) < 2
    expect(status).to_contain_text("001 of 60 · untouched")
    page.mouse.move(x, box["y"] - 200)
    expect(tip).to_be_hidden()
    timeline = page.get_by_role("slider", name="Timeline", exact=True)
    for key, frame in (("End", "60"), ("ArrowLeft", "59"), ("Home", "1")):
        timeline.press(key)
        expect(timeline).to_have_attribute("aria-valuenow", frame)
    timeline.blur()


def check_range(tab: Tab) -> None:
    """Shift and drag mark a range, whose ends can be dragged on; × takes it away. Frames 20 to 27 are in view."""
    app, page, box = tab.app, tab.page, box_of(tab.page.locator(".carts-strip canvas"))
    y, left, width = box["y"] + 30, box["x"], box["width"]
    page.keyboard.down("Shift")
    tab.drag((left + width * 1.5 / 8, y), (left + width * 4.5 / 8, y), steps=4)
    page.keyboard.up("Shift")
    eventually(lambda: app.state.range, lambda frames: frames == (21, 24))
    assert app.state.index == 30
    expect(page.locator(".carts-range")).to_have_text("022 – 025")
    tab.drag((left + width * 5 / 8, y - 24), (left + width * 6.5 / 8, y - 24), steps=4)
    eventually(lambda: app.state.range, lambda frames: frames == (21, 26))
    expect(page.locator(".carts-range")).to_have_text("022 – 027")
    tab.put(intents.ShowFrame(23))
    tab.press("(")
    eventually(lambda: app.state.range, lambda frames: frames == (23, 26))
    tab.open("Export")
    expect(page.get_by_text("4 of 60 frames")).to_be_visible()
    tab.button("Export")
    eventually(lambda: app.state.export and app.state.export.frames, lambda frames: frames == 4)
    page.get_by_label("Only the range").uncheck()
    expect(page.get_by_text("60 of 60 frames")).to_be_visible()
    page.locator(".carts-strip [data-do=whole]").click()
    eventually(lambda: app.state.range, lambda frames: frames is None)


def check_edges(tab: Tab) -> None:
    """A range may begin at the very edge of the strip; beside it, panels are resized."""
    page, strip = tab.page, tab.page.locator(".carts-strip canvas")
    page.evaluate("carts.showFrames(0, 60)")
    box = box_of(strip)
    y, left, right = box["y"] + 30, box["x"], box["x"] + box["width"]
    page.keyboard.down("Shift")
    tab.drag((left + 1, y), (right - 21, y), (right - 1, y), steps=4)
    page.keyboard.up("Shift")
    expect(page.locator(".carts-range")).to_have_text("001 – 060")
    assert box_of(strip) == box
    for edge, side in ((left - 2, 1), (right + 2, -1)):
        before = box_of(strip)["width"]
        tab.drag((edge, 400), (edge + 60 * side, 400), steps=4)
        eventually(lambda before=before: box_of(strip)["width"], lambda now, before=before: now < before - 30)


def test_a_thumbnail_that_failed_is_asked_for_again(open_viewer: OpenViewer, open_tab: OpenTab) -> None:
    app = open_viewer(frames=4)
    answer = app.page.thumbnail
    assert answer is not None
    asked: list[str] = []

    def busy(path: str):
        asked.append(path)
        return answer(path if asked.count(path) > 1 else "none")

    app.page.thumbnail = busy
    page = open_tab(app, (1280, 800)).page
    wait_in(page, "carts.lanes.loaded().length == 4")
    wait_in(page, "carts.lanes.idle()")
    assert sorted(asked) == sorted(2 * [f"0/0/{frame}.jpg" for frame in range(4)])


def test_the_timeline_shows_status_thumbnails_a_curve_and_a_range(open_viewer: OpenViewer, open_tab: OpenTab) -> None:
    app = open_viewer(frames=60)
    asked: list[int] = []
    answer = app.page.thumbnail
    assert answer is not None

    def noted(path: str):
        asked.append(int(path.split("/")[2].removesuffix(".jpg")))
        return answer(path)

    app.page.thumbnail = noted
    tab = open_tab(app, (1280, 800))
    page, strip = tab.page, tab.page.locator(".carts-strip canvas")
    box = box_of(strip)
    y, left, width = box["y"] + 30, box["x"], box["width"]
    assert width == pytest.approx(box_of(page.locator("canvas"))["width"], abs=2)
    # Pictures do not overlap, so a sequence of 60 frames needs no more than fit beside one another.
    wait_in(page, "carts.lanes.loaded().length >= 8")
    assert len(set(asked)) <= width / 45 and max(asked) > 45
    check_status(tab)
    # A press shows a frame, which follows the pointer; the wheel zooms about it.
    tab.drag((left + width * 10.5 / 60, y), (left + width * 30.5 / 60, y), steps=4)
    eventually(lambda: app.state.index, lambda index: index == 30)
    page.mouse.wheel(0, -200)
    shown = eventually(lambda: page.evaluate("carts.timeline().view"), lambda view: view[1] - view[0] < 50)
    assert shown[0] < 30 < shown[1]
    # Zoomed in, those in view alone are asked for, and no picture twice.
    for first in (20, 40):
        wait_in(page, "carts.lanes.idle()")
        asked.clear()
        page.evaluate(f"carts.showFrames({first}, 8)")
        loaded = f"carts.lanes.loaded().map((at) => +at.match(/[0-9]+(?=.jpg)/)).filter((at) => at >= {first})"
        wait_in(page, f"{loaded}.filter((at) => at < {first + 8}).length >= 6")
    assert all(39 <= frame <= 48 for frame in asked) and len(asked) == len(set(asked))
    page.evaluate("carts.showFrames(20, 8)")
    # A curve: chosen in the page, asked for in view alone, with its value where the pointer is.
    page.get_by_label("Curve", exact=True).select_option(index=4)
    wait_in(page, "carts.lanes.curve()?.edges.length == 9 && carts.lanes.curve().edges[0] == 20")
    box = box_of(strip)
    page.mouse.move(box["x"] + box["width"] * 1.5 / 8, box["y"] + 30)
    yaw = app.sequence.measured["PSM1"][21, 0]
    expect(page.locator(".carts-tip")).to_contain_text(f"{float(f'{np.degrees(yaw):.5g}')} °")
    check_range(tab)
    check_edges(tab)
