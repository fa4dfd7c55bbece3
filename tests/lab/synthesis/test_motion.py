"""Motion of the arms, and its erroneous measurement."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from carts_core.errors import SettingsError
from carts_core.lab.synthesis import EndoscopeConfig, MeasurementError, MotionConfig, SynthesisConfig
from carts_core.lab.synthesis.motion import measure, plan_motion, reach_tip
from carts_core.lab.synthesis.scene import Tissue, place_arms, place_cameras
from carts_core.model.camera import Camera
from carts_core.model.robot import Robot
from carts_core.model.scene import Arm, Scene
from carts_core.rendering import Renderer

CONFIG = SynthesisConfig(seed=11, motion=MotionConfig(frames=8, frame_rate=4.0))


@pytest.fixture(scope="module")
def camera() -> Camera:
    return place_cameras(EndoscopeConfig())[0]


@pytest.fixture(scope="module")
def arms(shipped_psm: Robot, camera: Camera) -> tuple[Arm, ...]:
    return place_arms(shipped_psm, CONFIG.tip_link, camera)


@pytest.fixture(scope="module")
def joints(arms: tuple[Arm, ...], camera: Camera, flat_tissue: Tissue) -> tuple[np.ndarray, ...]:
    return plan_motion(arms, [flat_tissue], camera, CONFIG)


def _vertices(arm: Arm, positions: np.ndarray) -> np.ndarray:
    Ts = arm.T_world_base @ arm.robot.forward_kinematics(torch.from_numpy(positions)).numpy()
    return np.concatenate([m.vertices @ Ts[m.link][:3, :3].T + Ts[m.link][:3, 3] for m in arm.robot.meshes])


def test_inverse_kinematics_brings_the_tip_to_its_target(arms: Sequence[Arm]) -> None:
    rng = np.random.default_rng(0)
    targets = rng.uniform(-0.02, 0.02, (20, 3)) + np.array([0.0, 0.0, 0.02])
    start = np.zeros((20, 7))
    start[:, 2] = 0.14
    start[:, 3:] = rng.uniform(-0.7, 0.7, (20, 4))
    for arm in arms:
        found = reach_tip(arm, CONFIG.tip_link, targets, start)
        tips = (arm.T_world_base @ arm.robot.link_transform(torch.from_numpy(found), CONFIG.tip_link).numpy())[:, :3, 3]
        np.testing.assert_allclose(tips, targets, atol=1e-9)
        np.testing.assert_array_equal(found[:, 3:], start[:, 3:])


def test_a_plan_keeps_within_limits_touches_nothing_and_stays_in_view(
    arms: tuple[Arm, ...], joints: Sequence[np.ndarray], flat_tissue: Tissue, camera: Camera
) -> None:
    renderer = Renderer(Scene(arms, (camera,)), width=160, height=120)
    for arm, positions in zip(arms, joints, strict=True):
        low, high = arm.robot.joint_limits.numpy().T
        assert (positions > low + 0.02).all() and (positions < high - 0.02).all()
    for frame in range(len(joints[0])):
        left, right = (_vertices(arm, positions[frame]) for arm, positions in zip(arms, joints, strict=True))
        assert KDTree(left).query(right)[0].min() > 0.0005
        assert min(left[:, 2].min(), right[:, 2].min()) > 0.0005
        state = renderer.scene.state({arm.name: positions[frame] for arm, positions in zip(arms, joints, strict=True)})
        ids = renderer.segment(state)[0]
        assert all((ids == arm).mean() > 0.01 for arm in range(2))


def test_a_motion_that_cannot_be_done_says_why(arms: tuple[Arm, ...], camera: Camera, flat_tissue: Tissue) -> None:
    config = SynthesisConfig(motion=MotionConfig(frames=8, reach=(0.1, 0.1, 0.001)))
    with pytest.raises(
        SettingsError, match=r"none of \d+ random motions satisfies.*a tip leaves the image.*motion.reach"
    ):
        plan_motion(arms, [flat_tissue], camera, config)


def test_a_measurement_has_a_constant_bias_and_independent_noise() -> None:
    times, truth = np.arange(400) / 20.0, np.random.default_rng(9).normal(size=(400, 2))
    error = MeasurementError(bias=(0.02, 0.0), drift=(0.0, 0.0), noise=(0.0, 0.001))
    deviation = measure(truth, times, error, np.random.default_rng(0)) - truth
    assert np.ptp(deviation[:, 0]) < 1e-12 and 0.6 * 0.02 <= abs(deviation[0, 0]) <= 1.2 * 0.02
    assert deviation[:, 1].std() == pytest.approx(0.001, rel=0.15)
    assert abs(np.corrcoef(deviation[1:, 1], deviation[:-1, 1])[0, 1]) < 0.15
