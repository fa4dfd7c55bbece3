"""Targets of the default solver, and whether measurements reach them."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import mean, median
from typing import Any

import numpy as np
from scipy.stats import rankdata

from ...settings import DOMAINS
from ...wording import counted
from .conditions import CROSSING, OCCLUSION, SHARE, WRONG
from .measurement import Measurement, on_gpu
from .scope import FAMILY, METHODS, PAPERS_STEPS, REAL, ROOMS, SYNTHETIC
from .statistics import DICE, DOMAIN_LABELS, GAINED, JOINT_MAE, VISIBLE_MAE, Measurements, pairs

RIGHT = 0.9
"""Dice from which a mask counts as right."""
NEAR_FINAL = 0.005
"""Distance to the final Dice that counts as converged."""
_RECOVERED = 0.95
_CONDITIONS = ("low_brightness", "bleeding", "smoke", "background_change")
"""Of real frames."""
_MODES = {"ours": "each frame alone", "sequence": "in sequence mode"}
_SHIFTED = tuple(domain for domain in DOMAINS if domain != "regular")
"""Domains that differ from the training data of networks."""


@dataclass(frozen=True)
class Target:
    """A target with its figure and verdict."""

    what: str
    target: str
    reached: str
    met: bool | None
    """None if open: nothing was measured, or only a part of the required runs, which meets it."""
    reference: str
    basis: str
    """Data that it was computed from."""


@dataclass(frozen=True)
class Reached:
    """The figure of a target."""

    value: float | None
    """None if nothing was measured."""
    basis: str
    """Data that it was computed from."""
    reference: str = ""
    """Reference figure, if it depends on the data."""
    complete: bool = True
    """Whether everything was measured that the target asks for; otherwise it can be missed but not met."""


_DICE = "{:.3f}".format


def _percent(value: float) -> str:
    return f"{100 * value:.1f} %"


def _whole_percent(value: float) -> str:
    return f"{100 * value:.0f} %"


@dataclass(frozen=True)
class Goal:
    """A target before anything is measured."""

    what: str
    bound: float
    """Smallest value that meets it, or the largest one."""
    reached: Callable[[Any], Reached]
    """From the data to the figure."""
    text: Callable[[float], str] = _DICE
    at_least: bool = True
    reference: str = ""
    """Reference figure."""

    def target(self, data: Any) -> Target:
        """The target with its verdict."""
        found, bound = self.reached(data), self.text(self.bound)
        allowed, reference = f"at {'least' if self.at_least else 'most'} {bound}", found.reference or self.reference
        if found.value is None:
            return Target(self.what, allowed, "not measured", None, reference, found.basis)
        met = found.value >= self.bound if self.at_least else found.value <= self.bound
        reached = self.text(found.value)
        if not met and reached == bound:
            reached = f"just {'below' if self.at_least else 'above'} {reached}"
        return Target(self.what, allowed, reached, met if found.complete or not met else None, reference, found.basis)


def targets(data: Measurements) -> list[Target]:
    """All targets, also those without measurements."""
    return [goal.target(data) for goal in _goals(data)]


def _goals(data: Measurements) -> list[Goal]:
    """The table of targets. Of the data, only the names of sources matter."""
    at_most = partial(Goal, at_least=False)
    return [
        Goal(
            "times faster than the paper's setting to equal Dice, same frames, same run", 8.0, _speedup, "{:.1f}".format
        ),
        at_most(
            f"iterations to within {NEAR_FINAL} of the final Dice, 2° off",
            10.0,
            _iterations,
            "{:g}".format,
            reference="paper: 30 to 50",
        ),
        at_most(
            "seconds per frame, cold start, 2° off, two arms, 640x480",
            1.0,
            _seconds,
            "{:.2f} s".format,
            reference="original implementation: 30 iterations of 3.5 to 13.8 s",
        ),
        at_most(
            "sequence mode, seconds per warm frame, two arms, 640x480, CPU", 0.3, _sequence_seconds, "{:.2f} s".format
        ),
        Goal(
            "sequence mode, frames per second, two arms, 640x480, GPU",
            30.0,
            _frames_per_second,
            "{:.1f}".format,
            reference="later work: 22, by a feed-forward network",
        ),
        *(
            Goal(
                f"synthetic, {error:g}° off, {label}: mean Dice in every domain",
                least,
                partial(_worst_domain, method=method, error=error),
                reference=f"paper, S-Reg: {paper}",
            )
            for method, label in _MODES.items()
            for error, least, paper in ((1.0, 0.985, "97.9"), (2.0, 0.98, "95.3"), (3.0, 0.97, "90.3"))
        ),
        *(
            at_most(
                f"synthetic, {error:g}° off, {label}: joint MAE, visible joints",
                most,
                partial(_joint_error, method=method, error=error),
                "{:.2f}°".format,
                reference=f"paper, S-Reg: {paper}",
            )
            for method, label in _MODES.items()
            for error, most, paper in ((1.0, 0.1, "0.1°"), (2.0, 0.25, "0.4°"), (3.0, 0.5, "1.3°"))
        ),
        Goal(
            f"synthetic, 5° off: frames recovered to a Dice of {_RECOVERED}",
            0.8,
            _recovery,
            _whole_percent,
            reference="paper: falls below an initial Dice of 75",
        ),
        Goal("real frames, each alone: mean Dice", 0.962, partial(_real_dice, method="ours")),
        Goal(
            "real frames, both cameras in one objective, posed: mean Dice",
            0.962,
            partial(_real_dice, method="stereo_posed"),
        ),
        Goal(
            "real frames, one calibration, joints as measured: mean Dice",
            0.94,
            partial(_real_dice, method="calibrated"),
        ),
        at_most(
            "real frames under low light, blood, smoke, other background: Dice lost against clean",
            0.01,
            _real_robustness,
            lambda value: _DICE(round(value, 3) + 0.0),  # not -0.000
            reference="paper: within 0.026",
        ),
        at_most("frames made worse than their start", 0.01, _made_worse, _percent),
        Goal(
            f"{100 * SHARE:.0f} % of the visible instrument occluded: mean Dice of the rest",
            0.95,
            _occlusion,
            reference="paper: excludes occlusion",
        ),
        at_most("synthetic, arms that cross: largest Dice below ACS from the same start", 0.01, _crossing),
        *(goal for camera in data.room_cameras() for goal in _room_goals(camera)),
        *(
            Goal(
                f"{source} frames: ahead of the best network that sees the image alone, worst shifted domain of each",
                5.0,
                partial(_ahead, source=source),
                "{:.1f} Dice points".format,
                reference="paper: 76.5 to 96.6",
            )
            for source in data.sources()
        ),
        Goal(f"verdict against Dice below {RIGHT}: area under the ROC", 0.98, _area),
        at_most("called good though the mask is wrong", 0.01, partial(_good_runs, which=wrong), _percent),
        at_most("made worse than the start and called good", 0.0, partial(_good_runs, which=_worse), _percent),
        *(
            at_most(
                f"errors of joints within {name}: points of a percent away from {100 * share:.0f} %",
                tolerance,
                partial(_deviations, place=place, share=share),
                lambda value: f"{100 * value:.1f}",
            )
            for place, name, share, tolerance in ((1, "one deviation", 0.68, 0.08), (2, "two deviations", 0.95, 0.03))
        ),
        *(
            Goal(
                f"{source} frames, masks as target: mean Dice",
                least,
                partial(_mean_dice, source=source, method="masks"),
            )
            for source, least in ((SYNTHETIC, 0.98), (REAL, 0.968))
        ),
        *(
            Goal(
                f"{source.removeprefix(FAMILY).strip()}, which no training has: mean Dice",
                0.95,
                partial(_mean_dice, source=source, method="ours"),
            )
            for source in data.families()
        ),
    ]


def _room_goals(camera: str) -> list[Goal]:
    """Of the held-out rooms."""
    what, behind = f"instruments in other rooms, {camera}:", "more than 0.01 below ACS from the same start"
    dice, below, worse = (partial(_rooms, camera=camera, figure=figure) for figure in ("dice", "below", "worse"))
    return [
        Goal(f"{what} mean Dice", 0.95, dice),
        Goal(f"{what} {behind}", 0.0, below, _percent, at_least=False),
        Goal(f"{what} made worse than their start", 0.01, worse, _percent, at_least=False),
    ]


def _mean(values: Iterable[float]) -> float | None:
    known = list(values)
    return mean(known) if known else None


def _median(values: Iterable[float]) -> float | None:
    known = list(values)
    return float(median(known)) if known else None


def steps_to_final(measurement: Measurement) -> int:
    """Steps until the best iterate first was near the final Dice."""
    bests = measurement.best_so_far()
    goal = min(measurement.final.dice, bests[-1].dice) - NEAR_FINAL
    return next(index for index, best in enumerate(bests) if best.dice >= goal)


def _speedup(data: Measurements) -> Reached:
    found = [pair for pair in pairs(data) if pair.gained]
    return Reached(
        _median(pair.ratio for pair in found),
        f"median over {counted(len(found), 'pair')} of runs in which the paper's setting gained at least {GAINED} "
        f"Dice: time to the Dice of its best of {PAPERS_STEPS}; {sum(pair.ours is None for pair in found)} never reach "
        "it and count as 0",
    )


def _iterations(data: Measurements) -> Reached:
    counts = [steps_to_final(m) for m in data.of(method="ours", error_deg=2.0)]
    return Reached(_median(counts), f"median over {counted(len(counts), 'run')}")


def _seconds(data: Measurements) -> Reached:
    values = [m.final.seconds for m in data.of(method="ours", source=SYNTHETIC, error_deg=2.0)]
    return Reached(_mean(values), f"mean over {counted(len(values), 'run')}")


def _sequence_runs(data: Measurements, *, gpu: bool) -> tuple[list[float], list[float]]:
    """Seconds per warm frame, and per frame, in sequence mode."""
    runs = [m for m in data.of(source=SYNTHETIC, method="sequence", error_deg=None) if on_gpu(m.machine) == gpu]
    return [m.final.seconds for m in runs if m.stopped == "warm"], [m.final.seconds for m in runs]


def _sequence_seconds(data: Measurements) -> Reached:
    warm, every = _sequence_runs(data, gpu=False)
    whole = f"; the mean of all frames, including searches for a start, is {mean(every):.2f} s" if every else ""
    basis = f"median over {counted(len(warm), 'frame')}, reading the image included{whole}"
    return Reached(_median(warm), basis)


def _frames_per_second(data: Measurements) -> Reached:
    warm, _ = _sequence_runs(data, gpu=True)
    basis = f"from the median over {len(warm)} warm frames, reading the image included"
    return Reached(1.0 / median(warm) if warm else None, basis)


def _worst(means: dict[str, float]) -> tuple[str | None, str]:
    """Domain of the lowest mean, and the text on it."""
    if not means:
        return None, "no runs"
    worst = min(means, key=lambda domain: means[domain])
    return worst, f"domains measured: {len(means)}; worst: {DOMAIN_LABELS[worst]}"


def _worst_domain(data: Measurements, method: str, error: float) -> Reached:
    by_domain = {
        domain: DICE.values(m.final for m in data.of(source=SYNTHETIC, domain=domain, method=method, error_deg=error))
        for domain in data.domains(SYNTHETIC)
    }
    means = {domain: mean(values) for domain, values in by_domain.items() if values}
    worst, text = _worst(means)
    if worst is None:
        return Reached(None, text, complete=False)
    basis = f"{text}, mean over {counted(len(by_domain[worst]), 'frame')}"
    return Reached(means[worst], basis, complete=set(means) == set(DOMAINS))


def _joint_error(data: Measurements, method: str, error: float) -> Reached:
    finals = [m.final for m in data.of(source=SYNTHETIC, method=method, error_deg=error)]
    visible, every = VISIBLE_MAE.values(finals), JOINT_MAE.values(finals)
    basis = f"mean over {counted(len(visible), 'run')}" if visible else "which joints are visible is not reported"
    return Reached(_mean(visible), basis + (f"; all measured joints: {mean(every):.2f}°" if every else ""))


def _recovery(data: Measurements) -> Reached:
    recovered = [m.final.dice >= _RECOVERED for m in data.of(source=SYNTHETIC, method="ours", error_deg=5.0)]
    return Reached(_mean(recovered), f"{sum(recovered)} of {counted(len(recovered), 'run')}")


def _real_dice(data: Measurements, method: str) -> Reached:
    runs, start = (data.of(source=REAL, domain="regular", method=name, error_deg=None) for name in (method, "start"))
    value = _mean(m.final.dice for m in start)
    without = "" if value is None else f"without optimization: {value:.3f} ({counted(len(start), 'frame')}); "
    return Reached(
        _mean(m.final.dice for m in runs),
        f"mean over {counted(len(runs), 'frame')} of the first camera",
        f"{without}mask as target: 0.968",
    )


def _real_robustness(data: Measurements) -> Reached:
    means = {
        domain: mean(m.final.dice for m in runs)
        for domain in ("regular", *_CONDITIONS)
        if (runs := data.of(source=REAL, domain=domain, method="ours", error_deg=None))
    }
    clean = means.pop("regular", None)
    worst, basis = _worst(means)
    lost = None if clean is None or worst is None else clean - means[worst]
    return Reached(lost, basis, complete=len(means) == len(_CONDITIONS))


def _worse(runs: Iterable[Measurement]) -> list[Measurement]:
    return [run for run in runs if run.made_worse]


def _made_worse(data: Measurements) -> Reached:
    runs = data.default_solver()
    worse = _worse(runs)
    from_truth = sum(m.run.source == SYNTHETIC and m.run.error_deg == 0.0 for m in worse)
    return Reached(
        len(worse) / len(runs) if runs else None,
        f"{len(worse)} of {counted(len(runs), 'run')} lost more than 0.01 Dice; {from_truth} of them started at the "
        f"true joints, {sum(m.run.domain == OCCLUSION for m in worse)} had occluders",
    )


def _occlusion(data: Measurements) -> Reached:
    labels = {"ours": "nothing said", "ours_given": "occluder given", "ours_proposed": "mask proposed"}
    alone, texts = [], ["nothing said of the occluder, the worse of synthetic and real frames"]
    for source in (SYNTHETIC, REAL):
        means = {
            method: mean(m.final.dice for m in runs)
            for method in labels
            if (runs := data.of(source=source, domain=OCCLUSION, method=method, error_deg=None))
        }
        alone += [means["ours"]] if "ours" in means else []
        if means:
            texts.append(f"{source}: " + ", ".join(f"{labels[method]} {value:.3f}" for method, value in means.items()))
    return Reached(min(alone, default=None), "; ".join(texts))


def _crossing(data: Measurements) -> Reached:
    """Of the default solver beside ACS, from the same starts."""
    alone, acs = (data.of(source=SYNTHETIC, domain=CROSSING, method=method) for method in ("ours", "acs"))
    beside = {(m.run.frame, m.run.error_deg): m.final.dice for m in acs}
    behind = [beside[key] - m.final.dice for m in alone if (key := (m.run.frame, m.run.error_deg)) in beside]
    basis = f"{counted(len(behind), 'run')}; mean Dice {mean(m.final.dice for m in alone):.3f}" if behind else ""
    return Reached(max(behind, default=None), basis)


def _rooms(data: Measurements, camera: str, figure: str) -> Reached:
    alone, acs = (data.in_rooms(camera, "held-out", method) for method in ("ours", "acs"))
    basis = f"{counted(len(alone), 'run')} in the rooms that are held out"
    beside = {(m.run.domain, m.run.frame): m.final.dice for m in acs}
    if figure == "worse":
        return Reached(_mean(m.made_worse for m in alone), basis)
    if figure == "dice":
        reference = f"ACS, our schedule: {mean(beside.values()):.3f}" if beside else ""
        return Reached(_mean(m.final.dice for m in alone), basis, reference)
    behind = [
        m.final.dice < beside[m.run.domain, m.run.frame] - 0.01 for m in alone if (m.run.domain, m.run.frame) in beside
    ]
    return Reached(_mean(behind), f"{sum(behind)} of {basis}")


def _mean_dice(data: Measurements, source: str, method: str) -> Reached:
    runs = data.of(source=source, method=method)
    return Reached(_mean(m.final.dice for m in runs), counted(len(runs), "run"))


@dataclass(frozen=True)
class ImageAlone:
    """Dice of a method on the frames of a source that ours was evaluated on, too."""

    method: str
    dice: dict[str, float]
    """Domain -> mean Dice in percent."""
    frames: int

    @property
    def worst(self) -> str:
        """The shifted domain with the lowest Dice."""
        return min((domain for domain in _SHIFTED if domain in self.dice), key=lambda domain: self.dice[domain])

    def __str__(self) -> str:
        return f"{self.dice[self.worst]:.1f} ({METHODS[self.method].label}, {DOMAIN_LABELS[self.worst]})"


def image_alone(data: Measurements, source: str) -> list[ImageAlone]:
    """Ours, then the measured networks that see the image alone."""
    methods = ["ours", *(name for name, method in METHODS.items() if method.image_alone)]
    runs = {name: data.of(source=source, method=name, error_deg=None) for name in methods}
    ours = {(m.run.domain, m.run.frame) for m in runs["ours"]}
    common = ours & {(m.run.domain, m.run.frame) for name in methods[1:] for m in runs[name]}
    rows = []
    for name in methods:
        by_domain: dict[str, list[float]] = {}
        for m in runs[name]:
            if (m.run.domain, m.run.frame) in common:
                by_domain.setdefault(m.run.domain, []).append(100.0 * m.final.dice)
        if by_domain or name == "ours":
            means = {domain: mean(values) for domain, values in by_domain.items()}
            rows.append(ImageAlone(name, means, len({frame for _, frame in common})))
    return rows


def _ahead(data: Measurements, source: str) -> Reached:
    """Difference in the worst shifted domain of each."""
    ours, *others = image_alone(data, source)
    others = [row for row in others if set(row.dice) & set(_SHIFTED)]
    if not others or not set(ours.dice) & set(_SHIFTED):
        return Reached(None, "no runs of both", complete=False)
    best = max(others, key=lambda row: row.dice[row.worst])
    return Reached(
        ours.dice[ours.worst] - best.dice[best.worst],
        f"{ours} against {best}; {counted(best.frames, 'frame')}, {counted(len(others), 'network')}",
        complete=all(set(_SHIFTED) <= set(row.dice) for row in (ours, best)),
    )


def judged(data: Measurements) -> dict[str, list[Measurement]]:
    """Condition -> runs with a verdict."""
    labels = {"ours": "", "sequence": ", sequence mode", "masks": ", masks as target"}
    found: dict[str, list[Measurement]] = {}
    for measurement in data.all:
        run = measurement.run
        if measurement.verdict is None or run.method not in labels:
            continue
        if run.domain in WRONG:
            name = f"{run.source}: {run.domain}"
        elif run.source.startswith((ROOMS, FAMILY)):
            name = run.source + labels[run.method]
        else:
            name = f"{run.source}, {'occluders' if run.domain == OCCLUSION else 'usual domains'}{labels[run.method]}"
        found.setdefault(name, []).append(measurement)
    return dict(sorted(found.items()))


def _all_judged(data: Measurements) -> list[Measurement]:
    return [run for runs in judged(data).values() for run in runs]


def wrong(runs: Iterable[Measurement]) -> list[Measurement]:
    """Runs with a wrong mask."""
    return [run for run in runs if run.final.dice < RIGHT]


def called_good(runs: Iterable[Measurement]) -> list[Measurement]:
    """Runs with a good verdict."""
    return [run for run in runs if run.verdict == "good"]


def area(runs: Sequence[Measurement]) -> float | None:
    """Area under the ROC of the probability of a wrong mask [1]; None without both right and wrong masks."""
    bad = np.array([run.final.dice < RIGHT for run in runs])
    if bad.all() or not bad.any():
        return None
    ranks, count = rankdata([run.probability or 0.0 for run in runs]), int(bad.sum())
    return float((ranks[bad].sum() - count * (count + 1) / 2) / (count * (len(bad) - count)))


def within(runs: Iterable[Measurement]) -> tuple[int, float, float] | None:
    """Number of joint positions with a deviation, and shares of errors within one and two of them [1]; None if none."""
    known = np.array([run.within for run in runs if run.within])
    if not len(known):
        return None
    every, one, two = known.sum(0)
    return int(every), float(one / every), float(two / every)


def _area(data: Measurements) -> Reached:
    runs = _all_judged(data)
    basis = f"{len(wrong(runs))} of {counted(len(runs), 'run')} wrong"
    return Reached(area(runs), basis, complete=any(run.run.domain in WRONG for run in runs))


def _good_runs(data: Measurements, which: Callable[[list[Measurement]], list[Measurement]]) -> Reached:
    """Share of some runs among those called good."""
    good = called_good(_all_judged(data))
    found = len(which(good))
    return Reached(found / len(good) if good else None, f"{found} of {counted(len(good), 'good run')}")


def _deviations(data: Measurements, place: int, share: float) -> Reached:
    known = within(_all_judged(data))
    if known is None:
        return Reached(None, "")
    basis = f"{100 * known[place]:.1f} % of {counted(int(known[0]), 'joint position')}"
    return Reached(abs(known[place] - share), basis)
