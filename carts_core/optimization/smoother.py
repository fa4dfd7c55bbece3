"""A Kalman filter and Rauch-Tung-Striebel smoother of the corrections of frames."""

from collections.abc import Collection, Mapping
from math import inf

from .error_model import ErrorModel, Gaussian, Information, combined, information_shares


class Smoother:
    """Filters the measurements of frames in the order in which they are visited, and smooths them backwards.

    Neighbouring frames share errors of their images, so only a share of what a frame measures counts for the others;
    all of it counts for the frame itself.

    Args:
        errors: model of the error of the measured kinematics.
        gaps: position -> seconds from the frame visited before it, in the order of the visits.
        correlation_seconds: time constant of the autocorrelation of image errors [s].
        exact: positions of frames that are known and therefore count whole.
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
        """States after the first frames of the order; completed when they are needed."""

    def expected(self, index: int) -> Gaussian:
        """The correction of the frame that is next, as the frames before it let expect it."""
        return self._errors.correction(self._predicted(len(self._order), index))

    def add(self, index: int, measured: Information) -> Gaussian:
        """Take the measurement of the frame that is next; its correction, given that and the frames before it."""
        expected = self.expected(index)
        self._order.append(index)
        self._measured[index] = measured
        return combined(expected, measured)

    def replace(self, index: int, measured: Information) -> None:
        """Take another measurement of a frame that has one."""
        self._measured[index] = measured
        del self._filtered[self._order.index(index) :]

    def restart(self, index: int) -> None:
        """Nothing that was found before holds any more from the frame that is next on."""
        self._gaps[index] = inf
        self._shares = self._information_shares()
        # The frame before it has one neighbour less, and counts more than it did.
        del self._filtered[max(len(self._order) - 1, 0) :]

    def smoothed(self) -> dict[int, Gaussian]:
        """Position -> correction of each frame that was measured, given all of them."""
        self._filter(len(self._order))
        states = self._errors.smoothed(self._filtered, [self._gaps[index] for index in self._order])
        own = {index: self._measured[index].scaled(1.0 - self._shares[index]) for index in self._order}
        return {index: combined(state, own[index]) for index, state in zip(self._order, states, strict=True)}

    def cautious(self, correlation_seconds: float) -> "Smoother":
        """The same measurements, if errors of images were alike for longer [s]."""
        other = Smoother(self._errors, self._gaps, correlation_seconds, self._exact)
        other._order, other._measured = self._order, self._measured
        return other

    def _predicted(self, place: int, index: int) -> Gaussian:
        """The state of the frame at a place in the order, before its measurement."""
        if place == 0:
            return self._errors.initial()
        self._filter(place)
        return self._errors.predicted(self._filtered[place - 1], self._gaps[index])

    def _filter(self, count: int) -> None:
        """Have the filtered states of the first so many frames."""
        for place in range(len(self._filtered), count):
            index = self._order[place]
            shared = self._measured[index].scaled(self._shares[index])
            self._filtered.append(self._errors.updated(self._predicted(place, index), shared))

    def _information_shares(self) -> dict[int, float]:
        """Position -> share of a frame's information that counts for the others [1]."""
        shares = information_shares(list(self._gaps.values()), self._correlation_seconds)
        return {index: 1.0 if index in self._exact else share for index, share in zip(self._gaps, shares, strict=True)}
