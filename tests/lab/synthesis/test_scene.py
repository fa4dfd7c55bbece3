"""Scenes of synthetic sequences: cameras, tissue and arms."""

import numpy as np
import pytest
import torch

from carts_core.errors import RobotError
from carts_core.lab.synthesis import EndoscopeConfig, SynthesisConfig
from carts_core.lab.synthesis.scene import (
    EXTENT,
    KINDS,
    WORK_POINTS,
    Tissue,
    grow_tissue,
    is_instrument,
    load_robot,
    place_arms,
    place_cameras,
)
from carts_core.model.camera import Camera
from carts_core.model.robot import Robot


@pytest.fixture(scope="module")
def tissues() -> dict[str, Tissue]:
    return {kind: grow_tissue(kind, 64, 512, np.random.default_rng(4)) for kind in KINDS}


@pytest.mark.parametrize("kind", KINDS)
def test_tissue_is_redder_than_blue_and_physically_possible(tissues: dict[str, Tissue], kind: str) -> None:
    albedo = tissues[kind].albedo
    assert albedo.min() > 0.0
    assert albedo.max() <= 0.9
    assert (albedo[..., 0].mean() > 1.3 * albedo[..., 2].mean()) and albedo.std() > 0.01


def test_kinds_look_different(tissues: dict[str, Tissue]) -> None:
    means = np.array([tissue.albedo.mean(axis=(0, 1)) for tissue in tissues.values()])
    distances = np.linalg.norm(means[:, None] - means[None], axis=-1) + np.eye(len(means))
    assert distances.min() > 0.03


@pytest.mark.parametrize("kind", KINDS)
def test_the_middle_is_flat_enough_to_work_over_and_walls_rise_around_it(tissues: dict, kind: str) -> None:
    x, y = np.meshgrid(np.linspace(-0.03, 0.03, 20), np.linspace(-0.03, 0.03, 20))
    assert np.abs(tissues[kind].height(x, y)).max() < 0.025
    assert tissues[kind].height(np.array([0.12]), np.array([0.12]))[0] > 0.04


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


def test_up_in_the_world_is_up_in_the_picture_and_right_is_right() -> None:
    (camera,) = place_cameras(EndoscopeConfig())
    middle, higher, right = (_project(camera, np.array(p)) for p in ([0, 0, 0.0], [0, 0, 0.01], [0.01, 0, 0.0]))
    assert higher[1] < middle[1]
    assert right[0] > middle[0]


def test_the_right_camera_stands_one_baseline_to_the_right() -> None:
    left, right = place_cameras(EndoscopeConfig(stereo=True, baseline=0.006))
    T_left_right = left.T_camera_world @ np.linalg.inv(right.T_camera_world)
    np.testing.assert_allclose(T_left_right[:3, 3], [0.006, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(T_left_right[:3, :3], np.eye(3), atol=1e-12)


def test_with_joints_at_zero_both_instruments_point_at_their_work(shipped_psm: Robot) -> None:
    (camera,) = place_cameras(EndoscopeConfig())
    for arm, work in zip(place_arms(shipped_psm, "tool_tip_link", camera), WORK_POINTS, strict=True):
        assert np.linalg.det(arm.T_world_base[:3, :3]) == pytest.approx(1.0)
        joints = torch.zeros(7, dtype=torch.float64)
        joints[2] = 0.12
        tip = (arm.T_world_base @ arm.robot.link_transform(joints, "tool_tip_link").numpy())[:3, 3]
        centre = arm.T_world_base[:3, 3]
        reach, target = tip - centre, np.array(work) - centre
        assert np.linalg.norm(np.cross(reach, target)) < 1e-6
        assert 0.10 < np.linalg.norm(target) < 0.16  # the remote centre is as far as in a real setup


def test_a_robot_that_is_not_a_psm_is_no_instrument(tmp_path, shipped_psm: Robot) -> None:
    urdf = tmp_path / "two.urdf"
    urdf.write_text(ARM_URDF)
    assert is_instrument(shipped_psm) and not is_instrument(load_robot(SynthesisConfig(robot=urdf)))


def test_a_robot_that_cannot_move_is_refused(tmp_path) -> None:
    urdf = tmp_path / "stiff.urdf"
    urdf.write_text(ARM_URDF.replace('type="revolute"', 'type="fixed"'))
    with pytest.raises(RobotError, match="no joint that moves"):
        load_robot(SynthesisConfig(robot=urdf))
