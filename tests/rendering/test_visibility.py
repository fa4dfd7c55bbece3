"""The fast visibility kernels against ray casting."""

import numpy as np
import pytest
import torch

from carts_core.rendering import visibility, visibility_torch
from carts_core.rendering.reference import visibility_ref

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


@pytest.mark.parametrize("near", [0.1, -0.05])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_torch_kernel_agrees_with_the_compiled_one(seed: int, near: float) -> None:
    vertices, faces = random_triangles(seed, near=near)
    ids, depth = visibility(vertices, faces, INTRINSICS, WIDTH, HEIGHT)
    other = visibility_torch(torch.tensor(vertices), torch.tensor(faces), torch.tensor(INTRINSICS), WIDTH, HEIGHT)
    same_surface(ids, depth, *other)


@pytest.mark.gpu
def test_the_torch_kernel_gives_the_same_on_a_gpu() -> None:
    vertices, faces = random_triangles(0)
    ids, depth = visibility(vertices, faces, INTRINSICS, WIDTH, HEIGHT)
    points, triangles, intrinsics = (torch.tensor(array).cuda() for array in (vertices, faces, np.array(INTRINSICS)))
    other_ids, other_depth = visibility_torch(points, triangles, intrinsics, WIDTH, HEIGHT)
    same_surface(ids, depth, other_ids.cpu(), other_depth.cpu())


def test_a_triangle_that_passes_the_camera_keeps_its_visible_part() -> None:
    vertices = np.array([[-0.01, 0.01, 0.3], [0.01, 0.01, 0.3], [0.0, 0.02, -0.2]], np.float32)
    ids, depth = visibility(vertices, np.array([[0, 1, 2]]), INTRINSICS, WIDTH, HEIGHT)
    assert (ids >= 0).sum() > 10
    assert depth[ids >= 0].min() < 0.2


def test_a_triangle_behind_the_camera_is_not_seen() -> None:
    vertices = np.array([[-0.1, -0.1, -0.3], [0.1, -0.1, -0.3], [0.0, 0.1, -0.3]], np.float32)
    ids, depth = visibility(vertices, np.array([[0, 1, 2]]), INTRINSICS, WIDTH, HEIGHT)
    assert (ids == -1).all() and (depth == 0).all()


def test_shared_edges_leave_no_gap() -> None:
    vertices = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], np.float32)
    ids, _ = visibility(vertices, np.array([[0, 1, 2], [0, 2, 3]]), (10.0, 10.0, 18.0, 12.0), WIDTH, HEIGHT)
    assert (ids[3:21, 9:27] >= 0).all()
