"""Throughput and latency of live tracking on the shipped sequence, replayed in real time.

    python -m tools.bench_live [--rate 60] [--arms 2] [--domain regular] [--seconds 20]

A long run also measures drift: memory and latency of its first and its last tenth.
"""

import argparse
import json
import os
from collections import Counter, deque
from dataclasses import replace

import numpy as np

from carts_core.evaluation import dice
from carts_core.live import LiveStatistics, LiveTracker, LiveVerdict, Replay, follow
from carts_core.model.scene import SceneState
from carts_core.networks import FeatureExtractor
from carts_core.optimization import Backgrounds
from carts_core.process import tune_process
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence
from tools.memory import resident_megabytes

_WARM_UP = 20
"""Number of initial results without times, during the compilation of kernels and the search for the arms."""
_SCORED = 500
"""Number of last good results whose masks are compared."""


def measured(rate: float, arms: int, domain: str, seconds: float) -> dict[str, object]:
    """Track a replay for some time; returns the measurements, times in milliseconds."""
    sequence = Sequence.open(sample_sequence())
    camera = sequence.scene.cameras[0].name
    scene = replace(sequence.scene, arms=sequence.scene.arms[:arms])
    extractor = FeatureExtractor.load(inference="auto")
    backgrounds = Backgrounds.of(sequence, (camera,), domain)
    tracker = LiveTracker(scene, extractor, backgrounds=backgrounds, cameras=(camera,), concurrent=True)
    renderer, memory, scores = Renderer(scene, cameras=[camera]), [], []
    recent: deque[tuple[str, SceneState]] = deque(maxlen=_SCORED)
    ages: list[float] = []
    ends: list[float] = []
    verdicts: list[LiveVerdict] = []

    def take(tracked) -> None:
        ends.append(tracked.estimate.time + tracked.age)
        ages.append(1e3 * tracked.age)
        if len(ages) % 100 == 0:
            memory.append(resident_megabytes())
        if tracked.estimate.verdict is LiveVerdict.GOOD:
            recent.append((tracked.estimate.frame_id, tracked.estimate.state))
        verdicts.append(tracked.estimate.verdict)

    statistics = LiveStatistics()
    loops = round(seconds * rate / len(sequence))
    try:
        follow(Replay(sequence, (camera,), domain, rate=rate, loops=loops), tracker, [take], statistics)
    finally:
        tracker.close()
    for frame_id, state in recent:
        index = sequence.frame_ids.index(frame_id)
        masks = sequence.frame(index, domain, (camera,)).masks
        assert masks is not None
        if arms == len(sequence.scene.arms):
            scores.append(dice(renderer.segment(state)[0] >= 0, masks[camera]))
    first = verdicts.index(LiveVerdict.GOOD) if LiveVerdict.GOOD in verdicts else len(verdicts)
    found_after = ends[min(first, len(ends) - 1)] - (ends[0] - ages[0] / 1e3)
    del ages[:_WARM_UP], ends[:_WARM_UP]
    tenth = max(len(ages) // 10, 1)
    return {
        "arrived": statistics.arrived,
        "results_per_second": round((len(ends) - 1) / (ends[-1] - ends[0]), 2),
        "age_median": round(float(np.median(ages)), 1),
        "age_p95": round(float(np.percentile(ages, 95)), 1),
        "age_max": round(max(ages), 1),
        "age_median_first_last_tenth": [round(float(np.median(part)), 1) for part in (ages[:tenth], ages[-tenth:])],
        "memory_mb_first_last": [round(value, 1) for value in (memory[len(memory) // 10], memory[-1])]
        if memory
        else [],
        "first_good_after_s": round(found_after, 2),
        "verdicts_before_and_after": [
            {str(verdict): count for verdict, count in Counter(part).items()}
            for part in (verdicts[:first], verdicts[first:])
        ],
        "dice": round(float(np.mean(scores)), 4) if scores else None,
    }


def main() -> None:
    """Print the measurements as a line of JSON, with the load of the machine."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=float, default=60.0)
    parser.add_argument("--arms", type=int, default=2)
    parser.add_argument("--domain", default="regular")
    parser.add_argument("--seconds", type=float, default=20.0)
    arguments = parser.parse_args()
    tune_process()
    load = os.getloadavg()[0]
    found = measured(arguments.rate, arguments.arms, arguments.domain, arguments.seconds)
    print(json.dumps({**vars(arguments), **found, "load": [round(load, 1), round(os.getloadavg()[0], 1)]}))


if __name__ == "__main__":
    main()
