"""Scenes of synthetic sequences: cameras, tissue, arms and their motion."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from carts_core.errors import SettingsError
from carts_core.lab.synthesis import EndoscopeConfig, MeasurementError, MotionConfig, SynthesisConfig
from carts_core.lab.synthesis.motion import measure, plan_motion, reach_tip
from carts_core.lab.synthesis.scene import (
    EXTENT,
    KINDS,
    Tissue,
    grow_tissue,
    is_instrument,
    load_robot,
    place_arms,
    place_cameras,
)
from carts_core.model.camera import Camera
from carts_core.model.robot import Robot
from carts_core.model.scene import Arm, Scene
from carts_core.rendering import Renderer


@pytest.fixture(scope="module")
def tissues() -> dict[str, Tissue]:
    return {kind: grow_tissue(kind, 64, 512, np.random.default_rng(4)) for kind in KINDS}


def test_the_mesh_faces_up_and_agrees_with_the_height_field(tissues: dict[str, Tissue]) -> None:
    tissue = tissues["muscle"]
    vertices, normals, faces, uv = tissue.mesh()
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    assert np.cross(b - a, c - a)[:, 2].min() > 0.0
    assert normals[:, 2].min() > 0.0
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0)
    np.testing.assert_allclose(tissue.height(vertices[:, 0], vertices[:, 1]), vertices[:, 2], atol=1e-6)
    np.testing.assert_allclose((uv - 0.5) * EXTENT, vertices[:, :2], atol=1e-12)


ARM_URDF = """<robot name="two"><link name="a"/><link name="b"><visual><geometry><box size="0.1 0.1 0.1"/></geometry>
</visual></link><joint name="turn" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def _project(camera: Camera, point: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy = camera.intrinsics
    x, y, z = (camera.T_camera_world @ np.append(point, 1.0))[:3]
    return np.array([fx * x / z + cx, fy * y / z + cy, z])


def test_the_camera_looks_at_the_middle_of_the_scene_from_its_distance() -> None:
    (camera,) = place_cameras(EndoscopeConfig(distance=0.11, elevation=1.0))
    u, v, z = _project(camera, np.array([0.0, 0.0, 0.006]))
    assert (u, v, z) == pytest.approx((320.0, 240.0, 0.11))


def test_the_right_camera_stands_one_baseline_to_the_right() -> None:
    left, right = place_cameras(EndoscopeConfig(stereo=True, baseline=0.006))
    T_left_right = left.T_camera_world @ np.linalg.inv(right.T_camera_world)
    np.testing.assert_allclose(T_left_right[:3, 3], [0.006, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(T_left_right[:3, :3], np.eye(3), atol=1e-12)


def test_a_robot_that_is_not_a_psm_is_no_instrument(tmp_path, shipped_psm: Robot) -> None:
    urdf = tmp_path / "two.urdf"
    urdf.write_text(ARM_URDF)
    assert is_instrument(shipped_psm) and not is_instrument(load_robot(SynthesisConfig(robot=urdf)))


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
        low, high = arm.robot.joint_limits.T
        assert (positions > low + 0.02).all() and (positions < high - 0.02).all()
    for frame in range(len(joints[0])):
        left, right = (_vertices(arm, positions[frame]) for arm, positions in zip(arms, joints, strict=True))
        assert KDTree(left).query(right)[0].min() > 0.0005
        assert min(left[:, 2].min(), right[:, 2].min()) > 0.0005
        state = renderer.scene.state({arm.name: positions[frame] for arm, positions in zip(arms, joints, strict=True)})
        ids = renderer.segment(state)[0]
        assert all((ids == arm).mean() > 0.01 for arm in range(2))


@pytest.mark.parametrize("distance", [0.05, 0.16])
def test_instruments_move_at_every_allowed_distance(shipped_psm: Robot, flat_tissue: Tissue, distance: float) -> None:
    config = replace(CONFIG, endoscope=EndoscopeConfig(distance=distance))
    (camera,) = place_cameras(config.endoscope)
    arms = place_arms(shipped_psm, config.tip_link, camera)
    left, right = plan_motion(arms, [flat_tissue], camera, config)
    assert left.shape == right.shape == (8, 7)


def test_a_motion_in_depth_that_cannot_be_done_says_why(
    arms: tuple[Arm, ...], camera: Camera, flat_tissue: Tissue
) -> None:
    narrow = replace(camera, intrinsics=(50.0, 50.0, 320.0, 240.0))
    config = SynthesisConfig(motion=MotionConfig(frames=8, reach=(0.001, 0.1, 0.1)))
    with pytest.raises(SettingsError, match=r"a tip is too close to the camera or too far from it \(\d+\)"):
        plan_motion(arms, [flat_tissue], narrow, config)


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
