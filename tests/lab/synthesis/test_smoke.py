"""Smoke in space, and smoke painted over the picture."""

import numpy as np
import pytest

from carts_core.lab.synthesis import DomainConfig
from carts_core.lab.synthesis.domains import Smoke, SmokeOverlay

EYE = np.zeros(3)
H, W = 60, 80


def _positions(depth: float | np.ndarray) -> np.ndarray:
    """Points at a depth behind each pixel of a pinhole of 60 degrees."""
    rows, columns = np.indices((H, W))
    rays = np.stack([(columns - W / 2) / 70, (rows - H / 2) / 70, np.ones((H, W))], axis=-1)
    return rays * np.broadcast_to(depth, (H, W))[..., None]


def _smoke(**changes: float) -> Smoke:
    return Smoke(DomainConfig(**changes), np.random.default_rng(2))


def test_the_mean_density_is_the_one_asked_for_and_it_is_dense_in_places() -> None:
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (20000, 3))
    density = _smoke(smoke_density=8.0).density(points, 0.0)
    assert density.min() > 0.0
    assert density.mean() == pytest.approx(8.0, rel=0.15)
    assert np.quantile(density, 0.95) > 3.0 * np.quantile(density, 0.3)


def test_no_smoke_changes_nothing() -> None:
    light = np.random.default_rng(0).uniform(0, 1, (H, W, 3)).astype(np.float32)
    np.testing.assert_allclose(_smoke(smoke_density=0.0).haze(light, _positions(0.1), EYE, 10.0, 0.0), light, atol=1e-6)


def test_what_is_farther_away_loses_more_contrast() -> None:
    board = np.indices((H, W)).sum(axis=0) % 2
    light = np.repeat(0.1 + 0.4 * board[..., None], 3, axis=-1).astype(np.float32)
    contrast = []
    for depth in (0.04, 0.09, 0.14):
        seen = _smoke().haze(light, _positions(depth), EYE, 10.0, 0.0)[..., 0]
        contrast.append((seen[board == 1].mean() - seen[board == 0].mean()) / seen.mean())
    assert contrast[0] > 1.2 * contrast[1] > 1.2 * 1.1 * contrast[2]


def test_an_instrument_in_front_stays_sharp_against_the_hazy_background() -> None:
    depth = np.full((H, W), 0.15)
    depth[:, : W // 2] = 0.03
    seen = _smoke().haze(np.zeros((H, W, 3), np.float32), _positions(depth), EYE, 10.0, 0.0)[..., 0]
    steps = np.abs(np.diff(seen, axis=1)).mean(axis=0)
    assert np.argmax(steps) == W // 2 - 1
    assert steps.max() > 4.0 * np.median(steps)


def test_light_on_smoke_brightens_the_dark() -> None:
    black = np.zeros((H, W, 3), np.float32)
    weak, strong = (_smoke().haze(black, _positions(0.1), EYE, lamp, 0.0) for lamp in (5.0, 10.0))
    assert weak.min() > 0.0
    np.testing.assert_allclose(strong, 2.0 * weak, rtol=1e-4)


def test_smoke_moves() -> None:
    smoke = _smoke()
    points = _positions(0.1)
    now, soon, later = (smoke.density(points, time) for time in (0.0, 0.1, 3.0))
    assert 0.0 < np.abs(soon - now).mean() < 0.5 * np.abs(later - now).mean()


def test_the_overlay_is_blind_to_depth_but_smooth_and_never_dark() -> None:
    overlay = SmokeOverlay(0.5, np.random.default_rng(1))
    black = np.zeros((H, W, 3), np.uint8)
    layer = overlay.over(black)
    assert np.array_equal(layer, overlay.over(black))
    assert 60 < layer.mean() < 150
    assert layer.std() > 10
    white = np.full((H, W, 3), 205, np.uint8)
    assert np.array_equal(overlay.over(white), white)
    assert not np.array_equal(overlay.over(black, time=1.0), layer)
