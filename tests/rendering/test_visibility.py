"""The fast visibility kernels against ray casting."""

import numpy as np
import pytest
import torch
import trimesh
from slow_references import visibility_ref
from tiny import tiny_scene

from carts_core.model.meshes import is_closed
from carts_core.model.robot import Robot
from carts_core.recording import Sequence
from carts_core.rendering import Renderer, visibility
from carts_core.rendering.rasterizer import SceneGeometry, link_transforms, rasterize, vertices_in_camera
from carts_core.resources import sample_sequence

INTRINSICS = (30.0, 34.0, 17.3, 11.8)
WIDTH, HEIGHT = 36, 24


def random_triangles(seed: int, count: int = 60, *, near: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of many sizes in front of, behind and across the camera."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform([-0.15, -0.1, near], [0.15, 0.1, 0.4], (count, 1, 3))
    corners = centres + rng.normal(0, 0.05, (count, 3, 3))
    return corners.reshape(-1, 3).astype(np.float32), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def same_surface(ids: np.ndarray, depth: np.ndarray, ids_ref: torch.Tensor, depth_ref: torch.Tensor) -> None:
    """Equal up to pixels whose centre lies on an edge within rounding."""
    different = ids != ids_ref.numpy()
    assert different.mean() < 0.005
    assert np.allclose(depth[~different], depth_ref.numpy()[~different], rtol=1e-4)


@pytest.mark.parametrize("near", [0.1, -0.05])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_compiled_kernel_sees_what_rays_hit(seed: int, near: float) -> None:
    vertices, faces = random_triangles(seed, near=near)
    ids, depth = visibility(vertices, faces, INTRINSICS, WIDTH, HEIGHT)
    assert (ids >= 0).mean() > 0.3
    same_surface(ids, depth, *visibility_ref(torch.tensor(vertices), torch.tensor(faces), INTRINSICS, WIDTH, HEIGHT))


def test_shared_edges_leave_no_gap() -> None:
    vertices = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], np.float32)
    ids, _ = visibility(vertices, np.array([[0, 1, 2], [0, 2, 3]]), (10.0, 10.0, 18.0, 12.0), WIDTH, HEIGHT)
    assert (ids[3:21, 9:27] >= 0).all()


def closed_bodies(seed: int, count: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes and balls before, across, around and behind the camera, and which of them a triangle is part of."""
    rng = np.random.default_rng(seed)
    vertices, faces, surfaces = [], [], []
    for index in range(count):
        body = trimesh.creation.icosphere(subdivisions=2) if index % 2 else trimesh.creation.box()
        body.apply_scale(rng.uniform(0.02, 0.15, 3))
        body.apply_transform(trimesh.transformations.random_rotation_matrix(rng.uniform(size=3)))
        body.apply_translation(rng.uniform([-0.2, -0.2, -0.1], [0.2, 0.2, 0.4]))
        faces.append(body.faces + sum(map(len, vertices)))
        vertices.append(body.vertices)
        surfaces.append(np.full(len(body.faces), index))
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(surfaces)


def test_skipping_the_backs_of_closed_surfaces_changes_nothing() -> None:
    for seed in range(20):
        vertices, faces, surfaces = closed_bodies(seed)
        every = rasterize(vertices, faces, INTRINSICS, WIDTH, HEIGHT)
        fronts = rasterize(vertices, faces, INTRINSICS, WIDTH, HEIGHT, surfaces)
        for front, each in zip(fronts, every, strict=True):
            np.testing.assert_array_equal(front, each, err_msg=f"seed {seed}")


def test_the_inside_of_a_closed_surface_is_seen_from_within() -> None:
    room = trimesh.creation.box((1.0, 1.0, 1.0))
    ids, inverse_depth = rasterize(room.vertices, room.faces, INTRINSICS, WIDTH, HEIGHT, np.zeros(12, int))
    assert (ids >= 0).all()
    np.testing.assert_allclose(1.0 / inverse_depth[HEIGHT // 2, WIDTH // 2], 0.5, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "closed"), [("none", True), ("hole", False), ("inside out", False), ("one part inside out", False)]
)
def test_what_counts_as_closed(change: str, closed: bool) -> None:
    box, small = trimesh.creation.box(), trimesh.creation.box((0.1, 0.1, 0.1))
    small.apply_translation([2.0, 0.0, 0.0])
    if change == "inside out":
        box.invert()
    if change == "one part inside out":
        small.invert()
    body = trimesh.graph.smooth_shade(trimesh.util.concatenate([box, small]), angle=0.5)
    faces = np.array(body.faces)[int(change == "hole") :]
    assert len(body.vertices) == 48
    assert is_closed(np.array(body.vertices), faces) == closed


def test_the_shipped_arms_look_the_same_without_their_backs() -> None:
    sequence = Sequence.open(sample_sequence())
    geometry = SceneGeometry.of(sequence.scene)
    surfaces = geometry.face_surfaces.numpy()
    assert (surfaces >= 0).all()
    for index in (0, 12):
        state = sequence.scene.state(sequence.frame(index).measured)
        vertices = vertices_in_camera(geometry, link_transforms(sequence.scene, state)[0]).T.numpy()
        view = (vertices, geometry.faces.numpy(), state.intrinsics[0].tolist(), 640, 480)
        for fronts, every in zip(rasterize(*view, surfaces), rasterize(*view), strict=True):
            np.testing.assert_array_equal(fronts, every)


def test_views_are_in_the_order_of_the_names_that_are_given(shipped_psm: Robot) -> None:
    tiny = tiny_scene(shipped_psm, 1, ("left", "right"), 96, 72)
    state = tiny.scene.state({"PSM1": tiny.truth[0]})
    left, right = Renderer(tiny.scene).segment(state)
    assert (left != right).any()
    for names in (["right", "left"], ["right"], ["left"], ["left", "right"]):
        seen = Renderer(tiny.scene, cameras=names).segment(state)
        for name, view in zip(names, seen, strict=True):
            assert np.array_equal(view, {"left": left, "right": right}[name])
