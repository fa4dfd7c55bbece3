"""Path tracing: where things appear, how light falls off, and what happens without Mitsuba."""

import sys

import numpy as np
import pytest

from carts_core.errors import CartsError
from carts_core.lab.synthesis import EndoscopeConfig, RenderConfig, path_tracer
from carts_core.lab.synthesis.path_tracer import PathTracer, Stage
from carts_core.lab.synthesis.scene import Tissue, place_arms, place_cameras
from carts_core.model.camera import Camera
from carts_core.model.robot import Robot
from carts_core.model.scene import Arm, Scene
from carts_core.rendering import Renderer

JOINTS = np.array([[0.02, -0.05, 0.13, 0.3, 0.4, -0.3, 0.6]])


@pytest.fixture(scope="module")
def camera() -> Camera:
    (centred,) = place_cameras(EndoscopeConfig(width=200, height=150))
    fx, fy, cx, cy = centred.intrinsics
    # A principal point off the middle and an odd one at that: a sign error would show.
    return Camera("left", 200, 150, (fx, fy, cx + 7.0, cy - 11.0), centred.T_camera_world)


@pytest.fixture(scope="module")
def stage(shipped_psm: Robot, camera: Camera) -> Stage:
    arms = place_arms(shipped_psm, "tool_tip_link", camera)
    return Stage(arms, (JOINTS, JOINTS), np.zeros(1))


@pytest.fixture(scope="module")
def tracer(flat_tissue: Tissue) -> PathTracer:
    return PathTracer(flat_tissue, RenderConfig(samples=4))


def _truth(stage: Stage, camera: Camera, arms: tuple[Arm, ...]) -> np.ndarray:
    renderer = Renderer(Scene(arms, (camera,)), width=camera.width, height=camera.height)
    return renderer.segment(renderer.scene.state({arm.name: JOINTS[0] for arm in arms}))[0] >= 0


def test_each_surface_point_projects_onto_its_pixel(tracer: PathTracer, stage: Stage, camera: Camera) -> None:
    surface = tracer.surface(stage.parts(0), camera, seed=0)
    T, (fx, fy, cx, cy) = camera.T_camera_world, camera.intrinsics
    x, y, z = np.moveaxis(surface.position @ T[:3, :3].T + T[:3, 3], -1, 0)
    rows, columns = np.indices(z.shape)
    assert np.abs(fx * x / z + cx - columns - 0.5).max() <= 0.51
    assert np.abs(fy * y / z + cy - rows - 0.5).max() <= 0.51
    np.testing.assert_allclose(surface.depth, z)
    tissue = surface.link < 0
    assert np.abs(surface.position[tissue][:, 2]).max() < 1e-5
    np.testing.assert_allclose(surface.normal[tissue], np.broadcast_to([0, 0, 1], (tissue.sum(), 3)), atol=1e-4)
    assert (surface.link >= 0).sum() == pytest.approx(_truth(stage, camera, stage.arms).sum(), rel=0.03)


def test_without_mitsuba_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch, flat_tissue: Tissue) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    path_tracer._mitsuba.cache_clear()
    try:
        with pytest.raises(CartsError, match=r"pip install 'carts\[synthesis\]'"):
            PathTracer(flat_tissue, RenderConfig())
    finally:
        path_tracer._mitsuba.cache_clear()


def test_image_motion_follows_the_joints(tracer: PathTracer, shipped_psm: Robot, camera: Camera) -> None:
    arms = place_arms(shipped_psm, "tool_tip_link", camera)
    moving = np.concatenate([JOINTS, JOINTS])
    moving[1, 2] += 0.004
    stage = Stage(arms, (moving, np.concatenate([JOINTS, JOINTS])), np.array([0.0, 1.0]))
    surface = tracer.surface(stage.parts(0), camera, seed=0)
    motion = stage.motion_in_image(0, surface, camera, duration=0.5)
    links = len(shipped_psm.link_names)
    assert np.abs(motion[surface.link < 0]).max() == 0.0
    assert np.abs(motion[surface.link >= links]).max() < 1e-3
    length = np.linalg.norm(motion[(surface.link > 0) & (surface.link < links)], axis=-1)
    # The shaft moves 2 mm along its own direction, most of it across the picture, about 0.1 m away.
    full = camera.intrinsics[0] * 0.002 / 0.1
    assert 0.4 * full < np.median(length) < 1.5 * full
