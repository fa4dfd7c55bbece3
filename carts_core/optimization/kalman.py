"""Error model of joint positions over time, and the smoother that estimates it."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf

import numpy as np
from jaxtyping import Float

from ..settings import SequenceSettings


@dataclass(frozen=True)
class Gaussian:
    """Mean [rad] and covariance [rad^2] of corrections or their components."""

    mean: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]


@dataclass(frozen=True)
class Information:
    """Measurement of a frame's correction x in information form, with log likelihood -x.precision.x / 2 + vector.x."""

    precision: Float[np.ndarray, "n n"]
    """[1/rad^2]; singular in directions that the image does not determine."""
    vector: Float[np.ndarray, " n"]
    """Information vector [1/rad]."""

    @staticmethod
    def nothing(n: int) -> "Information":
        """Zero information, for a frame whose image is ignored."""
        return Information(np.zeros((n, n)), np.zeros(n))

    @staticmethod
    def known(correction: Float[np.ndarray, " n"], std: Float[np.ndarray, " n"] | float = 0.0) -> "Information":
        """Information of a known correction with a standard deviation [rad]; entries with NaN are unknown."""
        known = np.isfinite(correction)
        precision = np.where(known, 1.0 / (np.square(std) + 1.0 / _EXACT), 0.0)
        return Information(np.diag(precision), precision * np.where(known, correction, 0.0))

    def scaled(self, share: float) -> "Information":
        """Copy, multiplied by a weight in [0, 1]."""
        return Information(share * self.precision, share * self.vector)

    def __add__(self, other: "Information") -> "Information":
        return Information(self.precision + other.precision, self.vector + other.vector)

    def of(self, expected: Gaussian, group: range) -> tuple["Information", Gaussian]:
        """Information on some of the unknowns if the others are as predicted, and the prediction of these."""
        own, others = slice(group.start, group.stop), np.setdiff1d(np.arange(len(self.vector)), group)
        known = self.vector[own] - self.precision[own, others] @ expected.mean[others]
        return Information(self.precision[own, own], known), Gaussian(expected.mean[own], expected.covariance[own, own])

    @cached_property
    def any(self) -> bool:
        """Whether a direction is measured; False for an image without arms."""
        return bool(np.linalg.eigvalsh(self.precision)[-1] > _MEASURED)

    def mahalanobis(self, expected: Gaussian) -> float:
        """Squared Mahalanobis distance from the prediction, averaged over the measured directions [1].

        This is the normalized innovation squared of a filter (Bar-Shalom, Li and Kirubarajan, Estimation with
        Applications to Tracking and Navigation, 2001, 5.4), whose degrees of freedom are the rank of the precision:
        it is about 1 for a consistent measurement, and 0 if no direction is measured.
        """
        squared, directions = self._distance(expected)
        return squared / max(directions, 1)

    def log_likelihood(self, expected: Gaussian) -> float:
        """Log likelihood of the measured directions under a prediction, up to a constant [1]."""
        difference, spread = self._innovation(expected)
        return -0.5 * float(difference @ np.linalg.solve(spread, difference) + np.linalg.slogdet(spread)[1])

    def _innovation(self, expected: Gaussian) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"]]:
        """Difference from a prediction in the measured directions, and its covariance."""
        residual = self.vector - self.precision @ expected.mean
        # r (L + L S L)^-1 r, with the pseudoinverse of L, which may be singular, and an S that may be 0.
        values, directions = np.linalg.eigh(self.precision)
        measured = directions[:, values > _MEASURED]
        L = measured.T @ self.precision @ measured
        spread = np.linalg.inv(L) + measured.T @ expected.covariance @ measured
        return np.linalg.solve(L, measured.T @ residual), spread

    def _distance(self, expected: Gaussian) -> tuple[float, int]:
        """Squared Mahalanobis distance from the prediction [1], and number of measured directions."""
        difference, spread = self._innovation(expected)
        return float(difference @ np.linalg.solve(spread, difference)), len(difference)

    def contradicts(self, expected: Gaussian, groups: Sequence[range]) -> bool:
        """Whether the correction of a group of unknowns, such as an arm, deviates significantly from its prediction.

        The squared distance of a consistent measurement has a chi-square distribution with a degree of freedom per
        measured direction, of which the cube root is nearly normal (Wilson and Hilferty, The distribution of
        chi-square, 1931). The bound is three standard deviations of this normal distribution.
        """
        for own, there in (self.of(expected, group) for group in groups):
            squared, directions = own._distance(there)
            spread = 2.0 / (9.0 * max(directions, 1))
            if squared > directions * (1.0 - spread + _SIGNIFICANT * math.sqrt(spread)) ** 3:
                return True
        return False


_SIGNIFICANT = 3.0
"""Significant deviation, in standard deviations [1]."""

_MEASURED = 10.0
"""Minimum precision of a measured direction [1/rad^2]: a standard deviation of 18 degrees."""

_EXACT = 1e14
"""Precision of exactly known values [1/rad^2]."""


class ErrorModel:
    """Kalman model of n corrections with the state [3 n]: constant, drift and noise components.

    Args:
        settings: standard deviations for joints; for other unknowns, drift and noise are scaled in proportion to their
            constant.
        constant: standard deviation of each unknown's constant component [rad].
    """

    def __init__(self, settings: SequenceSettings, constant: Float[np.ndarray, " n"]) -> None:
        n = self._n = len(constant)
        self._drift_seconds = settings.drift_seconds
        shares = np.array([settings.constant_deg, settings.drift_deg, settings.jitter_deg]) / settings.constant_deg
        self._variance = np.outer(shares, constant).ravel() ** 2
        self._sum = np.tile(np.eye(n), 3)

    def initial(self) -> Gaussian:
        """State before the first frame: the prior."""
        return Gaussian(np.zeros(3 * self._n), np.diag(self._variance))

    def predicted(self, state: Gaussian, seconds: float) -> Gaussian:
        """Predicted state after a time [s]; the prior for infinite time."""
        kept = self._kept(seconds)
        noise = np.diag(self._variance * (1.0 - kept**2))
        return Gaussian(kept * state.mean, kept[:, None] * state.covariance * kept + noise)

    def _kept(self, seconds: float) -> Float[np.ndarray, " 3n"]:
        constant = 1.0 if math.isfinite(seconds) else 0.0
        return np.repeat([constant, math.exp(-seconds / self._drift_seconds), 0.0], self._n)

    def correction(self, state: Gaussian) -> Gaussian:
        """Corrections as the sum of the state's components."""
        return Gaussian(self._sum @ state.mean, self._sum @ state.covariance @ self._sum.T)

    def updated(self, state: Gaussian, information: Information) -> Gaussian:
        """The state after a measurement."""
        return combined(state, information, self._sum)

    def smoothed(self, filtered: Sequence[Gaussian], seconds: Sequence[float]) -> list[Gaussian]:
        """Corrections of all frames, `seconds` apart, given all measurements (Rauch, Tung and Striebel, 1965)."""
        if not filtered:
            return []
        result = [filtered[-1]]
        for state, later in zip(reversed(filtered[:-1]), reversed(seconds[1:]), strict=True):
            ahead = self.predicted(state, later)
            gain = np.linalg.solve(ahead.covariance, self._kept(later)[:, None] * state.covariance).T
            mean = state.mean + gain @ (result[-1].mean - ahead.mean)
            covariance = state.covariance + gain @ (result[-1].covariance - ahead.covariance) @ gain.T
            result.append(Gaussian(mean, 0.5 * (covariance + covariance.T)))
        return [self.correction(state) for state in reversed(result)]


def combined(state: Gaussian, information: Information, C: Float[np.ndarray, "m n"] | None = None) -> Gaussian:
    """Kalman update of a state x by a measurement of C x (x itself by default)."""
    C = np.eye(len(state.mean)) if C is None else C
    precision, cross = information.precision, state.covariance @ C.T
    # K = P C^T (1 + L C P C^T)^-1 L avoids inverting L, which may be singular.
    gain = cross @ np.linalg.inv(np.eye(len(C)) + precision @ C @ cross)
    covariance = state.covariance - gain @ precision @ cross.T
    mean = state.mean + gain @ (information.vector - precision @ C @ state.mean)
    return Gaussian(mean, 0.5 * (covariance + covariance.T))


def information_shares(gaps: Sequence[float], memory: float) -> list[float]:
    """Share of each frame's information used for other frames, since image errors are correlated in time [1].

    The model is a first-order autoregressive process: n values spaced by a gap have the information of n (1 - r) / (1 +
    r) independent ones, with r = exp(-gap / memory). The share of a frame is the mean over the gaps before and after
    it.

    Args:
        gaps: time from the previous frame to each frame [s]; the first one is not used.
        memory: time constant of the correlation (decay to 1/e) [s].
    """
    shares = [math.tanh(0.5 * gap / memory) for gap in gaps[1:]]
    if not shares:
        return [1.0] * len(gaps)
    return [0.5 * (before + after) for before, after in zip([shares[0], *shares], [*shares, shares[-1]], strict=True)]


def remove_measurement(smoothed: Gaussian, own: Information) -> Gaussian:
    """Smoothed correction of a frame without its own measurement."""
    precision = np.linalg.inv(smoothed.covariance)
    values, vectors = np.linalg.eigh(precision - own.precision)
    # Rounding errors must not make a precision negative.
    covariance = vectors @ np.diag(1.0 / np.maximum(values, 1.0)) @ vectors.T
    return Gaussian(covariance @ (precision @ smoothed.mean - own.vector), covariance)


class Smoother:
    """Kalman filter over frames in visiting order, with a backward smoother.

    Image errors of neighbouring frames are correlated, so only a share of a frame's information is used for other
    frames. The frame itself uses all of its information.

    Args:
        gaps: frame index -> time from the previously visited frame [s], in visiting order.
        correlation_seconds: time constant of the autocorrelation of image errors [s].
        exact: indices of frames that are known and therefore have full weight.
    """

    def __init__(
        self, errors: ErrorModel, gaps: Mapping[int, float], correlation_seconds: float, exact: Collection[int]
    ) -> None:
        self._errors, self._gaps = errors, dict(gaps)
        self._correlation_seconds, self._exact = correlation_seconds, exact
        self._shares = self._information_shares()
        self._order: list[int] = []
        self._measured: dict[int, Information] = {}
        self._filtered: list[Gaussian] = []
        """Filtered states of the first frames in visiting order; extended on demand."""

    def expected(self, index: int) -> Gaussian:
        """Predicted correction of the next frame."""
        return self._errors.correction(self._predicted(len(self._order), index))

    def add(self, index: int, measured: Information) -> Gaussian:
        """Add the measurement of the next frame; returns its filtered correction."""
        expected = self.expected(index)
        self._order.append(index)
        self._measured[index] = measured
        return combined(expected, measured)

    def replace(self, index: int, measured: Information) -> None:
        """Replace the measurement of a frame."""
        self._measured[index] = measured
        del self._filtered[self._order.index(index) :]

    def restart(self, index: int) -> None:
        """Restart from the prior at the next frame."""
        self._gaps[index] = inf
        self._shares = self._information_shares()
        # The previous frame loses a neighbour, so its share grows.
        del self._filtered[max(len(self._order) - 1, 0) :]

    def smoothed(self) -> dict[int, Gaussian]:
        """Frame index -> smoothed correction of each measured frame."""
        self._filter(len(self._order))
        states = self._errors.smoothed(self._filtered, [self._gaps[index] for index in self._order])
        own = {index: self._measured[index].scaled(1.0 - self._shares[index]) for index in self._order}
        return {index: combined(state, own[index]) for index, state in zip(self._order, states, strict=True)}

    def with_correlation(self, correlation_seconds: float) -> "Smoother":
        """Smoother of the same measurements with a longer correlation time of image errors [s]."""
        other = Smoother(self._errors, self._gaps, correlation_seconds, self._exact)
        other._order, other._measured = self._order, self._measured
        return other

    def _predicted(self, place: int, index: int) -> Gaussian:
        """Predicted state of the frame at index `place` of the visiting order."""
        if place == 0:
            return self._errors.initial()
        self._filter(place)
        return self._errors.predicted(self._filtered[place - 1], self._gaps[index])

    def _filter(self, count: int) -> None:
        """Extend the filter to the first `count` frames in visiting order."""
        for place in range(len(self._filtered), count):
            index = self._order[place]
            shared = self._measured[index].scaled(self._shares[index])
            self._filtered.append(self._errors.updated(self._predicted(place, index), shared))

    def _information_shares(self) -> dict[int, float]:
        """Frame index -> share of the frame's information used for other frames [1]."""
        shares = information_shares(list(self._gaps.values()), self._correlation_seconds)
        return {index: 1.0 if index in self._exact else share for index, share in zip(self._gaps, shares, strict=True)}
