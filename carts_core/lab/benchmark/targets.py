"""Performance targets of the default solver, compared with measurements."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from statistics import mean, median

import numpy as np
from scipy.stats import rankdata

from ...settings import DOMAINS
from ...wording import counted
from .conditions import CROSSING, OCCLUSION, SHARE, WRONG
from .measurement import Measurement, on_gpu
from .scope import FAMILY, METHODS, PAPERS_STEPS, REAL, ROOMS, SYNTHETIC
from .statistics import DOMAIN_LABELS, JOINT_MAE, MIN_GAIN, VISIBLE_MAE, Measurements, pairs, read_table

MIN_CORRECT_DICE = 0.9
"""Minimum Dice of a correct mask."""
NEAR_FINAL = 0.005
"""Difference from the final Dice below which a run is considered converged."""
_RECOVERED = 0.95
_CONDITIONS = ("low_brightness", "bleeding", "smoke", "background_change")
"""Simulated conditions of real frames that have a target."""
_MODES = {"ours": "each frame alone", "sequence": "in sequence mode"}
_SHIFTED = tuple(domain for domain in DOMAINS if domain != "regular")
"""Domains that differ from the networks' training data."""
_TARGETS = read_table("targets.toml")


@dataclass(frozen=True)
class Target:
    """Target with its measured value, and whether it is met."""

    what: str
    target: str
    reached: str
    met: bool | None
    """Whether the target is met; None if undecided, because no runs were measured, or because only some runs were
    measured and these meet the target."""
    reference: str
    basis: str
    """Description of the data from which the value was computed."""


def target_of(
    name: str, value: float | None, basis: str, *, reference: str = "", complete: bool = True, **names: object
) -> Target:
    """Create a target of `targets.toml`, and decide whether it is met.

    Args:
        name: name of the table in `targets.toml`.
        value: measured value; None if nothing was measured.
        basis: description of the data from which the value was computed.
        reference: reference for the comparison, if it depends on the data.
        complete: whether all required runs were measured; otherwise the target can be missed but not met.
        names: strings and numbers for the label.
    """
    entry = _TARGETS[name]
    scale, form, most = entry.get("scale", 1), entry.get("text", "{:.3f}"), "most" in entry
    bound = entry["most" if most else "least"]
    what, bound_text = entry["what"].format(**names), form.format(scale * bound)
    allowed, reference = f"at {'most' if most else 'least'} {bound_text}", reference or entry.get("reference", "")
    if value is None:
        return Target(what, allowed, "not measured", None, reference, basis)
    met, reached = value <= bound if most else value >= bound, form.format(scale * value)
    if not met and reached == bound_text:
        reached = f"just {'above' if most else 'below'} {reached}"
    return Target(what, allowed, reached, met if complete or not met else None, reference, basis)


def targets(data: Measurements) -> list[Target]:
    """All targets, including those without measurements."""
    return [
        *_speed(data),
        *_synthetic(data),
        *_real(data),
        *_safety(data),
        *(target for source in data.sources(ROOMS) for target in _rooms(data, source)),
        *(_ahead(data, source) for source in data.sources()),
        *_verdicts(data),
        *(_mean_dice(data, f"masks_{source}", source, "masks") for source in (SYNTHETIC, REAL)),
        *(_mean_dice(data, "family", source, "ours") for source in data.sources(FAMILY)),
    ]


def _mean(values: Iterable[float]) -> float | None:
    known = list(values)
    return mean(known) if known else None


def _median(values: Iterable[float]) -> float | None:
    known = list(values)
    return float(median(known)) if known else None


def _mean_dice(data: Measurements, name: str, source: str, method: str) -> Target:
    runs = data.of(source=source, method=method)
    instrument = source.removeprefix(FAMILY).strip()
    return target_of(name, _mean(m.final.dice for m in runs), counted(len(runs), "run"), instrument=instrument)


def steps_to_final(measurement: Measurement) -> int:
    """Number of steps until the best iterate is near the final Dice."""
    bests = measurement.best_so_far()
    goal = min(measurement.final.dice, bests[-1].dice) - NEAR_FINAL
    return next(index for index, best in enumerate(bests) if best.dice >= goal)


def _speed(data: Measurements) -> Iterator[Target]:
    found = [pair for pair in pairs(data) if pair.gained]
    yield target_of(
        "speedup",
        _median(pair.ratio for pair in found),
        f"median over {counted(len(found), 'pair')} of runs in which the paper's setting gained at least {MIN_GAIN} "
        f"Dice: time to its best Dice in {PAPERS_STEPS} iterations; in {sum(pair.ours is None for pair in found)}, our "
        "solver never reaches this Dice, which counts as 0",
    )
    counts = [steps_to_final(m) for m in data.of(method="ours", error_deg=2.0)]
    yield target_of("iterations", _median(counts), f"median over {counted(len(counts), 'run')}", near=NEAR_FINAL)
    cold = [m.final.seconds for m in data.of(method="ours", source=SYNTHETIC, error_deg=2.0)]
    yield target_of("cold_seconds", _mean(cold), f"mean over {counted(len(cold), 'run')}")
    runs = data.of(source=SYNTHETIC, method="sequence", error_deg=None)
    every = [m.final.seconds for m in runs if not on_gpu(m.machine)]
    warm, on_card = (
        [m.final.seconds for m in runs if m.stopped == "warm" and on_gpu(m.machine) == gpu] for gpu in (False, True)
    )
    whole = f"; the mean of all frames, including searches for a start, is {mean(every):.2f} s" if every else ""
    basis = f"median over {counted(len(warm), 'frame')}, including reading the image{whole}"
    yield target_of("warm_seconds", _median(warm), basis)
    basis = f"from the median over {len(on_card)} warm frames, including reading the image"
    yield target_of("frames_per_second", 1.0 / median(on_card) if on_card else None, basis)


def _worst(means: dict[str, float]) -> tuple[str | None, str]:
    """Domain with the lowest mean, and a description."""
    if not means:
        return None, "no runs"
    worst = min(means, key=lambda domain: means[domain])
    return worst, f"domains measured: {len(means)}; worst: {DOMAIN_LABELS[worst]}"


def _synthetic(data: Measurements) -> Iterator[Target]:
    for (method, label), error in product(_MODES.items(), (1, 2, 3)):
        by_domain = {
            domain: [m.final.dice for m in runs]
            for domain in data.domains(SYNTHETIC)
            if (runs := data.of(source=SYNTHETIC, domain=domain, method=method, error_deg=error))
        }
        means = {domain: mean(values) for domain, values in by_domain.items()}
        worst, basis = _worst(means)
        if worst is not None:
            basis += f", mean over {counted(len(by_domain[worst]), 'frame')}"
        value, complete = None if worst is None else means[worst], set(means) == set(DOMAINS)
        yield target_of(f"dice_{error}", value, basis, complete=complete, mode=label)
    for (method, label), error in product(_MODES.items(), (1, 2, 3)):
        finals = [m.final for m in data.of(source=SYNTHETIC, method=method, error_deg=error)]
        visible, every = VISIBLE_MAE.values(finals), JOINT_MAE.values(finals)
        basis = f"mean over {counted(len(visible), 'run')}" if visible else "visibility of joints is not reported"
        basis += f"; all measured joints: {mean(every):.2f}°" if every else ""
        yield target_of(f"joint_error_{error}", _mean(visible), basis, mode=label)
    recovered = [m.final.dice >= _RECOVERED for m in data.of(source=SYNTHETIC, method="ours", error_deg=5.0)]
    basis = f"{sum(recovered)} of {counted(len(recovered), 'run')}"
    yield target_of("recovery", _mean(recovered), basis, recovered=_RECOVERED)


def _real(data: Measurements) -> Iterator[Target]:
    start = data.of(source=REAL, domain="regular", method="start", error_deg=None)
    value = _mean(m.final.dice for m in start)
    without = "" if value is None else f"without optimization: {value:.3f} ({counted(len(start), 'frame')}); "
    for method in ("ours", "stereo_posed", "calibrated"):
        runs = data.of(source=REAL, domain="regular", method=method, error_deg=None)
        dice, basis = _mean(m.final.dice for m in runs), f"mean over {counted(len(runs), 'frame')} of the first camera"
        yield target_of(f"real_{method}", dice, basis, reference=f"{without}mask as target: 0.968")
    means = {
        domain: mean(m.final.dice for m in runs)
        for domain in ("regular", *_CONDITIONS)
        if (runs := data.of(source=REAL, domain=domain, method="ours", error_deg=None))
    }
    clean = means.pop("regular", None)
    worst, basis = _worst(means)
    # This avoids -0.000 for a loss that is rounded to zero.
    lost = None if clean is None or worst is None else clean - means[worst]
    lost = 0.0 if lost is not None and -0.0005 < lost < 0 else lost
    yield target_of("real_robustness", lost, basis, complete=len(means) == len(_CONDITIONS))


def _safety(data: Measurements) -> Iterator[Target]:
    runs = data.default_solver()
    worse = [run for run in runs if run.made_worse]
    from_truth = sum(m.run.source == SYNTHETIC and m.run.error_deg == 0.0 for m in worse)
    yield target_of(
        "made_worse",
        len(worse) / len(runs) if runs else None,
        f"{len(worse)} of {counted(len(runs), 'run')} lost more than 0.01 Dice; {from_truth} of them started at the "
        f"true joints, {sum(m.run.domain == OCCLUSION for m in worse)} had occluders",
    )
    labels = {"ours": "occluder unknown", "ours_given": "occluder given", "ours_proposed": "mask proposed"}
    alone, texts = [], ["occluder unknown, the worse of synthetic and real frames"]
    for source in (SYNTHETIC, REAL):
        means = {
            method: mean(m.final.dice for m in runs)
            for method in labels
            if (runs := data.of(source=source, domain=OCCLUSION, method=method, error_deg=None))
        }
        alone += [means["ours"]] if "ours" in means else []
        if means:
            texts.append(f"{source}: " + ", ".join(f"{labels[method]} {value:.3f}" for method, value in means.items()))
    yield target_of("occlusion", min(alone, default=None), "; ".join(texts), share=100 * SHARE)
    ours, acs = (data.of(source=SYNTHETIC, domain=CROSSING, method=method) for method in ("ours", "acs"))
    beside = {(m.run.frame, m.run.error_deg): m.final.dice for m in acs}
    behind = [beside[key] - m.final.dice for m in ours if (key := (m.run.frame, m.run.error_deg)) in beside]
    basis = f"{counted(len(behind), 'run')}; mean Dice {mean(m.final.dice for m in ours):.3f}" if behind else ""
    yield target_of("crossing", max(behind, default=None), basis)


def _rooms(data: Measurements, source: str) -> Iterator[Target]:
    """Targets of the held-out rooms of one camera."""
    alone, acs = (data.in_rooms(source, "held-out", method) for method in ("ours", "acs"))
    camera, basis = source.removeprefix(ROOMS).strip(), f"{counted(len(alone), 'run')} on held-out backgrounds"
    beside = {(m.run.domain, m.run.frame): m.final.dice for m in acs}
    reference = f"ACS, our schedule: {mean(beside.values()):.3f}" if beside else ""
    yield target_of("room_dice", _mean(m.final.dice for m in alone), basis, reference=reference, camera=camera)
    behind = [m.final.dice < beside[key] - 0.01 for m in alone if (key := (m.run.domain, m.run.frame)) in beside]
    yield target_of("room_below", _mean(behind), f"{sum(behind)} of {basis}", camera=camera)
    yield target_of("room_worse", _mean(m.made_worse for m in alone), basis, camera=camera)


def image_alone(data: Measurements, source: str) -> tuple[dict[str, dict[str, float]], int]:
    """Mean Dice in percent by method and domain, and the number of frames.

    Methods are the default solver (first) and the measured networks with only the image as input. Frames are those
    measured with the default solver and at least one of these networks.
    """
    methods = ["ours", *(name for name, method in METHODS.items() if method.image_alone)]
    runs = {name: data.of(source=source, method=name, error_deg=None) for name in methods}
    ours = {(m.run.domain, m.run.frame) for m in runs["ours"]}
    common = ours & {(m.run.domain, m.run.frame) for name in methods[1:] for m in runs[name]}
    found: dict[str, dict[str, float]] = {}
    for name in methods:
        by_domain: dict[str, list[float]] = {}
        for m in runs[name]:
            if (m.run.domain, m.run.frame) in common:
                by_domain.setdefault(m.run.domain, []).append(100.0 * m.final.dice)
        if by_domain or name == "ours":
            found[name] = {domain: mean(values) for domain, values in by_domain.items()}
    return found, len({frame for _, frame in common})


def _ahead(data: Measurements, source: str) -> Target:
    """Target for the lead of the default solver over the best network, each in its worst shifted domain."""
    dice, frames = image_alone(data, source)
    worst = {
        method: min(shifted, key=lambda domain: known[domain])
        for method, known in dice.items()
        if (shifted := [domain for domain in _SHIFTED if domain in known])
    }
    others = [method for method in worst if method != "ours"]
    if not others or "ours" not in worst:
        return target_of("ahead", None, "no runs of both methods", source=source)
    best = max(others, key=lambda method: dice[method][worst[method]])
    ours, theirs = (
        f"{dice[method][worst[method]]:.1f} ({METHODS[method].label}, {DOMAIN_LABELS[worst[method]]})"
        for method in ("ours", best)
    )
    return target_of(
        "ahead",
        dice["ours"][worst["ours"]] - dice[best][worst[best]],
        f"{ours} against {theirs}; {counted(frames, 'frame')}, {counted(len(others), 'network')}",
        complete=all(set(_SHIFTED) <= set(dice[method]) for method in ("ours", best)),
        source=source,
    )


def with_verdict(data: Measurements) -> dict[str, list[Measurement]]:
    """Runs with a verdict, by condition."""
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


def wrong_masks(runs: Iterable[Measurement]) -> list[Measurement]:
    """Runs with a wrong mask."""
    return [run for run in runs if run.final.dice < MIN_CORRECT_DICE]


def good_verdicts(runs: Iterable[Measurement]) -> list[Measurement]:
    """Runs with a good verdict."""
    return [run for run in runs if run.verdict == "good"]


def roc_area(runs: Sequence[Measurement]) -> float | None:
    """Area under the ROC curve of the probability of a wrong mask [1]; None unless there are correct and wrong
    masks."""
    bad = np.array([run.final.dice < MIN_CORRECT_DICE for run in runs])
    if bad.all() or not bad.any():
        return None
    ranks, count = rankdata([run.probability or 0.0 for run in runs]), int(bad.sum())
    return float((ranks[bad].sum() - count * (count + 1) / 2) / (count * (len(bad) - count)))


def within(runs: Iterable[Measurement]) -> tuple[int, float, float] | None:
    """Number of joint positions with a standard deviation, and shares of errors within 1 and 2 standard deviations [1];
    None without such joint positions."""
    known = np.array([run.within for run in runs if run.within])
    if not len(known):
        return None
    every, one, two = known.sum(0)
    return int(every), float(one / every), float(two / every)


def _verdicts(data: Measurements) -> Iterator[Target]:
    runs = [run for runs in with_verdict(data).values() for run in runs]
    good, known, wrong_inputs = good_verdicts(runs), within(runs), any(run.run.domain in WRONG for run in runs)
    basis = f"{len(wrong_masks(runs))} of {counted(len(runs), 'run')} wrong"
    yield target_of("area", roc_area(runs), basis, complete=wrong_inputs, right=MIN_CORRECT_DICE)
    for name, found in (("wrong", len(wrong_masks(good))), ("worse", sum(run.made_worse for run in good))):
        basis = f"{found} of {counted(len(good), 'good run')}"
        yield target_of(f"good_though_{name}", found / len(good) if good else None, basis)
    for place, name, share in ((1, "one", 0.68), (2, "two", 0.95)):
        basis = f"{100 * known[place]:.1f} % of {counted(known[0], 'joint position')}" if known else ""
        yield target_of(f"within_{name}", abs(known[place] - share) if known else None, basis)
