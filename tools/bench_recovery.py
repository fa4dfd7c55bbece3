"""Recovery of live tracking after an occlusion, and its noise on a still scene, in simulated time.

    python -m tools.bench_recovery [--runs 40] [--first 0] [--rate 30] [--arms 2] [--seconds 10] [--wall]

The clock is the processor time of the tracker, so other programs on the machine hardly change the result; a frame that
arrives while the tracker computes is dropped, and recovery runs between frames instead of beside them. With `--wall`,
time is real, and recovery runs on a separate thread.
"""

import argparse
import json
import time
from dataclasses import replace
from typing import get_args

import cv2
import numpy as np
import torch

from carts_core.live import LiveEstimate, LiveTracker, LiveVerdict
from carts_core.model.perturbation import perturb
from carts_core.networks import FeatureExtractor
from carts_core.optimization import Backgrounds
from carts_core.process import tune_process
from carts_core.recording import Frame, Sequence
from carts_core.resources import sample_sequence
from carts_core.settings.live import LiveSettings
from carts_core.settings.optimization import Inference

_BEFORE, _HIDDEN, _AFTER = 1.0, 2.0, 3.0
"""Seconds before, during and after an occlusion."""
_CLOSE = 0.025
"""Maximum error of the compared joints [rad, dm]."""
_NOISE = 4.0
"""Standard deviation of camera noise [grey levels of 255]."""
_SEEN = 3
"""Number of first joints that are compared: yaw, pitch and insertion. Roll and jaws of a thin instrument are hardly
visible."""


class _Clock:
    """A tracker with simulated time, or real time with `wall` [s]."""

    def __init__(self, arms: int, rate: float, wall: bool, inference: Inference) -> None:
        self.sequence = Sequence.open(sample_sequence())
        (self.camera,) = self.sequence.scene.cameras
        self.scene = replace(self.sequence.scene, arms=self.sequence.scene.arms[:arms])
        self.extractor, self.rate, self.now = FeatureExtractor.load(inference=inference), rate, 0.0
        self.wall, self.tracker = wall, None
        self.frames = [self.sequence.frame(index, None, [self.camera.name]) for index in range(len(self.sequence))]
        self.known = Backgrounds.of(self.sequence, (self.camera.name,), self.frames[0].domain)

    def start(self) -> None:
        """A new tracker at time 0."""
        if self.tracker is not None:
            self.tracker.close()
        names = (self.camera.name,)
        self.tracker = LiveTracker(
            self.scene, self.extractor, backgrounds=self.known, cameras=names, concurrent=self.wall
        )
        self.now, self.zero = 0.0, time.monotonic()

    def frame(self, index: int, degrees: float, seed: int) -> Frame:
        """A frame whose measured joints have an error that is constant in time."""
        frame = self.frames[index % len(self.frames)]
        truth = frame.truth
        assert truth is not None
        measured = perturb(self.sequence.scene, truth, degrees, (seed,), self.sequence.measured_joints)
        return replace(frame, measured={arm.name: measured[arm.name] for arm in self.scene.arms})

    @property
    def next(self) -> float:
        """Time of the frame that arrives next [s]."""
        return float(np.ceil(self.now * self.rate - 1e-9) / self.rate)

    def track(self, frame: Frame) -> LiveEstimate:
        """Track the frame that arrives next; returns its estimate when it is done."""
        assert self.tracker is not None
        arrived, began = self.next, time.process_time()
        if self.wall:
            time.sleep(max(self.zero + arrived - time.monotonic(), 0.0))
        estimate = self.tracker.track(replace(frame, timestamp=arrived))
        self.now = time.monotonic() - self.zero if self.wall else arrived + time.process_time() - began
        return estimate

    def error(self, estimate: LiveEstimate, frame: Frame) -> float:
        """Largest error of the compared joints [rad, dm]."""
        assert frame.truth is not None
        found, truth = estimate.joint_positions, frame.truth
        scale = [1.0, 1.0, 10.0]
        return max(float((np.abs(found[arm.name] - truth[arm.name])[:_SEEN] * scale).max()) for arm in self.scene.arms)


def occluder(shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Image of something close to the camera, without outlines."""
    draw = np.random.default_rng(seed)
    coarse = draw.normal((110, 60, 50), 25.0, (6, 8, 3)).clip(0, 255).astype(np.uint8)
    return cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)


def recovered(clock: _Clock, seed: int) -> tuple[float, bool]:
    """Time from the end of an occlusion to a good estimate [s], and whether all hidden frames after
    `lost_seconds` were lost. The time includes that of the last hidden frame, if it ends after the occlusion."""
    clock.start()
    index = 5 * seed
    while clock.now < _BEFORE:
        clock.track(clock.frame(index, 2.0, seed))
        index += 1
    began, honest = clock.next, True
    shown = began + _HIDDEN
    image = occluder(clock.frames[0].images[clock.camera.name].shape, seed)
    while clock.next < shown - 1e-9:
        frame = clock.frame(index, 2.0, seed)
        estimate = clock.track(replace(frame, images={clock.camera.name: image}))
        if estimate.time > began + LiveSettings().lost_seconds + 1.0 / clock.rate:
            honest &= estimate.verdict is LiveVerdict.LOST
        index += 1
    while clock.now < shown + _AFTER:
        frame = clock.frame(index, 5.0, 1000 + seed)
        estimate = clock.track(frame)
        if estimate.verdict is LiveVerdict.GOOD and clock.error(estimate, frame) < _CLOSE:
            return float(clock.now - shown), honest
        index += 1
    return float("inf"), honest


def noise_of_still(clock: _Clock, seconds: float, index: int) -> tuple[float, float]:
    """Standard deviations of the estimated joints over time, for one frame under camera noise, relative to the stated
    ones [1]: the root mean square and the largest over the joints, after the first second."""
    clock.start()
    draw, frame, values, stated = np.random.default_rng(index), clock.frame(index, 1.0, index), [], []
    image = frame.images[clock.camera.name].astype(np.float32)
    while clock.now < 1.0 + seconds:
        noisy = (image + draw.normal(0.0, _NOISE, image.shape)).round().clip(0, 255).astype(np.uint8)
        estimate = clock.track(replace(frame, images={clock.camera.name: noisy}))
        if clock.now > 1.0:
            values.append(np.concatenate([estimate.joint_positions[arm.name] for arm in clock.scene.arms]))
            stated.append(np.concatenate([estimate.joint_std[arm.name] for arm in clock.scene.arms]))
    ratios = np.std(values, axis=0) / np.sqrt(np.mean(np.square(stated), axis=0))
    return float(np.sqrt(np.nanmean(ratios**2))), float(np.nanmax(ratios))


def main() -> None:
    """Print a line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="seed of the first run; tune on others than you report")
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--arms", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--wall", action="store_true")
    parser.add_argument("--inference", choices=get_args(Inference), default="auto")
    arguments = parser.parse_args()
    tune_process()
    torch.set_num_threads(1)
    clock = _Clock(arguments.arms, arguments.rate, arguments.wall, arguments.inference)
    ratios = [noise_of_still(clock, arguments.seconds, index) for index in (0, 20, 40)] if arguments.seconds else []
    found = [recovered(clock, seed) for seed in range(arguments.first, arguments.first + arguments.runs)]
    seconds = sorted(one for one, _ in found)
    print(
        json.dumps(
            {
                "recovery_seconds": [round(one, 2) for one in seconds],
                "within_1_s": sum(one <= 1.0 for one in seconds),
                "joint_rms_over_stated_deviation": [[round(one, 2) for one in pair] for pair in ratios],
                "lost_while_hidden": sum(honest for _, honest in found),
            }
        )
    )


if __name__ == "__main__":
    main()
