"""Consecutive measurements: the smoothed result does not depend on the time of the query."""

import math

import numpy as np
import pytest

from carts_core.optimization.kalman import ErrorModel, Gaussian, Information, Smoother
from carts_core.settings import SequenceSettings

N = 3
GAPS = {4: 0.0, 5: 0.5, 7: 0.1, 8: 2.0, 9: 0.3}
MEMORY = 0.5
MODEL = ErrorModel(SequenceSettings(drift_deg=0.8, drift_seconds=1.5, jitter_deg=0.3), np.radians([2.0, 2.0, 0.5]))


def information(seed: int) -> Information:
    rng = np.random.default_rng(seed)
    jacobian = rng.standard_normal((2, N)) * 60
    precision = jacobian.T @ jacobian
    return Information(precision, precision @ (rng.standard_normal(N) * 0.03))


def fed(gaps: dict[int, float], *, exact: tuple[int, ...] = ()) -> Smoother:
    smoother = Smoother(MODEL, gaps, MEMORY, exact)
    for index in gaps:
        smoother.add(index, information(index))
    return smoother


def assert_same(one: Gaussian, other: Gaussian) -> None:
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_asking_in_between_changes_nothing() -> None:
    curious = Smoother(MODEL, GAPS, MEMORY, ())
    for index in GAPS:
        curious.expected(index)
        curious.add(index, information(index))
        curious.smoothed()
    expected = fed(GAPS).smoothed()
    assert list(expected) == list(GAPS)
    for index, found in curious.smoothed().items():
        assert_same(found, expected[index])


@pytest.mark.parametrize("asked", [False, True])
def test_after_a_restart_neither_side_informs_the_other(asked: bool) -> None:
    smoother = Smoother(MODEL, GAPS, MEMORY, ())
    for index in GAPS:
        if asked:
            smoother.smoothed()
        if index == 7:
            smoother.restart(index)
            assert_same(smoother.expected(index), MODEL.correction(MODEL.initial()))
        smoother.add(index, information(index))
    apart = {index: math.inf if index == 7 else gap for index, gap in GAPS.items()}
    expected = fed(apart).smoothed()
    for index, found in smoother.smoothed().items():
        assert_same(found, expected[index])
    alone = Smoother(MODEL, apart, MEMORY, ())
    for index in (4, 5):
        alone.add(index, information(index))
    for index, found in alone.smoothed().items():
        assert np.allclose(found.mean, expected[index].mean, rtol=1e-9, atol=1e-12)


def test_another_measurement_of_a_frame_takes_the_place_of_the_first() -> None:
    smoother = fed(GAPS)
    before = smoother.smoothed()
    smoother.replace(7, information(77))
    other = Smoother(MODEL, GAPS, MEMORY, ())
    for index in GAPS:
        other.add(index, information(77 if index == 7 else index))
    for index, found in smoother.smoothed().items():
        assert_same(found, other.smoothed()[index])
        assert not np.allclose(found.mean, before[index].mean)


def test_a_frame_that_could_not_be_read_is_passed_over() -> None:
    smoother = Smoother(MODEL, GAPS, MEMORY, ())
    for index in (4, 5, 8):
        smoother.add(index, information(index))
    assert list(smoother.smoothed()) == [4, 5, 8]


def test_all_of_a_known_frame_counts_for_the_others() -> None:
    shared, whole = fed(GAPS).smoothed(), fed(GAPS, exact=(7,)).smoothed()
    assert np.trace(whole[5].covariance) < np.trace(shared[5].covariance)
