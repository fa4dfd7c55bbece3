"""Dragging a link of an arm: its point follows the pointer, joints stay within their limits, a gesture is one step."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from viewer_canvas import eventually
from viewer_desk import Desk
from viewer_tab import Tab

from carts_core.errors import CartsError
from carts_core.model.keypoints import Keypoint, project_keypoints
from carts_core.model.scene import Scene
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.state import ViewState


def _seen(scene: Scene, state: ViewState, point: Keypoint) -> tuple[float, float]:
    u, v = project_keypoints(scene, state.pose.scene, [point], state.camera)[0].tolist()
    return u, v


def _taken(desk: Desk) -> tuple[tuple[float, float], Keypoint]:
    """A place of the image where the arm is, and what is there."""
    rows, columns = np.nonzero(desk.renderer.arm_ids(desk.state.pose.scene, desk.state.camera) == 0)
    place = float(np.median(columns)) + 0.5, float(rows[np.abs(columns - np.median(columns)).argmin()]) + 0.5
    point = desk.renderer.pick(desk.state.pose.scene, desk.state.camera, place, 15.0)
    assert point is not None
    return place, point


def test_the_point_that_was_taken_follows_the_pointer_and_a_gesture_is_one_step(desk: Desk) -> None:
    place, point = _taken(desk)
    before, start = _seen(desk.session.scene, desk.state, point), desk.state.pose.scene
    for share in (0.3, 0.7, 1.0):
        end = place[0] + share * 9.0, place[1] - share * 6.0
        desk.do(intents.DragLink(1.0, "left", place, end))
    after = _seen(desk.session.scene, desk.state, point)
    assert (after[0] - before[0], after[1] - before[1]) == pytest.approx((9.0, -6.0), abs=0.5)
    desk.do(intents.Released())
    assert desk.saved.position == 1 and desk.saved.steps[0].name.startswith("Drag PSM1 ")
    desk.do(intents.Undo())
    for one, other in zip(desk.state.pose.scene.joint_positions, start.joint_positions, strict=True):
        assert torch.equal(one, other)


def test_dragging_a_link_back_brings_the_joints_back(desk: Desk) -> None:
    place, _ = _taken(desk)
    start = desk.session.joints(desk.state.pose.scene)
    desk.do(intents.DragLink(1.0, "left", place, (place[0] + 20.0, place[1])))
    away = desk.session.joints(desk.state.pose.scene)
    assert max(np.abs(away[arm] - start[arm]).max() for arm in start) > 0.005
    desk.do(intents.DragLink(1.0, "left", place, place))
    back = desk.session.joints(desk.state.pose.scene)
    assert max(np.abs(back[arm] - start[arm]).max() for arm in start) < 1e-4


def test_joints_stay_within_their_limits_however_far_a_link_is_dragged(desk: Desk) -> None:
    place, _ = _taken(desk)
    desk.do(intents.DragLink(1.0, "left", place, (1e6, -1e6)))
    for arm in desk.session.scene.arms:
        values = desk.session.joints(desk.state.pose.scene)[arm.name]
        low, high = arm.robot.joint_limits.double().numpy().T
        assert (values >= low - 1e-6).all() and (values <= high + 1e-6).all()


def test_where_no_arm_is_that_is_said_once_and_nothing_moves(desk: Desk) -> None:
    ids = desk.renderer.arm_ids(desk.state.pose.scene, "left")
    corners = [(0, 0), (0, ids.shape[1] - 1), (ids.shape[0] - 1, 0), (ids.shape[0] - 1, ids.shape[1] - 1)]
    row, column = next((r, c) for r, c in corners if (ids[max(r - 20, 0) : r + 20, max(c - 20, 0) : c + 20] < 0).all())
    with pytest.raises(CartsError, match="no arm under the pointer"):
        desk.do(intents.DragLink(1.0, "left", (column + 0.5, row + 0.5), (column + 9.0, row + 9.0)))
    desk.do(intents.DragLink(1.0, "left", (column + 0.5, row + 0.5), (column + 30.0, row + 9.0)))
    assert desk.saved.position == 0 and not desk.state.unsaved


@pytest.mark.browser
def test_ctrl_and_the_mouse_drag_a_link_and_the_overlay_follows(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=1, width=640, height=480)
    tab = open_tab(app)
    renderer, scene = OverlayRenderer(app.sequence), app.scene
    ids = renderer.arm_ids(tab.state.pose.scene, "left")
    rows, columns = np.nonzero(ids == 0)
    middle = int(np.median(np.arange(len(rows))))
    place = columns[middle] + 0.5, rows[middle] + 0.5
    point = renderer.pick(tab.state.pose.scene, "left", place, 0.0)
    assert point is not None
    before, drawn = _seen(scene, tab.state, point), tab.page.evaluate("carts.drawnOverlay()")
    shown = tab.page.evaluate("carts.imageOnScreen()")
    tab.page.mouse.move(*tab.place(*place))
    tab.page.keyboard.down("Control")
    tab.page.mouse.down()
    for share in (0.25, 0.5, 0.75, 1.0):
        tab.page.mouse.move(*tab.place(place[0] + share * 24.0, place[1] + share * 16.0))
        tab.page.wait_for_timeout(60)
    # The overlay follows while the button is down, and the picture stays where it is.
    eventually(lambda: tab.page.evaluate("carts.drawnOverlay()"), lambda now: now != drawn)
    tab.page.mouse.up()
    tab.page.keyboard.up("Control")
    eventually(lambda: app.project.state.position, lambda position: position == 1)
    after = _seen(scene, tab.state, point)
    assert (after[0] - before[0], after[1] - before[1]) == pytest.approx((24.0, 16.0), abs=1.5)
    assert tab.page.evaluate("carts.imageOnScreen()") == shown
    tab.page.keyboard.press("Control+z")
    eventually(lambda: _seen(scene, tab.state, point), lambda seen: seen == pytest.approx(before, abs=0.05))
