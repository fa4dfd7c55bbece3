"""How often verdicts and deviations are right: tables, and what is meant to be reached."""

from collections.abc import Sequence as Items
from dataclasses import dataclass

import numpy as np
from scipy.stats import rankdata

from ...html import Cell, Table
from ...wording import counted
from .measurement import Measurement
from .scope import FAMILY, REAL, ROOMS, SYNTHETIC
from .statistics import NOTHING, Measurements, Target, make_target
from .wrong_inputs import WRONG

RIGHT = 0.9
"""Dice from which a mask counts as right."""

_METHODS = ("ours", "sequence", "masks")
"""Those whose verdicts are looked at."""


@dataclass(frozen=True)
class Judged:
    """Runs with a verdict, and how often that was right."""

    runs: tuple[Measurement, ...]

    @property
    def wrong(self) -> list[Measurement]:
        """Those whose mask is wrong."""
        return [run for run in self.runs if run.final.dice < RIGHT]

    @property
    def good(self) -> list[Measurement]:
        """Those that are called good."""
        return [run for run in self.runs if run.verdict == "good"]

    @property
    def good_though_wrong(self) -> int:
        """How many are called good though their mask is wrong."""
        return sum(run.final.dice < RIGHT for run in self.good)

    @property
    def worse_unnoticed(self) -> int:
        """How many were made worse than their start and called good."""
        return sum(run.made_worse for run in self.good)

    @property
    def area(self) -> float | None:
        """Under the ROC: how often a wrong mask has a higher probability of being wrong than a right one [1]; None
        without both."""
        wrong = np.array([run.final.dice < RIGHT for run in self.runs])
        if wrong.all() or not wrong.any():
            return None
        ranks = rankdata([run.probability or 0.0 for run in self.runs])
        count = int(wrong.sum())
        return float((ranks[wrong].sum() - count * (count + 1) / 2) / (count * (len(wrong) - count)))

    @property
    def within(self) -> tuple[int, float, float] | None:
        """How many joint positions have a deviation, and the shares within one and within two [1]; None if none."""
        known = np.array([run.within for run in self.runs if run.within])
        if not len(known):
            return None
        every, one, two = known.sum(0)
        return int(every), float(one / every), float(two / every)


def _judged(data: Measurements) -> dict[str, Judged]:
    """Conditions, for people -> their runs with a verdict."""
    found: dict[str, list[Measurement]] = {}
    for run in data.all:
        if run.verdict is not None and run.run.method in _METHODS:
            found.setdefault(_condition(run), []).append(run)
    return {name: Judged(tuple(runs)) for name, runs in sorted(found.items())}


def _condition(measurement: Measurement) -> str:
    run = measurement.run
    if run.domain in WRONG:
        return f"{run.source}: {run.domain}"
    if run.source.startswith((ROOMS, FAMILY)):
        name = run.source
    else:
        name = f"{run.source}, {'occluders' if run.domain == 'occlusion' else 'usual domains'}"
    return name + {"ours": "", "sequence": ", sequence mode", "masks": ", masks as target"}[run.method]


def _everything(data: Measurements) -> Judged:
    return Judged(tuple(run for group in _judged(data).values() for run in group.runs))


def verdict_table(data: Measurements) -> Table | None:
    """Verdicts beside Dice, for each condition and over all of them."""
    groups = _judged(data)
    if not groups:
        return None
    rows = [_verdict_row(name, judged) for name, judged in {**groups, "all": _everything(data)}.items()]
    caption = (
        f"The verdict knows images and kinematics alone; a mask is wrong where its Dice is below {RIGHT}. Area: under "
        "the ROC of the probability that comes with the verdict, 1 where it parts right and wrong masks. Made worse: "
        "Dice more than 0.01 below the start's."
    )
    header = ("condition", "runs", "wrong", "good", "good though wrong", "good though made worse", "area under the ROC")
    return Table("Verdicts", caption, header, tuple(rows))


def _verdict_row(name: str, judged: Judged) -> tuple[Cell, ...]:
    numbers = (len(judged.runs), len(judged.wrong), len(judged.good), judged.good_though_wrong, judged.worse_unnoticed)
    area = judged.area
    return tuple(map(Cell, (name, *map(str, numbers), NOTHING if area is None else f"{area:.3f}")))


def deviation_table(data: Measurements) -> Table | None:
    """How often errors of joints lie within their deviations."""
    rows = [
        tuple(map(Cell, (name, str(known[0]), f"{100 * known[1]:.0f} %", f"{100 * known[2]:.0f} %")))
        for name, judged in _judged(data).items()
        if (known := judged.within) is not None
    ]
    caption = (
        "Errors of measured joints in their reported deviation. Of a Gaussian, 68 and 95 % lie within one and two."
    )
    header = ("condition", "joint positions", "within one", "within two")
    return Table("Deviations", caption, header, tuple(rows)) if rows else None


def family_table(data: Measurements) -> Table | None:
    """Instruments of families that no training has."""
    rows = []
    for source in data.families():
        for domain in data.domains(source):
            runs = data.of(source=source, domain=domain, method="ours")
            starts = [run.start.dice for run in runs if run.start]
            cells = (source.removeprefix(FAMILY).strip(), domain, str(len(runs)))
            figures = (f"{100 * np.mean(values):.1f}" for values in (starts, [run.final.dice for run in runs]))
            rows.append(tuple(map(Cell, (*cells, *figures))))
    caption = "Synthetic frames, every joint put off at the start as on other synthetic frames. Dice in percent."
    header = ("instrument", "domain", "runs", "Dice before", "ours")
    return Table("Instruments that no training has", caption, header, tuple(rows)) if rows else None


def verdict_targets(data: Measurements) -> list[Target]:
    """The lines of the table of targets about verdicts, deviations, given masks and other instruments."""
    everything = _everything(data)
    good, runs = len(everything.good), len(everything.runs)
    wrong = f"{len(everything.wrong)} of {counted(runs, 'run')} wrong"
    within = everything.within
    return [
        make_target(
            f"verdict against Dice below {RIGHT}: area under the ROC",
            0.98,
            everything.area,
            wrong,
            at_least=True,
            text=lambda value: f"{value:.3f}",
            complete=any(run.run.domain in WRONG for run in everything.runs),
        ),
        make_target(
            "called good though the mask is wrong",
            0.01,
            everything.good_though_wrong / good if good else None,
            f"{everything.good_though_wrong} of {counted(good, 'good run')}",
            at_least=False,
            text=_percent,
        ),
        make_target(
            "made worse than the start and called good",
            0.0,
            everything.worse_unnoticed / good if good else None,
            f"{everything.worse_unnoticed} of {counted(good, 'good run')}",
            at_least=False,
            text=_percent,
        ),
        *(
            make_target(
                f"errors of joints within {name}: points of a percent away from {100 * wanted:.0f} %",
                tolerance,
                None if within is None else abs(within[place] - wanted),
                "" if within is None else f"{100 * within[place]:.1f} % of {counted(within[0], 'joint position')}",
                at_least=False,
                text=lambda value: f"{100 * value:.1f}",
            )
            for place, name, wanted, tolerance in ((1, "one deviation", 0.68, 0.08), (2, "two deviations", 0.95, 0.03))
        ),
        *(
            _dice(f"{source} frames, masks as target: mean Dice", least, data.of(source=source, method="masks"))
            for source, least in ((SYNTHETIC, 0.98), (REAL, 0.968))
        ),
        *(
            _dice(
                f"{source.removeprefix(FAMILY).strip()}, which no training has: mean Dice",
                0.95,
                data.of(source=source, method="ours"),
            )
            for source in data.families()
        ),
    ]


def _dice(what: str, least: float, runs: Items[Measurement]) -> Target:
    value = float(np.mean([run.final.dice for run in runs])) if runs else None
    return make_target(what, least, value, counted(len(runs), "run"), at_least=True, text=lambda value: f"{value:.3f}")


def _percent(value: float) -> str:
    return f"{100 * value:.1f} %"
