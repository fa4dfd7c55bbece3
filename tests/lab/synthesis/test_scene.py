"""Scenes of synthetic sequences: cameras, tissue and arms."""

import numpy as np
import pytest

from carts_core.lab.synthesis import EndoscopeConfig, SynthesisConfig
from carts_core.lab.synthesis.scene import EXTENT, KINDS, Tissue, grow_tissue, is_instrument, load_robot, place_cameras
from carts_core.model.camera import Camera
from carts_core.model.robot import Robot


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
