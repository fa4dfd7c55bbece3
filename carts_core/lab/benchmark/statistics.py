"""Selecting measurements, and means and deviations over them."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ...settings import DOMAINS
from .measurement import Measurement, Score
from .methods import MAIN
from .occlusion import OCCLUSION
from .rooms import Half
from .scope import FAMILY, ROOMS

ANY = object()
"""Matches every error at the start."""


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation over frames."""

    mean: float
    deviation: float
    count: int

    @staticmethod
    def of(values: Iterable[float | None]) -> "Spread | None":
        """Over the values that are known; None where there are none."""
        known = [value for value in values if value is not None]
        return Spread(float(np.mean(known)), float(np.std(known)), len(known)) if known else None


class Measurements:
    """What is known, and a way to ask for a part of it."""

    def __init__(self, measurements: Iterable[Measurement]) -> None:
        self.all = list(measurements)

    def of(
        self,
        *,
        source: str | None = None,
        domain: str | None = None,
        method: str | None = None,
        error_deg: object = ANY,
    ) -> list[Measurement]:
        """The measurements that match; what is not named matches everything, `error_deg=None` the measured start.

        Pictures with occluders, other rooms and instruments that no training has are none of the usual conditions: they
        match only where their domain or source is named.
        """
        return [
            measurement
            for measurement in self.all
            if (measurement.run.source == source if source else _usual(measurement.run.source))
            and measurement.run.domain in ((domain,) if domain else DOMAINS)
            and method in (None, measurement.run.method)
            and (error_deg is ANY or measurement.run.error_deg == error_deg)
        ]

    def compared(self) -> "Measurements":
        """Those on frames on which all methods are evaluated; of the others only some methods know."""
        frames = {(m.run.source, m.run.frame) for m in self.all if m.run.method in MAIN and m.run.error_deg is None}
        return Measurements(m for m in self.all if (m.run.source, m.run.frame) in frames)

    def default_solver(self) -> list[Measurement]:
        """Its runs with one camera and nothing else to go by: each frame alone, occluders or not, and in sequences."""
        return [*self.of(method="ours"), *self.of(method="ours", domain=OCCLUSION), *self.of(method="sequence")]

    def domains(self, source: str) -> list[str]:
        """The domains that occur in a source, in the order in which they were measured."""
        return list(dict.fromkeys(measurement.run.domain for measurement in self.of(source=source)))

    def sources(self) -> list[str]:
        """The usual sources that occur, without other rooms and other instruments."""
        found = dict.fromkeys(measurement.run.source for measurement in self.all)
        return [source for source in found if _usual(source)]

    def families(self) -> list[str]:
        """The sources that occur of instruments that no training has."""
        found = dict.fromkeys(measurement.run.source for measurement in self.all)
        return [source for source in found if source.startswith(FAMILY)]

    def in_rooms(self, camera: str, half: Half, method: str) -> list[Measurement]:
        """Those of a camera's frames in the other rooms of one half."""
        return [
            measurement
            for measurement in self.all
            if measurement.run.source == f"{ROOMS} {camera}"
            and measurement.run.domain.startswith(half)
            and measurement.run.method == method
        ]

    def room_cameras(self) -> list[str]:
        """The cameras whose frames were put into other rooms."""
        found = dict.fromkeys(m.run.source for m in self.all if m.run.source.startswith(ROOMS))
        return [source.removeprefix(ROOMS).strip() for source in found]


def _usual(source: str) -> bool:
    return not source.startswith((ROOMS, FAMILY))


def scores(measurements: Iterable[Measurement], iterations: int | None = None) -> list[Score]:
    """What each method returned, or its best of the first so many steps."""
    found = (entry.final if iterations is None else entry.best_of(iterations) for entry in measurements)
    return [score for score in found if score is not None]
