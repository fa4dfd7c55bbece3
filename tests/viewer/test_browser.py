"""The whole thing, as a person uses it: in headless Chromium, with real pixels."""

import io
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import expect
from viewer_canvas import decoded, eventually
from viewer_tab import Tab
from waiting import wait_in

from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.state import Phase

pytestmark = pytest.mark.browser


@pytest.mark.parametrize(
    "windows", [((1700, 620), (1000, 950)), pytest.param(((1000, 950), (1280, 800)), marks=pytest.mark.slow)]
)
def test_the_overlay_lies_on_the_frame_at_any_window_shape_also_when_it_changes(
    open_marked: Callable[..., ViewerApp], open_tab: Callable[..., Tab], windows: tuple[tuple[int, int], ...]
) -> None:
    tab = open_tab(open_marked(), windows[0])
    assert tab.canvas.eventually_registered() <= 1.5
    tab.page.set_viewport_size({"width": windows[1][0], "height": windows[1][1]})
    assert tab.canvas.eventually_registered() <= 1.5


def test_zooming_with_the_wheel_and_dragging_keep_the_overlay_in_place(
    open_marked: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    tab = open_tab(open_marked())
    before = tab.canvas.where()
    tab.page.mouse.move(640, 400)
    tab.page.mouse.wheel(0, -400)
    after = tab.canvas.where(lambda map_: map_[0, 0] > 1.7 * before[0, 0])
    # What was under the pointer stays there.
    box = tab.page.locator("canvas").first.bounding_box()
    assert box is not None
    pointer = np.array([640 - box["x"], 400 - box["y"]])
    image = np.linalg.solve(before[:, :2], pointer - before[:, 2])
    assert after @ [*image, 1.0] == pytest.approx(pointer, abs=2.0)
    tab.page.mouse.down()
    tab.page.mouse.move(670, 415)
    tab.page.mouse.up()
    dragged = tab.canvas.where(lambda map_: abs(map_[0, 2] - after[0, 2]) > 25)
    assert dragged[:, 2] - after[:, 2] == pytest.approx([30, 15], abs=2.0)
    assert tab.canvas.eventually_registered() <= 1.5


def test_the_3d_view_turns_and_the_endoscope_view_comes_back_exactly(
    open_marked: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    tab = open_tab(open_marked())
    tab.canvas.eventually_registered()
    straight = tab.canvas.screenshot()
    tab.button("3D view")
    eventually(tab.canvas.screenshot, lambda image: np.abs(image.astype(int) - straight).mean() > 5)
    tab.page.mouse.move(640, 400)
    tab.page.mouse.down()
    tab.page.mouse.move(740, 440, steps=5)
    tab.page.mouse.up()
    tab.button("Endoscope view")
    assert tab.canvas.eventually_registered() <= 1.5
    # Looking through the endoscope, a drag must not turn the view any more.
    tab.page.mouse.move(640, 400)
    tab.page.mouse.down()
    tab.page.mouse.move(740, 440, steps=5)
    tab.page.mouse.up()
    assert tab.canvas.eventually_registered() <= 1.5


# The tests of several tabs type values, too, and look at the overlay of both.
@pytest.mark.slow
def test_typing_a_joint_value_moves_the_overlay_to_where_it_belongs(
    open_marked: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_marked()
    tab = open_tab(app)
    tab.canvas.eventually_registered()
    before = tab.canvas.screenshot()
    slider = app.view.layout.joints.slider("PSM1", 0)
    value = round(slider.value + 4.0, 2)
    tab.type_value(slider, value)
    eventually(
        lambda: float(app.state.pose.scene.joint_positions[0][0]), lambda at: abs(at - math.radians(value)) < 1e-4
    )
    assert tab.canvas.eventually_registered() <= 1.5
    assert np.abs(tab.canvas.screenshot().astype(int) - before).max() > 100


def test_a_dragged_slider_ends_with_the_overlay_of_its_last_value(
    open_marked: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_marked()
    tab = open_tab(app)
    tab.canvas.eventually_registered()
    slider = app.view.layout.joints.slider("PSM1", 0)
    thumb = tab.page.locator(f"[id='{app.page.element_id(slider)}'] [role=slider]").bounding_box()
    assert thumb is not None
    x, y = thumb["x"] + thumb["width"] / 2, thumb["y"] + thumb["height"] / 2
    tab.page.mouse.move(x, y)
    tab.page.mouse.down()
    for step in range(30):
        tab.page.mouse.move(x + 12 * math.sin(step / 5), y)
    tab.page.mouse.move(x - 10, y)
    tab.page.mouse.up()
    final = eventually(
        lambda: float(app.state.pose.scene.joint_positions[0][0]),
        lambda at: abs(at - math.radians(slider.value)) < 1e-3,
    )
    app.wait_until_shown()
    assert tab.canvas.eventually_registered() <= 1.5
    assert math.degrees(final) < slider.max - 5.5
    assert app.state.undoable == 1
    # The whole drag is one step of undo, and the next drag is another.
    eventually(lambda: app.state.unsaved, lambda unsaved: not unsaved)
    tab.page.mouse.move(x - 10, y)
    tab.page.mouse.down()
    tab.page.mouse.move(x + 5, y)
    tab.page.mouse.move(x + 8, y)
    tab.page.mouse.up()
    eventually(lambda: app.state.undoable, lambda count: count == 2)


def test_run_lets_the_loss_fall_and_the_overlay_follow(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(width=160, height=120)
    tab = open_tab(app)
    tab.button("Perturb all joints")
    eventually(lambda: app.state.undoable, lambda count: count == 1)
    start = app.view.scene.sent("/overlay")
    tab.button("Run")
    eventually(lambda: app.state.run, lambda run: run.phase is Phase.IDLE and run.reason is not None, timeout=90)
    curves = app.state.run.curves
    loss = curves.loss
    assert min(loss[1:]) < loss[0]
    expect(tab.page.get_by_text(app.state.run.reason or "").first).to_be_visible(timeout=30_000)
    expect(tab.page.get_by_text(f"result {loss[curves.best]:.3g}, iteration {curves.best}").first).to_be_visible()
    app.wait_until_shown()
    assert app.view.scene.sent("/overlay") != start
    charts = tab.page.evaluate(
        "Object.values(window.__viserTestpoints.uplots).map(entry => Array.from(entry.chart.data[1]))"
    )
    assert any(np.allclose(chart, loss) for chart in charts)


def test_exports_arrive_as_downloads_and_hold_what_is_shown(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer()
    tab = open_tab(app)
    tab.button("Perturb all joints")
    eventually(lambda: app.state.undoable, lambda count: count == 1)
    tab.page.get_by_text("Export", exact=True).click()
    with tab.page.expect_download() as started:
        tab.button("Export mask")
    mask = decoded(Path(started.value.path()).read_bytes())
    shown = OverlayRenderer(app.sequence).arm_ids(app.state.pose.scene, "left") >= 0
    assert started.value.suggested_filename == "tiny_001_left.png"
    assert np.array_equal(mask > 0, shown)
    tab.button("Export")
    eventually(lambda: app.state.export, lambda export: export is not None and export.path is not None)
    assert app.state.export is not None
    expect(tab.page.get_by_role("status").filter(has_text=str(app.state.export.path))).to_be_visible()
    with tab.page.expect_download() as started:
        tab.button("Download it")
    assert started.value.suggested_filename == "masks.zip"
    with zipfile.ZipFile(io.BytesIO(Path(started.value.path()).read_bytes())) as archive:
        again = decoded(archive.read("masks/binary/left_001.png"))
        views = json.loads(archive.read("masks/export.json"))["views"]
    assert np.array_equal(again, mask)
    assert [view["source"] for view in views] == ["edited", "measured", "measured"]


def test_any_format_of_chosen_frames_is_written_beside_the_project_and_can_be_cancelled(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=120, width=320, height=240, domains=("regular",))
    tab = open_tab(app)
    tab.page.keyboard.press("g")
    eventually(lambda: app.state.index, lambda index: index == 1)
    tab.page.get_by_text("Export", exact=True).click()
    tab.choose("Format", "COCO")
    tab.choose("Frames", "Accepted")
    expect(tab.page.get_by_text("1 of 120 frames")).to_be_visible()
    tab.button("Export")
    path = eventually(lambda: app.state.export and app.state.export.path, bool)
    assert path is not None
    content = json.loads((path / "annotations" / "instances_default.json").read_text())
    assert path.parent == app.project.path.with_name("sequence_exports") and len(content["images"]) == 1
    tab.choose("Format", "Overlay video")
    tab.choose("Frames", "All")
    expect(tab.page.get_by_text("Category per")).to_be_hidden()
    tab.button("Export")
    tab.button("Cancel export")
    eventually(lambda: app.state.export, lambda export: export is None)
    assert [folder.name for folder in path.parent.iterdir()] == ["coco"]


def test_frames_between_keyframes_are_solved_while_the_page_stays_live(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=7, width=160, height=120)
    tab, other = open_tab(app), open_tab(app, (1000, 900))
    tab.page.get_by_text("Review", exact=True).first.click()
    tab.page.keyboard.press("k")
    expect(tab.page.get_by_text("001 to 007")).to_be_visible()
    app.queue.put(intents.MoveFrame(1))
    expect(tab.page.get_by_text("6 frames would be fitted, 1 kept")).to_be_visible()
    tab.button("Solve between")
    stop = tab.page.get_by_role("button", name="Stop and keep", exact=True)
    expect(stop).to_be_visible()
    wait_in(tab.page, "carts.timeline().solving?.[1] === 7")
    # Another tab goes on browsing meanwhile.
    other.page.keyboard.press("n")
    eventually(lambda: other.state.index, lambda index: index == 1)
    place = other.place_in_viewer
    other.page.close()
    eventually(lambda: place.person.present, lambda present: not present)
    expect(tab.page.get_by_text("6 frames solved")).to_be_visible(timeout=60_000)
    expect(stop).to_be_hidden()
    sources = "[...Array(7).keys()].map((frame) => (carts.timeline().code(frame) >> 5) & 3)"
    eventually(lambda: tab.page.evaluate(sources), lambda codes: codes[1:] == [3] * 6)
    assert not app.state.project.joints(0) and all(app.state.project.joints(frame) for frame in range(1, 7))
    steps = app.state.undoable
    # The same again would be no step.
    tab.page.keyboard.press("Control+z")
    eventually(lambda: app.state.project.joints(3), lambda joints: not joints)
    tab.button("Solve all")
    eventually(lambda: app.state.solve, lambda solve: solve is not None and solve.running and solve.done >= 2)
    tab.button("Stop and keep")
    expect(tab.page.get_by_text("Stopped: ")).to_be_visible()
    assert app.state.undoable == steps and app.state.project.joints(1)
    tab.page.keyboard.press("Control+z")
    eventually(lambda: app.state.project.joints(1), lambda joints: not joints)


def test_an_error_is_shown_and_can_be_dismissed_and_the_page_asks_no_other_host_for_anything(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=12)
    asked: list[str] = []
    tab = open_tab(app, asked=asked)
    (app.sequence.path.parent / "regular" / "left" / "012.png").unlink()  # Too far away to be read in advance.
    tab.type_value(app.view.page.find("Frame"), 12)
    message = tab.page.locator(".carts-error[role=alert]")
    expect(message).to_contain_text("012.png", timeout=20_000)
    note = tab.page.get_by_text("That did not work")
    expect(note).to_be_visible()
    tab.button("Dismiss")
    expect(message).to_be_hidden()
    expect(note).to_be_hidden()
    tab.type_value(app.view.page.find("Frame"), 2)
    eventually(lambda: app.state.index, lambda index: index == 1)
    # Nor was any other host asked for anything.
    assert asked and all(url.startswith((app.url, "data:", "blob:")) for url in asked)


# What one tab types is seen in another one by the tests of several tabs, too.
@pytest.mark.slow
def test_two_tabs_on_one_frame_show_the_same(
    open_marked: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_marked()
    first, second = open_tab(app), open_tab(app, (1000, 900))
    second.place_in_viewer.put(intents.SetOpacity(1.0))
    slider = first.slider("PSM1", 1)
    value = round(slider.value - 3.0, 2)
    first.type_value(slider, value)
    field = second.page.locator(f"[id='{app.page.element_id(second.slider('PSM1', 1))}'] + * input")
    expect(field).to_have_value(f"{value:g}", timeout=20_000)
    assert first.canvas.eventually_registered() <= 1.5
    assert second.canvas.eventually_registered() <= 1.5


def test_keys_do_what_the_help_says(open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]) -> None:
    app = open_viewer(masks=False)
    tab = open_tab(app)
    tab.page.get_by_text("Help", exact=True).click()
    expect(tab.page.get_by_text("Next frame", exact=True)).to_be_visible()
    for key, check in (
        ("n", lambda: app.state.index == 1),
        ("b", lambda: app.state.index == 0),
        ("p", lambda: app.state.undoable == 1),
        ("Control+z", lambda: app.state.undoable == 0),
        ("Control+Shift+z", lambda: app.state.undoable == 1),
        ("c", lambda: app.state.error is not None),
        ("o", lambda: app.state.undoable == 2),
        ("Shift+i", lambda: app.state.undoable == 3),
        ("g", lambda: app.state.index == 1),
        ("b", lambda: app.state.index == 0 and app.state.review.state == "accepted"),
        ("3", lambda: app.state.layer == "Contour"),
        ("t", lambda: len(app.state.run.curves.loss) == 2),
        ("v", lambda: not tab.page.evaluate("carts.view.endoscope")),
        ("v", lambda: tab.page.evaluate("carts.view.endoscope")),
    ):
        tab.page.keyboard.press(key)
        eventually(check, bool)


def test_a_shift_click_places_a_keypoint_there_and_a_shift_drag_takes_it_along(
    open_marked: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_marked()
    tab = open_tab(app)
    before = tab.canvas.where()
    box = tab.page.locator("canvas").first.bounding_box()
    assert box is not None

    def on_screen(u: float, v: float) -> tuple[float, float]:
        x, y = before @ [u, v, 1.0]
        return box["x"] + x, box["y"] + y

    tab.page.keyboard.down("Shift")
    tab.page.mouse.click(*on_screen(150.0, 110.0))
    eventually(lambda: app.state, lambda state: state.undoable == 1 and not state.unsaved)
    (pin,) = app.state.keypoints.pins
    # A screen pixel is less than half an image pixel here.
    assert pin.pixel == pytest.approx((150.0, 110.0), abs=1.0)
    assert app.state.keypoints.residuals[0] < 1.0
    tab.page.mouse.down()
    for step in range(8):
        tab.page.mouse.move(*on_screen(150.0 + 2 * step, 110.0 + step))
    tab.page.mouse.up()
    tab.page.keyboard.up("Shift")
    eventually(lambda: app.state, lambda state: state.undoable == 2 and not state.unsaved)
    assert app.state.keypoints.pins[-1].pixel == pytest.approx((164.0, 117.0), abs=1.0)
    # The picture has stayed where it was.
    assert tab.canvas.where() == pytest.approx(before, abs=0.5)


def test_reviewing_is_saved_as_the_page_says_and_is_there_in_another_server(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer()
    tab = open_tab(app)
    tab.page.get_by_text("Review", exact=True).first.click()
    note = tab.page.locator(".mantine-TextInput-input:visible").first
    note.click()
    note.press_sequentially("smoke on the left", delay=20)
    expect(tab.page.get_by_text("Not saved yet")).to_be_visible()
    note.press("Tab")
    expect(tab.page.get_by_text("in sequence.carts")).to_be_visible()
    tab.button("Needs work")
    tab.button("Next unreviewed")
    eventually(lambda: app.state.index, lambda index: index == 1)
    tab.button("Accept + next")
    eventually(lambda: app.state.index, lambda index: index == 2)
    expect(tab.page.get_by_text("1 accepted")).to_be_visible()
    timeline = tab.page.locator(".carts-strip canvas")
    box = timeline.bounding_box()
    assert box is not None
    timeline.click(position={"x": 0.1 * box["width"], "y": 20})
    eventually(lambda: app.state.index, lambda index: index == 0)
    app.close()
    with ViewerApp.open(app.sequence.path, port=0) as again:
        project = again.wait_until_shown(60).project
    assert (project.review(0).state, project.review(0).note) == ("needs work", "smoke on the left")
    assert project.review(1).state == "accepted" and len(project.steps) == 3
