"""Measurements of a benchmark: selection, means and deviations, pairs of methods, and texts of tables."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ...html import Cell
from ...settings import DOMAINS
from . import paper
from .conditions import OCCLUSION
from .measurement import TOLERANCE, WIDE_TOLERANCE, Measurement, Score
from .rooms import Half
from .scope import FAMILY, MAIN, PAPERS_STEPS, ROOMS

ANY = object()
"""Matches every error at the start."""


class Measurements:
    """Measurements and selections of them."""

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
        """Measurements that match all given arguments; `error_deg=None` is the measured start.

        Frames with occluders or in other rooms, and instruments in no training data, match only if their domain or
        source is given.
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
        """Measurements on frames on which all methods are evaluated."""
        frames = {(m.run.source, m.run.frame) for m in self.all if m.run.method in MAIN and m.run.error_deg is None}
        return Measurements(m for m in self.all if (m.run.source, m.run.frame) in frames)

    def default_solver(self) -> list[Measurement]:
        """Runs of the default solver with one camera: each frame alone, with or without occluders, and in sequences."""
        return [*self.of(method="ours"), *self.of(method="ours", domain=OCCLUSION), *self.of(method="sequence")]

    def domains(self, source: str) -> list[str]:
        """The domains that occur in a source, in the order in which they were measured."""
        return list(dict.fromkeys(measurement.run.domain for measurement in self.of(source=source)))

    def sources(self) -> list[str]:
        """The sources that occur, without other rooms and other instruments."""
        found = dict.fromkeys(measurement.run.source for measurement in self.all)
        return [source for source in found if _usual(source)]

    def families(self) -> list[str]:
        """The sources that occur of instruments in no training data."""
        found = dict.fromkeys(measurement.run.source for measurement in self.all)
        return [source for source in found if source.startswith(FAMILY)]

    def in_rooms(self, camera: str, half: Half, method: str) -> list[Measurement]:
        """Measurements of a camera's frames in the rooms of one half."""
        return [
            measurement
            for measurement in self.all
            if measurement.run.source == f"{ROOMS} {camera}"
            and measurement.run.domain.startswith(half)
            and measurement.run.method == method
        ]

    def room_cameras(self) -> list[str]:
        """The cameras with frames in other rooms."""
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


@dataclass(frozen=True)
class Figure:
    """A figure of scores and its form in tables."""

    heading: str
    name: str
    """Field of `Score`."""
    scale: float = 1.0
    digits: int = 2

    def values(self, scores: Iterable[Score | None]) -> list[float]:
        """The known values."""
        found = (getattr(score, self.name) for score in scores if score is not None)
        return [value for value in found if value is not None]

    def text(self, scores: Iterable[Score | None]) -> str:
        """Mean ± standard deviation; a single value has no deviation."""
        if not (values := self.values(scores)):
            return NOTHING
        mean = f"{self.scale * np.mean(values):.{self.digits}f}"
        return mean if len(values) == 1 else f"{mean} ± {self.scale * np.std(values):.{self.digits}f}"

    def cell(self, scores: Iterable[Score | None], theirs: paper.Value | None = None, column: str = "") -> Cell:
        """The text, and the paper's number below it with the name of its column there."""
        note = "" if theirs is None else f"{column} {theirs[0]:.1f} ± {theirs[1]:.1f}"
        return Cell(self.text(scores), note)


DICE = Figure("Dice", "dice", 100.0, 1)
NSD = Figure(f"NSD at {TOLERANCE:g} px", "nsd", 100.0, 1)
WIDE_NSD = Figure(f"NSD at {WIDE_TOLERANCE:g} px", "nsd_wide", 100.0, 1)
JOINT_MAE = Figure("joint MAE [deg]", "joint_mae_deg")
VISIBLE_MAE = Figure("visible joints [deg]", "visible_joint_mae_deg")
TIP_DEPTH = Figure("depth of the tips [mm]", "tip_depth_mm")


def begun(error_deg: float | None) -> str:
    """Start of a run, for tables."""
    return "as measured" if error_deg is None else f"{error_deg:g}°"


GAINED = 0.01
"""Least gain in Dice of the paper's setting for a comparison of speed."""


@dataclass(frozen=True)
class Pair:
    """Times of both methods to the final Dice of the paper's setting."""

    source: str
    error_deg: float | None
    gained: bool
    """Whether the paper's setting gained enough to compare."""
    papers: float
    """Time until the best iterate of the paper's setting has the Dice of its best of `PAPERS_STEPS` [s]."""
    ours: float | None
    """The same of ours [s]; None if it never has."""

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
        papers = _seconds_to(theirs, best.dice)
        assert papers is not None
        gained = best.dice >= theirs.start.dice + GAINED
        found.append(Pair(run.source, run.error_deg, gained, papers, _seconds_to(other, best.dice)))
    return found


def _seconds_to(measurement: Measurement, dice: float) -> float | None:
    """Time until the best iterate first had this Dice [s]; None if it never had."""
    reached = zip(measurement.trace, measurement.best_so_far(), strict=True)
    return next((now.seconds for now, best in reached if best.dice >= dice), None)
