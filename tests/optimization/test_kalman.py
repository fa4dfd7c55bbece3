"""The Kalman smoother of measurement errors against plain linear algebra."""

import math

import numpy as np
import pytest

from carts_core.optimization.kalman import (
    ErrorModel,
    Gaussian,
    Information,
    information_shares,
    remove_measurement,
)
from carts_core.settings import SequenceSettings

N, FRAMES = 3, 5
GAPS = np.array([0.0, 0.5, 0.1, 2.0, 0.3])
SETTINGS = SequenceSettings(constant_deg=2.0, drift_deg=0.8, drift_seconds=1.5, jitter_deg=0.3)
CONSTANT = np.radians([2.0, 2.0, 0.5])


def information(seed: int, rank: int) -> Information:
    rng = np.random.default_rng(seed)
    jacobian = rng.standard_normal((rank, N)) * 60
    correction = rng.standard_normal(N) * 0.03
    precision = jacobian.T @ jacobian
    return Information(precision, precision @ correction)


def everything_at_once(seen: list[Information]) -> tuple[np.ndarray, np.ndarray]:
    """Means [frames, n] and covariances of all corrections from one big Gaussian."""
    times = np.cumsum(GAPS)
    decay = np.exp(-np.abs(times[:, None] - times) / SETTINGS.drift_seconds)
    over_time = 2.0**2 + 0.8**2 * decay + 0.3**2 * np.eye(FRAMES)
    prior = np.kron(over_time / 2.0**2, np.diag(CONSTANT**2))
    precision = np.linalg.inv(prior)
    for index, one in enumerate(seen):
        block = slice(index * N, (index + 1) * N)
        precision[block, block] += one.precision
    covariance = np.linalg.inv(precision)
    mean = covariance @ np.concatenate([one.vector for one in seen])
    return mean.reshape(FRAMES, N), covariance


def smoothed(seen: list[Information]) -> list[Gaussian]:
    model = ErrorModel(SETTINGS, CONSTANT)
    filtered, state = [], model.initial()
    for gap, one in zip(GAPS, seen, strict=True):
        state = model.updated(model.predicted(state, gap), one)
        filtered.append(state)
    return model.smoothed(filtered, GAPS.tolist())


def test_smoothing_is_the_same_as_all_frames_at_once() -> None:
    # Frames that tell nothing, one direction, or all of them.
    seen = [information(seed, rank) for seed, rank in enumerate((3, 1, 0, 2, 1))]
    mean, covariance = everything_at_once(seen)
    for index, found in enumerate(smoothed(seen)):
        block = slice(index * N, (index + 1) * N)
        assert np.allclose(found.mean, mean[index], rtol=1e-6, atol=1e-9)
        assert np.allclose(found.covariance, covariance[block, block], rtol=1e-6, atol=1e-12)


def test_what_the_others_say_leaves_out_the_frame_itself() -> None:
    seen = [information(seed, 2) for seed in range(FRAMES)]
    others = remove_measurement(smoothed(seen)[2], seen[2])
    mean, covariance = everything_at_once([*seen[:2], Information.nothing(N), *seen[3:]])
    assert np.allclose(others.mean, mean[2], rtol=1e-5, atol=1e-8)
    assert np.allclose(others.covariance, covariance[6:9, 6:9], rtol=1e-5, atol=1e-11)


def test_what_is_exact_stays_exact_and_moves_the_neighbours() -> None:
    given = np.array([0.04, np.nan, -0.01])
    seen = [Information.nothing(N) for _ in range(FRAMES)]
    seen[2] = Information.known(given)
    found = smoothed(seen)
    assert np.allclose(found[2].mean[[0, 2]], given[[0, 2]], atol=1e-9)
    assert np.sqrt(found[2].covariance.diagonal())[[0, 2]].max() < 1e-6
    assert found[2].mean[1] == 0
    for neighbour in (found[1], found[3]):
        assert 0.02 < neighbour.mean[0] < 0.04 and 0 < math.sqrt(neighbour.covariance[0, 0]) < CONSTANT[0]


def test_after_an_endless_gap_nothing_is_known() -> None:
    model = ErrorModel(SETTINGS, CONSTANT)
    known = model.updated(model.initial(), information(0, 3))
    forgotten = model.predicted(known, math.inf)
    assert np.allclose(forgotten.covariance, model.initial().covariance)
    assert np.allclose(forgotten.mean, 0)


@pytest.mark.parametrize("rank", [1, 2, 3])
def test_the_mahalanobis_distance_is_about_one_where_the_model_holds_however_much_is_seen(rank: int) -> None:
    rng = np.random.default_rng(4)
    expected = Gaussian(np.zeros(N), np.diag(CONSTANT**2))
    precision = information(1, rank).precision
    spread = np.linalg.cholesky(expected.covariance + np.linalg.pinv(precision, rcond=1e-9))
    draws = (spread @ rng.standard_normal(N) for _ in range(800))
    values = [Information(precision, precision @ draw).mahalanobis(expected) for draw in draws]
    assert np.mean(values) == pytest.approx(1.0, abs=0.15)
    far = Information(precision, precision @ np.full(N, 0.9))
    assert far.mahalanobis(expected) > 50 and far.contradicts(expected, [range(N)])
    assert Information.nothing(N).any is False and far.any
    assert Information.nothing(N).mahalanobis(expected) == 0


def test_an_arm_that_jumped_contradicts_however_many_others_did_not() -> None:
    count, std = 7, 0.005
    expected = Gaussian(np.zeros(3 * count), std**2 * np.eye(3 * count))
    precision = np.eye(3 * count) / std**2
    jumped = np.zeros(3 * count)
    jumped[:2] = np.deg2rad(3.5)
    found, arms = Information(precision, precision @ jumped), [range(at, at + count) for at in (0, count, 2 * count)]
    assert (
        found.mahalanobis(expected)
        < 9
        < max(own.mahalanobis(there) for own, there in map(found.of, [expected] * 3, arms))
    )
    assert found.contradicts(expected, arms) and not found.contradicts(expected, arms[1:])


@pytest.mark.parametrize(("errors", "wide"), [(1.0, False), (2.5, True)])
def test_the_prior_that_errors_were_drawn_from_is_more_likely(errors: float, wide: bool) -> None:
    usual = Gaussian(np.zeros(N), 0.035**2 * np.eye(N))
    other = Gaussian(usual.mean, 2.5**2 * usual.covariance)
    found = Information.known(errors * 0.035 * np.resize([1.0, -1.0], N), 0.01)
    assert (found.log_likelihood(other) > found.log_likelihood(usual)) is wide
    nothing = Information.nothing(N)
    assert nothing.log_likelihood(other) == nothing.log_likelihood(usual) == 0


def test_shares_of_correlated_errors_are_what_their_mean_becomes_certain_by() -> None:
    frames, memory, gap = 2000, 0.5, 0.25
    times = gap * np.arange(frames)
    correlation = np.exp(-np.abs(times[:, None] - times) / memory)
    shares = information_shares([0.0] + [gap] * (frames - 1), memory)
    assert correlation.mean() == pytest.approx(1.0 / sum(shares), rel=2e-3)


def test_shares_are_the_same_in_both_directions_and_whole_for_a_frame_that_is_far_from_others() -> None:
    forward, backward = information_shares([9.9, 0.1, 2.0, 0.4], 0.5), information_shares([0.0, 0.4, 2.0, 0.1], 0.5)
    assert forward == pytest.approx(backward[::-1])
    assert information_shares([0.0], 0.5) == [1.0] and information_shares([0.0, math.inf, math.inf], 0.5) == [1.0] * 3
