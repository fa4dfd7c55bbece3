"""The timeline: bars, curves, thumbnails and the range."""

import urllib.error
import urllib.request
from collections.abc import Callable

import numpy as np
import pytest
from playwright.sync_api import expect
from viewer_canvas import decoded, eventually
from viewer_desk import Desk
from viewer_tab import Tab
from waiting import wait_in

from carts_core.project import Figures, Key, Review, ReviewState
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.panels.timeline import HEIGHT, Traces, code

# ---- Curves --------------------------------------------------------------------------------------------------------


def test_a_curve_is_the_lowest_and_highest_value_of_each_column_and_follows_what_is_corrected(desk: Desk) -> None:
    traces, project = Traces(desk.session), desk.session.editor.project
    assert traces.names[:2] == ["Loss [1]", "Dice [1]"] and traces.names[3].endswith("[°]")
    yaw = traces.names[3]
    measured = np.degrees(desk.session.sequence.measured["PSM1"][:, 0])
    found = traces.between(yaw, 0, 3, 100)
    assert found is not None and found["edges"] == [0, 1, 2, 3]
    assert found["curves"][0] == [pytest.approx(measured, rel=1e-4)] * 2 and found["curves"][1] == [[None] * 3] * 2
    desk.do(intents.ShowFrame(1), intents.SetJoint("PSM1", 0, 0.1), intents.Released())
    traces.follow(project.state, [1])
    whole = traces.between(yaw, 0, 3, 1)
    assert whole is not None and whole["edges"] == [0, 3]
    assert whole["curves"][0] == [[pytest.approx(measured.min(), rel=1e-4)], [pytest.approx(measured.max(), rel=1e-4)]]
    assert whole["curves"][1] == [[pytest.approx(np.degrees(0.1), rel=1e-4)]] * 2
    project.record_figures({2: Figures(loss=0.25)}, project.state)
    traces.follow(project.state, [2])
    loss = traces.between("Loss [1]", 0, 3, 100)
    assert loss is not None and loss["curves"] == [[[None, None, 0.25]] * 2]


@pytest.mark.parametrize("asked", [("Nothing", 0, 3, 9), ("Loss [1]", 2, 2, 9), ("Loss [1]", 0, 3, 0), ("", -5, -3, 1)])
def test_a_curve_that_there_is_not_is_none(desk: Desk, asked: tuple[str, int, int, int]) -> None:
    assert Traces(desk.session).between(*asked) is None


# ---- The range -----------------------------------------------------------------------------------------------------


def test_playing_goes_round_in_the_range_and_solving_and_jobs_keep_to_it(desk: Desk) -> None:
    assert desk.do(intents.SetRange((2, 1))).range == (1, 2)
    desk.do(intents.ShowFrame(0), intents.Play(True))
    seen = []
    for _ in range(4):
        desk.controller._browsing._next_frame_at = 0.0
        desk.advance()
        seen.append(desk.state.index)
    assert seen == [1, 2, 1, 2]
    desk.do(intents.Play(False), intents.OptimizeFrames("range"))
    assert desk.state.jobs[-1].title == "Optimize 2 frames, each alone"
    desk.do(intents.CancelJob(1), intents.SetSetting("solver", "surface"), intents.Solve(whole=True))
    assert desk.state.jobs[-1].title == "Solve frames 002 to 003"
    desk.finish()
    assert desk.state.solve is not None and desk.state.solve.frames == range(1, 3)
    assert not desk.saved.joints(0)


def test_a_range_is_marked_frame_by_frame_and_the_whole_sequence_is_none(desk: Desk) -> None:
    assert desk.do(intents.ShowFrame(1), intents.MarkRange()).range == (1, 2)
    assert desk.do(intents.MarkRange(end=True)).range == (1, 1)
    assert desk.do(intents.ShowFrame(0), intents.MarkRange(end=True)).range == (0, 0)
    assert desk.do(intents.SetRange((-3, 10**8))).range is None
    assert desk.do(intents.SetRange((1, 2)), intents.SetRange(None)).range is None


def test_a_frame_of_which_the_fit_is_not_known_has_no_height_and_one_that_fits_well_has_some(desk: Desk) -> None:
    editor = desk.session.editor
    editor.apply("Accept", {Key.review(1): Review(ReviewState.ACCEPTED), Key.review(2): Review(ReviewState.ACCEPTED)})

    def high() -> list[int]:
        return [code(editor.project.state, frame, desk.session.scene) >> 8 for frame in (0, 1, 2)]

    assert high() == [0, 0, 0]
    editor.project.record_figures({1: Figures(dice=1.0), 2: Figures(dice=0.5)}, editor.project.state)
    assert high() == [0, 1, 255]


# ---- In the page ---------------------------------------------------------------------------------------------------


@pytest.mark.browser
def test_the_status_is_that_of_the_shown_frame_and_a_label_at_the_pointer_has_the_other_one(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    tab = open_tab(open_viewer(frames=8, width=160, height=120))
    status, tip = tab.page.locator(".carts-strip output"), tab.page.locator(".carts-tip")
    expect(status).to_contain_text("001 of 8 · untouched")
    expect(tip).to_be_hidden()
    box = tab.page.locator(".carts-strip canvas").bounding_box()
    assert box is not None
    tab.page.mouse.move(box["x"] + box["width"] * 5.5 / 8, box["y"] + 30)
    expect(tip).to_have_text("006 of 8 · untouched")
    expect(status).to_contain_text("001 of 8 · untouched")
    legend = tab.page.locator(".carts-strip-legend")
    expect(legend).to_be_hidden()
    tab.page.get_by_role("button", name="Legend").click()
    expect(legend).to_contain_text("solving leaves it as it is")
    tab.page.get_by_role("button", name="Legend").click()
    expect(legend).to_be_hidden()
    tab.page.mouse.move(box["x"] + box["width"] * 5.5 / 8, box["y"] + 30)
    label = tip.bounding_box()
    assert label is not None and abs(label["x"] + label["width"] / 2 - box["x"] - box["width"] * 5.5 / 8) < 2
    tab.page.mouse.move(box["x"] + 200, box["y"] - 200)
    expect(tip).to_be_hidden()


@pytest.mark.browser
def test_the_timeline_shows_thumbnails_of_what_is_in_view_a_curve_and_a_range(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=60, width=160, height=120)
    asked: list[int] = []
    answer = app.page.thumbnail
    assert answer is not None

    def noted(path: str):
        asked.append(int(path.split("/")[2].removesuffix(".jpg")))
        return answer(path)

    app.page.thumbnail = noted
    tab = open_tab(app, (1280, 800))
    strip = tab.page.locator(".carts-strip canvas")
    wait_in(tab.page, "carts.lanes.loaded().length >= 8")
    box = strip.bounding_box()
    assert box is not None
    # Pictures do not overlap, so a sequence of 60 frames needs no more than fit beside one another.
    assert len(set(asked)) <= box["width"] / 45 and max(asked) > 45
    # Zoomed in, those in view alone are asked for, and no picture twice.
    asked.clear()
    tab.page.evaluate("carts.showFrames(20, 8)")
    eventually(lambda: len(asked), lambda count: count >= 6)
    tab.page.wait_for_timeout(300)
    assert all(19 <= frame <= 28 for frame in asked) and len(asked) == len(set(asked))
    # A curve: chosen in the page, asked for in view alone, with its value where the pointer is.
    tab.page.get_by_label("Curve", exact=True).select_option(index=4)
    wait_in(tab.page, "carts.lanes.curve()?.edges.length == 9 && carts.lanes.curve().edges[0] == 20")
    box = strip.bounding_box()
    assert box is not None
    tab.page.mouse.move(box["x"] + box["width"] * 1.5 / 8, box["y"] + 30)
    yaw = app.sequence.measured["PSM1"][21, 0]
    expect(tab.page.locator(".carts-tip")).to_contain_text(f"{float(f'{np.degrees(yaw):.5g}')} °")
    # Shift and drag mark a range, whose ends can be dragged on; × takes it away.
    tab.page.keyboard.down("Shift")
    tab.page.mouse.down()
    tab.page.mouse.move(box["x"] + box["width"] * 4.5 / 8, box["y"] + 30, steps=4)
    tab.page.mouse.up()
    tab.page.keyboard.up("Shift")
    eventually(lambda: app.state.range, lambda frames: frames == (21, 24))
    assert app.state.index == 0
    tab.page.mouse.move(box["x"] + box["width"] * 5 / 8, box["y"] + 6)
    tab.page.mouse.down()
    tab.page.mouse.move(box["x"] + box["width"] * 6.5 / 8, box["y"] + 6, steps=4)
    tab.page.mouse.up()
    eventually(lambda: app.state.range, lambda frames: frames == (21, 26))
    expect(tab.page.locator(".carts-range")).to_have_text("022 – 027")
    app.queue.put(intents.ShowFrame(23))
    app.wait_until_shown()
    tab.page.keyboard.press("(")
    eventually(lambda: app.state.range, lambda frames: frames == (23, 26))
    # It is what is exported, unless somebody says otherwise.
    tab.page.get_by_role("tab", name="Export", exact=True).click()
    expect(tab.page.get_by_text("4 of 60 frames")).to_be_visible(timeout=20_000)
    tab.button("Export")
    eventually(lambda: app.state.export and app.state.export.frames, lambda frames: frames == 4)
    tab.page.get_by_label("Only the range").uncheck()
    expect(tab.page.get_by_text("60 of 60 frames")).to_be_visible()
    tab.page.locator(".carts-strip [data-do=whole]").click()
    eventually(lambda: app.state.range, lambda frames: frames is None)


@pytest.mark.browser
def test_what_no_page_asks_for_has_no_thumbnail(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer(width=160, height=120)

    def status(path: str) -> tuple[int, bytes]:
        try:
            with urllib.request.urlopen(f"{app.url}/thumbnail/{path}", timeout=20) as answer:
                return answer.status, answer.read()
        except urllib.error.HTTPError as error:
            return error.code, b""

    code, content = status("0/0/2.jpg")
    assert code == 200 and decoded(content).shape == (HEIGHT, HEIGHT * 160 // 120, 3)
    for path in (
        "0/0/3.jpg",
        "1/0/0.jpg",
        "0/1/0.jpg",
        "0/0/-1.jpg",
        "../0/0/0.jpg",
        "0/0/0.png",
        "0/0/99999999999.jpg",
    ):
        assert status(path)[0] == 404, path
