"""A scene that several tests of this folder look at."""

import numpy as np
import pytest
import torch
from tiny import tiny_scene

from carts_core.model.camera import Camera
from carts_core.model.robot import Robot
from carts_core.model.scene import Arm, Scene, SceneState

_JOINTS = [0.1, -0.1, 0.13, 0.3, 0.6, -0.5, 0.7]
_WIDTH, _HEIGHT = 96, 72


@pytest.fixture(scope="session")
def close_up(shipped_psm: Robot) -> tuple[Scene, SceneState]:
    """The tip of one arm, close up and from its side."""
    T_base_tip = shipped_psm.forward_kinematics(torch.tensor(_JOINTS).double())[-1].numpy()
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    T_camera_world[:3, 3] = -T_camera_world[:3, :3] @ T_base_tip[:3, 3] + [0, 0, 0.045]
    K = (1.1 * _WIDTH, 1.1 * _WIDTH, _WIDTH / 2, _HEIGHT / 2)
    camera = Camera("left", _WIDTH, _HEIGHT, K, T_camera_world)
    scene = Scene((Arm("PSM1", shipped_psm, np.eye(4)),), (camera,))
    return scene, scene.state({"PSM1": _JOINTS})


@pytest.fixture(scope="session")
def scene_and_state(shipped_psm: Robot) -> tuple[Scene, SceneState]:
    """One arm with its wrist bent, in a whole image of 640x480."""
    tiny = tiny_scene(shipped_psm, 1, ("left",), 640, 480)
    joint_positions = tiny.truth[0].copy()
    joint_positions[3:] = [0.4, 0.3, -0.2, 0.5]
    return tiny.scene, tiny.scene.state({"PSM1": joint_positions})
