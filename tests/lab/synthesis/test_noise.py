"""Smooth random fields."""

import numpy as np
import pytest

from carts_core.lab.synthesis.scene import smooth_noise, smoothstep


@pytest.mark.parametrize("shape", [(64,), (48, 64), (24, 16, 20)])
def test_noise_has_zero_mean_and_unit_variance_in_any_dimension(shape: tuple[int, ...]) -> None:
    field = smooth_noise(shape, 8.0, np.random.default_rng(0), octaves=2)
    assert field.shape == shape
    assert abs(field.mean()) < 1e-4
    assert field.std() == pytest.approx(1.0, abs=1e-4)


def test_longer_wavelengths_are_smoother_and_the_field_continues_over_its_border() -> None:
    fine, coarse = (smooth_noise((256, 256), length, np.random.default_rng(1)) for length in (8.0, 64.0))
    slope_fine, slope_coarse = (np.abs(np.diff(field, axis=1)).mean() for field in (fine, coarse))
    assert slope_fine == pytest.approx(8.0 * slope_coarse, rel=0.35)
    assert np.abs(coarse[:, 0] - coarse[:, -1]).mean() < 2.0 * slope_coarse


def test_the_same_seed_gives_the_same_noise() -> None:
    first, again, other = (smooth_noise((32, 32), 8.0, np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)


def test_smoothstep_goes_from_zero_to_one_and_stays_there() -> None:
    value = smoothstep(np.array([-1.0, 0.0, 0.5, 1.0, 2.0]), 0.0, 1.0)
    np.testing.assert_allclose(value, [0.0, 0.0, 0.5, 1.0, 1.0])
