"""How fast the default solver is meant to be, and what the measurements say."""

from statistics import mean, median

from ...wording import counted
from .machine import on_gpu
from .measurement import Measurement
from .pairing import GAINED, pairs
from .scope import PAPERS_STEPS, SYNTHETIC
from .statistics import Measurements
from .target import Target, make_target

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
