"""Named points of an arm."""

import numpy as np
import torch
from tiny import tiny_scene

from carts_core.model.keypoints import keypoints, project_keypoints
from carts_core.model.robot import Robot
from carts_core.model.scene import Arm


def test_the_shipped_instrument_has_both_tips_and_the_wrist(shipped_psm: Robot) -> None:
    points = keypoints(Arm("PSM1", shipped_psm, np.eye(4)))
    assert [point.name for point in points] == ["jaw 1 tip", "jaw 2 tip", "wrist yaw joint", "wrist pitch joint"]


def test_keypoints_are_where_the_urdf_has_them(shipped_psm: Robot) -> None:
    points = keypoints(Arm("PSM1", shipped_psm, np.eye(4)))
    joints = torch.tensor([0.2, -0.1, 0.15, 0.5, 0.4, -0.3, 0.0], dtype=torch.float64)
    Ts = shipped_psm.forward_kinematics(joints)
    places = [(Ts[p.link, :3, :3] @ torch.tensor(p.position).double() + Ts[p.link, :3, 3]).numpy() for p in points]
    # With closed jaws both tips are at the tool tip, but for the jaws' own width.
    tool_tip = shipped_psm.link_transform(joints, "tool_tip_link")[:3, 3].numpy()
    assert [np.linalg.norm(place - tool_tip) < 1.2e-3 for place in places] == [True, True, False, False]
    for place, link in zip(places[2:], ("wrist_yaw_link", "wrist_pitch_link"), strict=True):
        assert np.allclose(place, shipped_psm.link_transform(joints, link)[:3, 3].numpy(), atol=1e-9)


def test_projection_agrees_with_the_camera_matrix_and_is_nan_behind_it(shipped_psm: Robot) -> None:
    tiny = tiny_scene(shipped_psm, 1, ("left",), 640, 480)
    (point, *_), camera = keypoints(tiny.scene.arms[0]), tiny.scene.cameras[0]
    state = tiny.scene.state({"PSM1": tiny.truth[0]})
    T = camera.T_camera_world @ shipped_psm.forward_kinematics(torch.tensor(tiny.truth[0]))[point.link].numpy()
    x, y, w = camera.K @ (T @ [*point.position, 1.0])[:3]
    (pixel,) = project_keypoints(tiny.scene, state, [point], "left")
    assert np.allclose(pixel, [x / w, y / w], atol=1e-2)
    turned = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    behind = tiny.scene.state({"PSM1": tiny.truth[0]})
    behind.T_camera_world[0] = turned @ behind.T_camera_world[0]
    assert project_keypoints(tiny.scene, behind, [point], "left").isnan().all()
