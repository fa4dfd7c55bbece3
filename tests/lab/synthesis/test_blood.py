"""Blood on tissue and instruments."""

import numpy as np
import pytest

from carts_core.lab.synthesis import DomainConfig
from carts_core.lab.synthesis.domains import Bleeding
from carts_core.lab.synthesis.path_tracer import Surface
from carts_core.lab.synthesis.scene import Tissue, grow_tissue

H, W = 90, 120
EYE = np.array([0.0, 0.0, 0.1])
LIGHT = np.full((H, W, 3), 0.3, np.float32)


@pytest.fixture(scope="module")
def tissue() -> Tissue:
    return grow_tissue("muscle", 96, 512, np.random.default_rng(0))


def _bleeding(tissue: Tissue, **changes: float) -> Bleeding:
    return Bleeding(tissue, DomainConfig(**changes), np.random.default_rng(1))


def _looking_down(link: int = -1, shift: float = 0.0) -> Surface:
    """A level surface seen from above: 120 mm of tissue, or of a link that has moved along x."""
    y, x = np.meshgrid(np.linspace(-0.045, 0.045, H), np.linspace(-0.06, 0.06, W), indexing="ij")
    position = np.stack([x + shift, y, np.zeros_like(x)], axis=-1)
    normal = np.broadcast_to(np.array([0.0, 0.6, 0.8]), position.shape)
    return Surface(position, normal, np.full((H, W), link), np.full((H, W), 0.1))


def test_without_blood_the_picture_is_unchanged(tissue: Tissue) -> None:
    clean = _bleeding(tissue, blood_coverage=0.0, blood_on_tools=0.0)
    for link in (-1, 0):
        stained = clean.stain(LIGHT, _looking_down(link), {0: np.eye(4)}, EYE, 1.0)
        np.testing.assert_allclose(stained, LIGHT, atol=1e-6)


def test_blood_is_dark_and_red_and_covers_about_what_was_asked_for(tissue: Tissue) -> None:
    stained = _bleeding(tissue, blood_coverage=0.4).stain(LIGHT, _looking_down(), {0: np.eye(4)}, EYE, 1.0)
    bloody = stained[..., 1] < 0.3 * LIGHT[..., 1]
    assert 0.15 < bloody.mean() < 0.65
    assert (stained[bloody][:, 0] > 2.0 * stained[bloody][:, 1]).mean() > 0.95
    assert stained[bloody].mean() < 0.5 * LIGHT.mean()


def test_instruments_are_stained_in_part_and_never_hidden(tissue: Tissue) -> None:
    stained = _bleeding(tissue, blood_on_tools=0.3).stain(LIGHT, _looking_down(link=0), {0: np.eye(4)}, EYE, 1.0)
    touched = stained[..., 1] < 0.8 * LIGHT[..., 1]
    assert 0.1 < touched.mean() < 0.6


def test_blood_moves_with_the_instrument(tissue: Tissue) -> None:
    bleeding = _bleeding(tissue)
    T_world_link = np.eye(4)
    T_world_link[0, 3] = 0.02
    before = bleeding.stain(LIGHT, _looking_down(0), {0: np.eye(4)}, EYE, 0.0)
    after = bleeding.stain(LIGHT, _looking_down(0, shift=0.02), {0: T_world_link}, EYE, 0.0)
    np.testing.assert_allclose(before, after, atol=1e-5)


def test_pools_shine_where_they_mirror_the_light(tissue: Tissue) -> None:
    bleeding = _bleeding(tissue, blood_coverage=1.0)
    facing = _looking_down()
    to_eye = EYE - facing.position
    normal = to_eye / np.linalg.norm(to_eye, axis=-1, keepdims=True)
    mirror = Surface(facing.position, normal, facing.link, facing.depth)
    dull = bleeding.stain(LIGHT, facing, {}, EYE, 10.0)
    shiny = bleeding.stain(LIGHT, mirror, {}, EYE, 10.0)
    assert np.quantile(shiny[..., 1], 0.9) > 5.0 * np.quantile(dull[..., 1], 0.9)
