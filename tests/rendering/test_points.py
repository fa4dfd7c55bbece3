"""The surface point of each pixel: the compiled kernel against plain torch, and picking."""

from pathlib import Path

import numpy as np
import pytest
import torch
from slow_references import visible_points_ref
from torch import Tensor

from carts_core.model.keypoints import project_keypoints
from carts_core.model.scene import Scene, SceneState
from carts_core.recording import Sequence
from carts_core.rendering import Renderer, pick_point
from carts_core.rendering.rasterizer import (
    SceneGeometry,
    link_transforms,
    rasterize,
    vertices_in_camera,
    visible_points,
)

WIDTH, HEIGHT = 160, 120


@pytest.fixture(scope="module")
def views(sample_sequence_path: Path) -> tuple[SceneGeometry, Tensor, Tensor, Tensor, Tensor]:
    """Two arms in three views: as measured in two frames, and with nothing before the camera."""
    sequence = Sequence.open(sample_sequence_path)
    scene = sequence.scene.with_cameras([sequence.scene.cameras[0].name])
    geometry = SceneGeometry.of(scene)
    states = [scene.state(sequence.frame(index).measured) for index in (0, 9)]
    Ts = torch.cat([link_transforms(scene, state) for state in states]).float()
    Ts = torch.cat([Ts, Ts[:1] - torch.tensor([[0.0] * 4, [0.0] * 4, [0, 0, 0, 10], [0.0] * 4])])
    intrinsics = torch.cat([state.intrinsics for state in [*states, states[0]]]).float() * (WIDTH / 640)
    seen = [
        rasterize(vertices_in_camera(geometry, T).T.numpy(), geometry.faces.numpy(), K.tolist(), WIDTH, HEIGHT)
        for T, K in zip(Ts, intrinsics, strict=True)
    ]
    face_ids, inverse_depth = (torch.from_numpy(np.stack(arrays)) for arrays in zip(*seen, strict=True))
    return geometry, face_ids, inverse_depth, Ts, intrinsics


def test_the_compiled_kernel_agrees_with_torch(views: tuple[SceneGeometry, Tensor, Tensor, Tensor, Tensor]) -> None:
    compiled, plain = visible_points(*views), visible_points_ref(*views)
    assert {view for view, _, _ in compiled.groups} == {0, 1}
    assert compiled.groups == plain.groups
    assert torch.equal(compiled.pixel, plain.pixel) and torch.equal(compiled.face, plain.face)
    torch.testing.assert_close(compiled.point_link, plain.point_link, atol=1e-6, rtol=0)
    torch.testing.assert_close(compiled.normal_link, plain.normal_link, atol=1e-3, rtol=0)


def test_points_lie_where_their_pixels_look(views: tuple[SceneGeometry, Tensor, Tensor, Tensor, Tensor]) -> None:
    _, _, _, Ts, intrinsics = views
    points = visible_points(*views)
    moved, _ = points.transformed(Ts)
    K = points.intrinsics(intrinsics)
    column, row = K[:2] * moved[:2] / moved[2:] + K[2:] - 0.5
    inside = points.pixel % (WIDTH * HEIGHT)
    torch.testing.assert_close(column, (inside % WIDTH).float(), atol=1e-3, rtol=0)
    torch.testing.assert_close(row, (inside // WIDTH).float(), atol=1e-3, rtol=0)


def test_nothing_is_seen_where_nothing_is(views: tuple[SceneGeometry, Tensor, Tensor, Tensor, Tensor]) -> None:
    geometry, *rest = views
    face_ids, inverse_depth, Ts, intrinsics = (value[2:] for value in rest)
    for find in (visible_points, visible_points_ref):
        points = find(geometry, face_ids, inverse_depth, Ts, intrinsics)
        assert points.groups == () and points.point_link.shape == (3, 0)
        assert points.transformed(Ts)[0].shape == (3, 0)


def test_a_picked_point_projects_onto_its_pixel(scene_and_state: tuple[Scene, SceneState]) -> None:
    scene, state = scene_and_state
    renderer = Renderer(scene)
    links = renderer.segment_links(state)[0]
    rows, columns = np.nonzero(links >= 0)
    for index in np.linspace(0, len(rows) - 1, 25).astype(int):
        pixel = float(columns[index]) + 0.5, float(rows[index]) + 0.5
        point = pick_point(scene, renderer, state, pixel)
        assert point is not None
        assert point.link == links[rows[index], columns[index]]
        assert point.name == scene.arms[0].robot.link_names[point.link]
        assert project_keypoints(scene, state, [point], "left")[0].tolist() == pytest.approx(pixel, abs=1e-2)


def test_beside_the_arm_the_nearest_point_in_the_radius_is_picked(scene_and_state: tuple[Scene, SceneState]) -> None:
    scene, state = scene_and_state
    renderer = Renderer(scene)
    rows, columns = np.nonzero(renderer.segment_links(state)[0] >= 0)
    centres = np.column_stack([columns, rows]) + 0.5
    place = centres[columns.argmin()] + (-7.0, 0.0)
    distance = float(np.linalg.norm(centres - place, axis=-1).min())
    beside = float(place[0]), float(place[1])
    assert 0.5 < distance <= 7.0
    assert pick_point(scene, renderer, state, beside) is None
    assert pick_point(scene, renderer, state, beside, radius=distance - 0.1) is None
    assert pick_point(scene, renderer, state, beside, radius=distance + 0.1) is not None
