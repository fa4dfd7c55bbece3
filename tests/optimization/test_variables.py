"""Unknowns as one vector."""

from pathlib import Path

import numpy as np
import pytest
import torch
from lab_robots import write_urdf
from tiny import tiny_scene

from carts_core.errors import CartsError
from carts_core.model.robot import Robot
from carts_core.model.scene import Scene
from carts_core.optimization import FreeParameters
from carts_core.optimization.variables import Variables

LENGTH_SCALE = 0.15


@pytest.fixture(scope="module")
def scene(shipped_psm: Robot) -> Scene:
    return tiny_scene(shipped_psm, 1, ("left", "right"), 96, 72).scene


def vector(scene: Scene, free: FreeParameters) -> Variables:
    q = np.array([0.1, 0.2, 0.15, 0.0, 0.1, -0.1, 0.3])
    return Variables(scene, scene.state({"PSM1": q}), free, LENGTH_SCALE)


def test_zero_offsets_are_the_start(scene: Scene) -> None:
    everything = FreeParameters(base_frames=True, extrinsics=True, intrinsics=True)
    parameters = vector(scene, everything)
    assert len(parameters) == 7 + 6 + 2 * (6 + 4)
    state = parameters.state(torch.zeros(len(parameters)))
    assert torch.allclose(state.joint_positions[0], parameters.start.joint_positions[0])
    assert torch.allclose(state.T_world_base, parameters.start.T_world_base)
    assert torch.allclose(state.T_camera_world, parameters.start.T_camera_world, atol=1e-6)
    assert torch.allclose(state.intrinsics, parameters.start.intrinsics)


def test_a_joint_without_limits_is_moved_by_at_most_half_a_turn(tmp_path: Path) -> None:
    urdf = write_urdf(tmp_path / "turning.urdf", {"turn": (-9.0, 9.0), "bend": (-9.0, 9.0)})
    text = urdf.read_text()
    urdf.write_text(text.replace("revolute", "continuous", 1))
    robot = Robot.load(urdf)
    assert robot.unlimited.tolist() == [True, False]
    np.testing.assert_allclose(robot.difference([3.1, 3.1], [-3.1, -3.1]), [6.2 - 2 * np.pi, 6.2])


def test_a_prismatic_joint_moves_by_the_lever(scene: Scene) -> None:
    parameters = vector(scene, FreeParameters())
    moved = parameters.state(torch.full((7,), 0.01)).joint_positions[0] - parameters.start.joint_positions[0]
    expected = torch.full((7,), 0.01)
    expected[2] = 0.01 * LENGTH_SCALE
    assert torch.allclose(moved, expected, atol=1e-6)


def test_every_kind_of_unknown_has_a_gradient(scene: Scene) -> None:
    parameters = vector(scene, FreeParameters(base_frames=True, extrinsics=True, intrinsics=True))
    offsets = torch.zeros(len(parameters), requires_grad=True)
    state = parameters.state(offsets)
    leaves = (state.joint_positions[0], state.T_world_base, state.T_camera_world, state.intrinsics)
    (gradient,) = torch.autograd.grad(torch.stack([leaf.cos().sum() + leaf.sum() for leaf in leaves]).sum(), offsets)
    assert torch.isfinite(gradient).all()
    assert (gradient != 0).float().mean() > 0.8


def test_frames_stay_rigid(scene: Scene) -> None:
    parameters = vector(scene, FreeParameters(joints=False, base_frames=True, extrinsics=True))
    state = parameters.state(0.3 * torch.randn(len(parameters), generator=torch.Generator().manual_seed(0)))
    for T in (*state.T_world_base, *state.T_camera_world):
        assert torch.allclose(T[:3, :3].T @ T[:3, :3], torch.eye(3), atol=1e-5)


def test_locked_joints_are_no_unknowns(scene: Scene) -> None:
    parameters = vector(scene, FreeParameters(locked_joints=("jaw", "PSM1/roll")))
    assert parameters.names == [f"PSM1/{j}" for j in ("yaw", "pitch", "insertion", "wrist_pitch", "wrist_yaw")]


def test_joint_limits_clamp_the_offsets(scene: Scene) -> None:
    parameters = vector(scene, FreeParameters())
    far = parameters.clamp(torch.full((7,), 100.0))
    joints = parameters.state(far).joint_positions[0]
    assert np.allclose(joints, scene.arms[0].robot.joint_limits[:, 1], atol=1e-5)


def test_a_start_outside_the_limits_may_stay(scene: Scene) -> None:
    q = np.array([0.1, 0.2, 0.15, 0.0, 0.1, -0.1, 3.0])
    parameters = Variables(scene, scene.state({"PSM1": q}), FreeParameters(), LENGTH_SCALE)
    assert float(parameters.clamp(torch.zeros(7)).abs().max()) == 0.0
    assert float(parameters.clamp(torch.ones(7))[-1]) == 0.0


@pytest.mark.parametrize(
    ("free", "message"),
    [
        (FreeParameters(joints=False), "no parameter is free"),
        (FreeParameters(locked_joints=("elbow",)), r"'elbow' does not exist.*insertion"),
        (FreeParameters(arms=("PSM9",)), r"there is no arm 'PSM9'. The arms are: PSM1"),
    ],
)
def test_impossible_unknowns_are_refused_in_words(scene: Scene, free: FreeParameters, message: str) -> None:
    with pytest.raises(CartsError, match=message):
        vector(scene, free)
