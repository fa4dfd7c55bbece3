"""Made-up tissue."""

import numpy as np
import pytest

from carts_core.lab.synthesis.scene import EXTENT, KINDS, Tissue, grow_tissue


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
