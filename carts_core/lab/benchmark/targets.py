"""Targets of the default solver, whether measurements reach them, and how often verdicts and deviations are right."""

from collections.abc import Sequence as Items
from dataclasses import dataclass
from statistics import mean, median

import numpy as np
from scipy.stats import rankdata

from ...html import Cell, Table
from ...settings import DOMAINS
from ...wording import counted
from .conditions import CROSSING, OCCLUSION, SHARE, WRONG
from .measurement import Measurement, on_gpu
from .scope import FAMILY, METHODS, PAPERS_STEPS, REAL, ROOMS, SYNTHETIC
from .statistics import DOMAIN_LABELS, GAINED, NOTHING, Measurements, Target, make_target, pairs

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


_RECOVERED = 0.95
_CONDITIONS = ("low_brightness", "bleeding", "smoke", "background_change")
"""Of real frames."""
_MODES = {"ours": "each frame alone", "sequence": "in sequence mode"}


def accuracy_targets(data: Measurements) -> list[Target]:
    """The lines of the table that are about masks and joints."""
    return [
        *(_dice_after(data, method, *bound) for method in _MODES for bound in ((1.0, 0.985), (2.0, 0.98), (3.0, 0.97))),
        *(_joint_error(data, method, *bound) for method in _MODES for bound in ((1.0, 0.1), (2.0, 0.25), (3.0, 0.5))),
        _recovery(data),
        _real_dice(data, "real frames, each alone: mean Dice", "ours", 0.962),
        _real_dice(data, "real frames, both cameras in one objective, posed: mean Dice", "stereo_posed", 0.962),
        _real_dice(data, "real frames, one calibration, joints as measured: mean Dice", "calibrated", 0.94),
        _real_robustness(data),
        _made_worse(data),
        _occlusion(data),
        _crossing(data),
        *(target for camera in data.room_cameras() for target in _rooms(data, camera)),
    ]


def _worst_of(means: dict[str, float], worst: str | None) -> str:
    return "no runs" if worst is None else f"domains measured: {len(means)}; worst: {DOMAIN_LABELS[worst]}"


def _dice_after(data: Measurements, method: str, error: float, least: float) -> Target:
    by_domain = {
        domain: [m.final.dice for m in data.of(source=SYNTHETIC, domain=domain, method=method, error_deg=error)]
        for domain in data.domains(SYNTHETIC)
    }
    means = {domain: mean(values) for domain, values in by_domain.items() if values}
    worst = min(means, key=lambda domain: means[domain]) if means else None
    paper = {1.0: "97.9", 2.0: "95.3", 3.0: "90.3"}[error]
    return make_target(
        f"synthetic, {error:g}° off, {_MODES[method]}: mean Dice in every domain",
        least,
        None if worst is None else means[worst],
        _worst_of(means, worst) + (f", mean over {counted(len(by_domain[worst]), 'frame')}" if worst else ""),
        at_least=True,
        text=lambda value: f"{value:.3f}",
        reference=f"paper, S-Reg: {paper}",
        complete=set(means) == set(DOMAINS),
    )


def _joint_error(data: Measurements, method: str, error: float, most: float) -> Target:
    runs = data.of(source=SYNTHETIC, method=method, error_deg=error)
    visible = [m.final.visible_joint_mae_deg for m in runs if m.final.visible_joint_mae_deg is not None]
    everything = [m.final.joint_mae_deg for m in runs if m.final.joint_mae_deg is not None]
    also = f"; all measured joints: {mean(everything):.2f}°" if everything else ""
    paper = {1.0: "0.1°", 2.0: "0.4°", 3.0: "1.3°"}[error]
    return make_target(
        f"synthetic, {error:g}° off, {_MODES[method]}: joint MAE, visible joints",
        most,
        mean(visible) if visible else None,
        (f"mean over {counted(len(visible), 'run')}" if visible else "which joints are visible is not reported") + also,
        at_least=False,
        text=lambda value: f"{value:.2f}°",
        reference=f"paper, S-Reg: {paper}",
    )


def _recovery(data: Measurements) -> Target:
    recovered = [m.final.dice >= _RECOVERED for m in data.of(source=SYNTHETIC, method="ours", error_deg=5.0)]
    return make_target(
        f"synthetic, 5° off: frames recovered to a Dice of {_RECOVERED}",
        0.8,
        mean(recovered) if recovered else None,
        f"{sum(recovered)} of {counted(len(recovered), 'run')}",
        at_least=True,
        text=lambda value: f"{100 * value:.0f} %",
        reference="paper: falls below an initial Dice of 75",
    )


def _real(data: Measurements, domain: str) -> float | None:
    values = [m.final.dice for m in data.of(source=REAL, domain=domain, method="ours", error_deg=None)]
    return mean(values) if values else None


def _real_dice(data: Measurements, what: str, method: str, least: float) -> Target:
    runs = data.of(source=REAL, domain="regular", method=method, error_deg=None)
    start = [m.final.dice for m in data.of(source=REAL, domain="regular", method="start", error_deg=None)]
    without = f"without optimization: {mean(start):.3f} ({counted(len(start), 'frame')}); " if start else ""
    return make_target(
        what,
        least,
        mean(m.final.dice for m in runs) if runs else None,
        f"mean over {counted(len(runs), 'frame')} of the first camera",
        at_least=True,
        text=lambda value: f"{value:.3f}",
        reference=f"{without}mask as target: 0.968",
    )


def _real_robustness(data: Measurements) -> Target:
    clean = _real(data, "regular")
    altered = {domain: value for domain in _CONDITIONS if (value := _real(data, domain)) is not None}
    worst = min(altered, key=lambda domain: altered[domain]) if altered else None
    return make_target(
        "real frames under low light, blood, smoke, other background: Dice lost against clean",
        0.01,
        None if clean is None or worst is None else clean - altered[worst],
        _worst_of(altered, worst),
        at_least=False,
        text=lambda value: f"{round(value, 3) + 0.0:.3f}",
        reference="paper: within 0.026",
        complete=len(altered) == len(_CONDITIONS),
    )


def _made_worse(data: Measurements) -> Target:
    runs = data.default_solver()
    worse = [m for m in runs if m.made_worse]
    covered = sum(m.run.domain == OCCLUSION for m in worse)
    from_truth = sum(m.run.source == SYNTHETIC and m.run.error_deg == 0.0 for m in worse)
    return make_target(
        "frames made worse than their start",
        0.01,
        len(worse) / len(runs) if runs else None,
        f"{len(worse)} of {counted(len(runs), 'run')} lost more than 0.01 Dice; {from_truth} of them started at the "
        f"true joints, {covered} had occluders",
        at_least=False,
        text=lambda value: f"{100 * value:.1f} %",
    )


def _crossing(data: Measurements) -> Target:
    """Of the default solver beside ACS, from the same starts."""
    alone, acs = (data.of(source=SYNTHETIC, domain=CROSSING, method=method) for method in ("ours", "acs"))
    beside = {(m.run.frame, m.run.error_deg): m.final.dice for m in acs}
    behind = [beside[key] - m.final.dice for m in alone if (key := (m.run.frame, m.run.error_deg)) in beside]
    return make_target(
        "synthetic, arms that cross: largest Dice below ACS from the same start",
        0.01,
        max(behind) if behind else None,
        f"{counted(len(behind), 'run')}; mean Dice {mean(m.final.dice for m in alone):.3f}" if behind else "",
        at_least=False,
        text=lambda value: f"{value:.3f}",
    )


def _rooms(data: Measurements, camera: str) -> list[Target]:
    """Of the rooms that are held out."""
    alone, acs = (data.in_rooms(camera, "held-out", method) for method in ("ours", "acs"))
    beside = {(m.run.domain, m.run.frame): m.final.dice for m in acs}
    behind = [
        m.final.dice < beside[m.run.domain, m.run.frame] - 0.01 for m in alone if (m.run.domain, m.run.frame) in beside
    ]
    basis = f"{counted(len(alone), 'run')} in the rooms that are held out"
    percent = lambda value: f"{100 * value:.1f} %"  # noqa: E731
    return [
        make_target(
            f"instruments in other rooms, {camera}: mean Dice",
            0.95,
            mean(m.final.dice for m in alone) if alone else None,
            basis,
            at_least=True,
            text=lambda value: f"{value:.3f}",
            reference=f"ACS, our schedule: {mean(beside.values()):.3f}" if beside else "",
        ),
        make_target(
            f"instruments in other rooms, {camera}: more than 0.01 below ACS from the same start",
            0.0,
            mean(behind) if behind else None,
            f"{sum(behind)} of {basis}",
            at_least=False,
            text=percent,
        ),
        make_target(
            f"instruments in other rooms, {camera}: made worse than their start",
            0.01,
            mean(m.made_worse for m in alone) if alone else None,
            basis,
            at_least=False,
            text=percent,
        ),
    ]


def _occlusion(data: Measurements) -> Target:
    labels = {"ours": "nothing said", "ours_given": "occluder given", "ours_proposed": "mask proposed"}
    means = {
        source: {
            method: mean(m.final.dice for m in runs)
            for method in labels
            if (runs := data.of(source=source, domain=OCCLUSION, method=method, error_deg=None))
        }
        for source in (SYNTHETIC, REAL)
    }
    alone = [found["ours"] for found in means.values() if "ours" in found]
    texts = (
        f"{source}: " + ", ".join(f"{labels[method]} {value:.3f}" for method, value in found.items())
        for source, found in means.items()
        if found
    )
    return make_target(
        f"{100 * SHARE:.0f} % of the visible instrument occluded: mean Dice of the rest",
        0.95,
        min(alone) if alone else None,
        "; ".join(("nothing said of the occluder, the worse of synthetic and real frames", *texts)),
        at_least=True,
        text=lambda value: f"{value:.3f}",
        reference="paper: excludes occlusion",
    )


NEAR_FINAL = 0.005


def speed_targets(data: Measurements) -> list[Target]:
    """The lines of the table that are about time and steps."""
    return [_speedup(data), _iterations(data), _seconds(data), _sequence_seconds(data), _frames_per_second(data)]


def steps_to_final(measurement: Measurement) -> int:
    """Steps until the best iterate first was near the final Dice."""
    bests = measurement.best_so_far()
    goal = min(measurement.final.dice, bests[-1].dice) - NEAR_FINAL
    return next(index for index, best in enumerate(bests) if best.dice >= goal)


def _speedup(data: Measurements) -> Target:
    found = [pair for pair in pairs(data) if pair.gained]
    return make_target(
        "times faster than the paper's setting to equal Dice, same frames, same run",
        8.0,
        median(pair.ratio for pair in found) if found else None,
        f"median over {counted(len(found), 'pair')} of runs in which the paper's setting gained at least {GAINED} "
        f"Dice: time to the Dice of its best of {PAPERS_STEPS}; {sum(pair.ours is None for pair in found)} never reach "
        "it and count as 0",
        at_least=True,
        text=lambda value: f"{value:.1f}",
    )


def _iterations(data: Measurements) -> Target:
    counts = [steps_to_final(m) for m in data.of(method="ours", error_deg=2.0)]
    return make_target(
        f"iterations to within {NEAR_FINAL} of the final Dice, 2° off",
        10.0,
        float(median(counts)) if counts else None,
        f"median over {counted(len(counts), 'run')}",
        at_least=False,
        text=lambda value: f"{value:g}",
        reference="paper: 30 to 50",
    )


def _seconds(data: Measurements) -> Target:
    values = [m.final.seconds for m in data.of(method="ours", source=SYNTHETIC, error_deg=2.0)]
    return make_target(
        "seconds per frame, cold start, 2° off, two arms, 640x480",
        1.0,
        mean(values) if values else None,
        f"mean over {counted(len(values), 'run')}",
        at_least=False,
        text=lambda value: f"{value:.2f} s",
        reference="original implementation: 30 iterations of 3.5 to 13.8 s",
    )


def _sequence_frames(data: Measurements, *, gpu: bool) -> list[Measurement]:
    chosen = data.of(source=SYNTHETIC, method="sequence", error_deg=None)
    return [m for m in chosen if on_gpu(m.machine) == gpu]


def _warm_seconds(data: Measurements, *, gpu: bool) -> list[float]:
    return [m.final.seconds for m in _sequence_frames(data, gpu=gpu) if m.stopped == "warm"]


def _sequence_seconds(data: Measurements) -> Target:
    seconds, every = _warm_seconds(data, gpu=False), _sequence_frames(data, gpu=False)
    whole = ""
    if every:
        average = mean(m.final.seconds for m in every)
        whole = f"; the mean of all frames, with what finds where to begin, is {average:.2f} s"
    return make_target(
        "sequence mode, seconds per warm frame, two arms, 640x480, CPU",
        0.3,
        median(seconds) if seconds else None,
        f"median over {counted(len(seconds), 'frame')}, reading the image included{whole}",
        at_least=False,
        text=lambda value: f"{value:.2f} s",
    )


def _frames_per_second(data: Measurements) -> Target:
    seconds = _warm_seconds(data, gpu=True)
    return make_target(
        "sequence mode, frames per second, two arms, 640x480, GPU",
        30.0,
        1.0 / median(seconds) if seconds else None,
        f"from the median over {len(seconds)} warm frames, reading the image included",
        at_least=True,
        text=lambda value: f"{value:.1f}",
        reference="later work: 22, by a feed-forward network",
    )


_SHIFTED = tuple(domain for domain in DOMAINS if domain != "regular")
"""Domains that differ from what networks are trained on."""
_AHEAD = 5.0
"""Dice points by which ours is to be ahead in the worst of them."""


@dataclass(frozen=True)
class _Row:
    """A method on one source's frames, those that ours was evaluated on, too."""

    method: str
    dice: dict[str, float]
    """Domain -> mean Dice in percent."""
    frames: int

    @property
    def worst(self) -> str:
        """The shifted domain in which it is worst."""
        return min((domain for domain in _SHIFTED if domain in self.dice), key=lambda domain: self.dice[domain])

    def in_words(self) -> str:
        """Its worst shifted domain, for people."""
        return f"{self.dice[self.worst]:.1f} ({METHODS[self.method].label}, {DOMAIN_LABELS[self.worst]})"


def image_alone_table(data: Measurements) -> Table | None:
    """For each domain the best network that sees the image alone, and ours."""
    rows = []
    for source in data.sources():
        ours, *others = _rows(data, source)
        for domain in DOMAINS:
            known = [row for row in others if domain in row.dice]
            if not known or domain not in ours.dice:
                continue
            best = max(known, key=lambda row: row.dice[domain])
            ahead = ours.dice[domain] - best.dice[domain]
            wins = "neither" if round(ahead, 1) == 0 else "ours" if ahead > 0 else METHODS[best.method].label
            cells = (source, DOMAIN_LABELS[domain], METHODS[best.method].label)
            figures = (f"{best.dice[domain]:.1f}", f"{ours.dice[domain]:.1f}", f"{wins}, by {abs(ahead):.1f}")
            rows.append((*map(Cell, cells), *map(Cell, figures)))
    header = ("frames", "domain", "best network that sees the image alone", "its Dice", "ours", "who wins")
    caption = (
        "Networks that see the image and no kinematics, the best one of each domain, and the default solver from the "
        "measured kinematics. Mean Dice in percent over the same frames."
    )
    return Table("Networks that see the image alone", caption, header, tuple(rows)) if rows else None


def image_alone_targets(data: Measurements) -> list[Target]:
    """How far ours is ahead in the worst domain that networks are not trained on, for each source."""
    found = []
    for source in data.sources():
        ours, *others = _rows(data, source)
        others = [row for row in others if set(row.dice) & set(_SHIFTED)]
        known = bool(others) and bool(set(ours.dice) & set(_SHIFTED))
        best = max(others, key=lambda row: row.dice[row.worst]) if known else None
        found.append(
            make_target(
                f"{source} frames: ahead of the best network that sees the image alone, worst shifted domain of each",
                _AHEAD,
                None if best is None else ours.dice[ours.worst] - best.dice[best.worst],
                "no runs of both"
                if best is None
                else f"{ours.in_words()} against {best.in_words()}; {counted(best.frames, 'frame')}, "
                f"{counted(len(others), 'network')}",
                at_least=True,
                text=lambda value: f"{value:.1f} Dice points",
                reference="paper: 76.5 to 96.6",
                complete=best is not None and all(set(_SHIFTED) <= set(row.dice) for row in (ours, best)),
            )
        )
    return found


def _rows(data: Measurements, source: str) -> list[_Row]:
    """Ours, then the networks that were measured."""
    methods = ["ours", *(name for name, method in METHODS.items() if method.image_alone)]
    runs = {name: data.of(source=source, method=name, error_deg=None) for name in methods}
    ours = {(m.run.domain, m.run.frame) for m in runs["ours"]}
    seen = [m for name in methods[1:] for m in runs[name]]
    common = ours & {(m.run.domain, m.run.frame) for m in seen}
    rows = []
    for name in methods:
        by_domain: dict[str, list[float]] = {}
        for m in runs[name]:
            if (m.run.domain, m.run.frame) in common:
                by_domain.setdefault(m.run.domain, []).append(100.0 * m.final.dice)
        if by_domain or name == "ours":
            frames = len({frame for _, frame in common})
            rows.append(_Row(name, {domain: mean(values) for domain, values in by_domain.items()}, frames))
    return rows


def targets(data: Measurements) -> list[Target]:
    """All targets, also those that could not be computed from what is there."""
    return [*speed_targets(data), *accuracy_targets(data), *image_alone_targets(data), *verdict_targets(data)]
