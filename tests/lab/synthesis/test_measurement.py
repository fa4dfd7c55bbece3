"""Measured joint positions."""

import numpy as np
import pytest

from carts_core.errors import SettingsError
from carts_core.lab.synthesis import MeasurementError
from carts_core.lab.synthesis.motion import measure

TIMES = np.arange(400) / 20.0


def _deviation(error: MeasurementError, seed: int = 0) -> np.ndarray:
    truth = np.random.default_rng(9).normal(size=(len(TIMES), len(error.bias)))
    return measure(truth, TIMES, error, np.random.default_rng(seed)) - truth


def test_a_bias_alone_is_constant_and_of_the_size_that_was_asked_for() -> None:
    deviation = _deviation(MeasurementError(bias=(0.02, 0.001), drift=(0.0, 0.0), noise=(0.0, 0.0)))
    assert np.ptp(deviation, axis=0).max() < 1e-12
    share = np.abs(deviation[0]) / [0.02, 0.001]
    assert (share >= 0.6).all() and (share <= 1.2).all()


def test_drift_is_slow_and_bounded() -> None:
    deviation = _deviation(MeasurementError(bias=(0.0,), drift=(0.01,), noise=(0.0,), drift_period=20.0))
    assert 0.001 < np.abs(deviation).max() <= 0.01
    assert np.abs(np.diff(deviation, axis=0)).max() < 0.01 * 2 * np.pi / (0.6 * 20.0) / 20.0 * 1.01


def test_noise_is_independent_from_frame_to_frame() -> None:
    deviation = _deviation(MeasurementError(bias=(0.0, 0.0), drift=(0.0, 0.0), noise=(0.001, 0.0)))
    assert deviation[:, 0].std() == pytest.approx(0.001, rel=0.15)
    assert abs(np.corrcoef(deviation[1:, 0], deviation[:-1, 0])[0, 1]) < 0.15
    assert np.abs(deviation[:, 1]).max() < 1e-12


def test_another_number_of_joints_is_refused_with_both_numbers() -> None:
    with pytest.raises(SettingsError, match="7 values per kind, but the robot has 3 joints"):
        measure(np.zeros((4, 3)), np.arange(4.0), MeasurementError(), np.random.default_rng(0))


def test_bias_drift_and_noise_must_have_the_same_length() -> None:
    with pytest.raises(SettingsError, match="2, 1 and 2 values"):
        MeasurementError(bias=(0.0, 0.0), drift=(0.0,), noise=(0.0, 0.0))
