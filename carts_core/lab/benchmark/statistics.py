"""Measurements of a benchmark: selection, means and deviations, pairs of methods, and labels of tables."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from ...settings import DOMAINS
from . import paper
from .conditions import OCCLUSION
from .measurement import Measurement, Score
from .rooms import Half
from .scope import FAMILY, MAIN, PAPERS_STEPS, ROOMS

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
        """Spread of the known values; None without any."""
        known = [value for value in values if value is not None]
        return Spread(float(np.mean(known)), float(np.std(known)), len(known)) if known else None


class Measurements:
    """Measurements, and selections of them."""

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
    """Final scores of measurements, or the best ones of a number of steps."""
    found = (entry.final if iterations is None else entry.best_of(iterations) for entry in measurements)
    return [score for score in found if score is not None]


DOMAIN_LABELS = {
    "regular": "regular",
    "low_brightness": "low brightness",
    "bleeding": "bleeding",
    "smoke": "smoke",
    "background_change": "background change",
    "simulated_smoke": "simulated smoke",
    OCCLUSION: "occlusion",
}
SHORT_LABELS = {"paper": "paper's setting", "ours": "ours"}
"""Labels of methods in tables by iterations and errors."""
NOTHING = "–"
"""Placeholder for a missing number."""


def begun(error_deg: float | None) -> str:
    """Start of a run, for tables."""
    return "as measured" if error_deg is None else f"{error_deg:g}°"


def spread_text(spread: Spread | None, scale: float = 100.0, digits: int = 1) -> str:
    """Mean ± standard deviation, Dice and NSD in percent by default; of a single frame there is no deviation."""
    if spread is None:
        return NOTHING
    if spread.count == 1:
        return f"{scale * spread.mean:.{digits}f}"
    return f"{scale * spread.mean:.{digits}f} ± {scale * spread.deviation:.{digits}f}"


def paper_note(value: paper.Value | None, column: str | None, digits: int = 1) -> str:
    """The paper's number and the column where it stands there."""
    if value is None:
        return ""
    return f"{column} {value[0]:.{digits}f} ± {value[1]:.{digits}f}"


GAINED = 0.01
"""Dice that the paper's setting has to gain, or there is nothing to be faster at."""


@dataclass(frozen=True)
class Pair:
    """How long both take to the Dice that the paper's setting ends with."""

    source: str
    error_deg: float | None
    gained: bool
    """Whether the paper's setting gained enough to compare."""
    papers: float
    """Until the best iterate of the paper's setting first has the Dice of its best of `PAPERS_STEPS` [s]."""
    ours: float | None
    """Until ours has it [s]; None if it never does."""

    @property
    def ratio(self) -> float:
        """How many times faster ours is; 0 if it never gets there."""
        return self.papers / self.ours if self.ours else 0.0


def pairs(data: Measurements) -> list[Pair]:
    """All pairs of runs, also those in which the paper's setting gained nothing."""
    ours = {(m.run.source, m.run.domain, m.run.frame, m.run.error_deg): m for m in data.of(method="ours")}
    found = []
    for theirs in data.of(method="paper"):
        run, best = theirs.run, theirs.best_of(PAPERS_STEPS)
        other = ours.get((run.source, run.domain, run.frame, run.error_deg))
        if other is None or best is None or theirs.start is None:
            continue
        papers = seconds_to(theirs, best.dice)
        assert papers is not None
        gained = best.dice >= theirs.start.dice + GAINED
        found.append(Pair(run.source, run.error_deg, gained, papers, seconds_to(other, best.dice)))
    return found


def seconds_to(measurement: Measurement, dice: float) -> float | None:
    """Seconds until the best iterate first had this Dice [s]; None if it never had."""
    for now, best in zip(measurement.trace, measurement.best_so_far(), strict=True):
        if best.dice >= dice:
            return now.seconds
    return None


@dataclass(frozen=True)
class Target:
    """One line of the table."""

    what: str
    target: str
    reached: str
    met: bool | None
    """None where it is open: nothing was measured, or nothing that misses it, but not all that it asks for."""
    reference: str
    basis: str
    """Data that it was computed from."""


def make_target(
    what: str,
    least_or_most: float,
    value: float | None,
    basis: str,
    *,
    at_least: bool,
    text: Callable[[float], str],
    reference: str = "",
    complete: bool = True,
) -> Target:
    """A target with its verdict.

    Args:
        what: for people.
        least_or_most: the bound.
        value: what was reached; None where nothing was measured.
        basis: what it was computed from.
        at_least: whether the bound is the smallest value that meets it, or the largest.
        text: writes a value.
        reference: what others reached.
        complete: whether everything was measured that the target asks for; otherwise it cannot be met, only missed.
    """
    bound = f"at {'least' if at_least else 'most'} {text(least_or_most)}"
    if value is None:
        return Target(what, bound, "not measured", None, reference, basis)
    met = value >= least_or_most if at_least else value <= least_or_most
    near = not met and text(value) == text(least_or_most)
    reached = f"just {'below' if at_least else 'above'} {text(value)}" if near else text(value)
    return Target(what, bound, reached, met if complete or not met else None, reference, basis)
