"""The default solver and the paper's setting on the same frame, from the same start."""

from dataclasses import dataclass

from .measurement import Measurement
from .scope import PAPERS_STEPS
from .statistics import Measurements

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
    for paper in data.of(method="paper"):
        run, best = paper.run, paper.best_of(PAPERS_STEPS)
        other = ours.get((run.source, run.domain, run.frame, run.error_deg))
        if other is None or best is None or paper.start is None:
            continue
        papers = seconds_to(paper, best.dice)
        assert papers is not None
        gained = best.dice >= paper.start.dice + GAINED
        found.append(Pair(run.source, run.error_deg, gained, papers, seconds_to(other, best.dice)))
    return found


def seconds_to(measurement: Measurement, dice: float) -> float | None:
    """Seconds until the best iterate first had this Dice [s]; None if it never had."""
    for now, best in zip(measurement.trace, measurement.best_so_far(), strict=True):
        if best.dice >= dice:
            return now.seconds
    return None
