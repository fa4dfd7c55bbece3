"""Statistics of a benchmark: selection, means, standard deviations, pairs of methods, and table texts."""

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...html import Cell, Table
from ...settings import DOMAINS
from .conditions import OCCLUSION
from .measurement import TOLERANCE, WIDE_TOLERANCE, Measurement, Score
from .rooms import Half
from .scope import FAMILY, MAIN, PAPERS_STEPS, ROOMS


def read_table(name: str) -> dict[str, Any]:
    """Read a TOML file in the folder of this module."""
    return tomllib.loads(Path(__file__).with_name(name).read_text(encoding="utf-8"))


PAPER = read_table("paper.toml")
"""Numbers of the paper, documented in the file."""
TEXTS = read_table("tables.toml")
"""Titles and captions of tables, and captions of figures."""


def table_of(name: str, rows: Sequence[Mapping[str, str | Cell]], /, **values: object) -> Table | None:
    """Table with the title and caption of a name, formatted with `values`; None without rows."""
    title, caption = (TEXTS[name][text].format(**values) for text in ("title", "caption"))
    return Table.of(title, caption, rows)


def paper_column(source: str, domain: str) -> str:
    """Column of the paper's table that corresponds to a source and domain; empty without such a column."""
    return PAPER["columns"].get(source, {}).get(domain, "")


ANY = object()
"""Value that matches every initial error."""


class Measurements:
    """Measurements and selections of measurements."""

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
        """Measurements that match all given arguments; `error_deg=None` selects starts at the measured joints.

        Measurements of frames with occluders or in other rooms, and of instruments absent from the training data, are
        returned only if their domain or source is given.
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
        """Measurements of the frames on which all methods are evaluated."""
        frames = {(m.run.source, m.run.frame) for m in self.all if m.run.method in MAIN and m.run.error_deg is None}
        return Measurements(m for m in self.all if (m.run.source, m.run.frame) in frames)

    def default_solver(self) -> list[Measurement]:
        """Runs of the default solver with one camera: single frames, with or without occluders, and sequences."""
        return [*self.of(method="ours"), *self.of(method="ours", domain=OCCLUSION), *self.of(method="sequence")]

    def domains(self, source: str) -> list[str]:
        """Domains of a source, in order of measurement."""
        return list(dict.fromkeys(measurement.run.domain for measurement in self.of(source=source)))

    def sources(self, kind: str = "") -> list[str]:
        """Sources of a kind (`ROOMS` or `FAMILY`); by default, the sources of neither kind."""
        found = dict.fromkeys(measurement.run.source for measurement in self.all)
        return [source for source in found if (source.startswith(kind) if kind else _usual(source))]

    def in_rooms(self, source: str, half: Half, method: str) -> list[Measurement]:
        """Measurements of a source and method in the rooms for tuning or in the held-out rooms."""
        runs = ((measurement, measurement.run) for measurement in self.all)
        return [m for m, run in runs if run.source == source and run.domain.startswith(half) and run.method == method]


def _usual(source: str) -> bool:
    return not source.startswith((ROOMS, FAMILY))


def scores(measurements: Iterable[Measurement], iterations: int | None = None) -> list[Score]:
    """Final scores of measurements, or the best scores within a number of steps."""
    found = (entry.final if iterations is None else entry.best_of(iterations) for entry in measurements)
    return [score for score in found if score is not None]


DOMAIN_LABELS = {domain: domain.replace("_", " ") for domain in (*DOMAINS, OCCLUSION)}
SHORT_LABELS = {"paper": "paper's setting", "ours": "ours"}
"""Short labels of methods, for tables by iterations and errors."""
NO_VALUE = "–"
"""Placeholder for a missing number."""


@dataclass(frozen=True)
class Figure:
    """Metric of scores and its format in tables."""

    heading: str
    name: str
    """Name of the field of `Score`."""
    scale: float = 1.0
    digits: int = 2

    def values(self, scores: Iterable[Score | None]) -> list[float]:
        """Values of the metric that are not None."""
        found = (getattr(score, self.name) for score in scores if score is not None)
        return [value for value in found if value is not None]

    def text(self, scores: Iterable[Score | None]) -> str:
        """Mean ± standard deviation; only the mean for a single value."""
        if not (values := self.values(scores)):
            return NO_VALUE
        mean = f"{self.scale * np.mean(values):.{self.digits}f}"
        return mean if len(values) == 1 else f"{mean} ± {self.scale * np.std(values):.{self.digits}f}"

    def cell(self, scores: Iterable[Score | None], theirs: Sequence[float] | None = None, column: str = "") -> Cell:
        """Table cell with the text and, below, the number and column of the paper."""
        note = "" if theirs is None else f"{column} {theirs[0]:.1f} ± {theirs[1]:.1f}"
        return Cell(self.text(scores), note)


DICE = Figure("Dice", "dice", 100.0, 1)
NSD = Figure(f"NSD at {TOLERANCE:g} px", "nsd", 100.0, 1)
WIDE_NSD = Figure(f"NSD at {WIDE_TOLERANCE:g} px", "nsd_wide", 100.0, 1)
JOINT_MAE = Figure("joint MAE [deg]", "joint_mae_deg")
VISIBLE_MAE = Figure("MAE of visible joints [deg]", "visible_joint_mae_deg")
TIP_DEPTH = Figure("tip depth error [mm]", "tip_depth_mm")


def start_label(error_deg: float | None) -> str:
    """Label of the start of a run in tables."""
    return "as measured" if error_deg is None else f"{error_deg:g}°"


MIN_GAIN = 0.01
"""Minimum gain in Dice of the paper's setting for a speed comparison."""


@dataclass(frozen=True)
class Pair:
    """Times that the paper's setting and the default solver need to reach the best Dice of the paper's setting, from
    the same start.
    """

    source: str
    error_deg: float | None
    gained: bool
    """Whether the gain of the paper's setting suffices for a comparison."""
    papers: float
    """Time in which the paper's setting reaches the Dice of its best iterate within `PAPERS_STEPS` steps [s]."""
    ours: float | None
    """Time in which the default solver reaches the same Dice [s]; None if it does not."""

    @property
    def ratio(self) -> float:
        """Speed-up of the default solver; 0 if it does not reach the same Dice."""
        return self.papers / self.ours if self.ours else 0.0


def pairs(data: Measurements) -> list[Pair]:
    """All pairs of runs from the same start, including pairs without gain in the paper's setting."""
    ours = {(m.run.source, m.run.domain, m.run.frame, m.run.error_deg): m for m in data.of(method="ours")}
    found = []
    for theirs in data.of(method="paper"):
        run, best = theirs.run, theirs.best_of(PAPERS_STEPS)
        other = ours.get((run.source, run.domain, run.frame, run.error_deg))
        if other is None or best is None or theirs.start is None:
            continue
        papers = _seconds_to(theirs, best.dice)
        assert papers is not None
        gained = best.dice >= theirs.start.dice + MIN_GAIN
        found.append(Pair(run.source, run.error_deg, gained, papers, _seconds_to(other, best.dice)))
    return found


def _seconds_to(measurement: Measurement, dice: float) -> float | None:
    """Time until the best iterate reaches a Dice [s]; None if it does not."""
    reached = zip(measurement.trace, measurement.best_so_far(), strict=True)
    return next((now.seconds for now, best in reached if best.dice >= dice), None)
