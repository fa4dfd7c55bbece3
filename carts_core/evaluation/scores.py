"""Evaluation of frames and sequences against ground truth."""

import time
from collections.abc import Iterator
from collections.abc import Sequence as Names
from dataclasses import asdict, dataclass, fields, replace
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Bool

from ..model.perturbation import perturb
from ..model.scene import SceneState
from ..networks.extractor import FeatureExtractor
from ..optimization import (
    Assessment,
    Backgrounds,
    FrameOptimizer,
    FreeParameters,
    GivenMasks,
    SequenceOptimizer,
    SequenceSettings,
    SolverSettings,
    SurfacePredictor,
    undetermined_joints,
)
from ..optimization.sequence_frame import Ignore
from ..recording import Frame, Sequence
from ..rendering import Renderer
from ..reprs import short_repr
from .metrics import dice, joint_mae_deg, joint_std_deg

Joints = dict[str, np.ndarray]
"""Arm name -> joint positions [rad, m]."""


@dataclass(frozen=True)
class FrameScore:
    """Scores of one optimized frame; fields are None without ground truth."""

    frame: str
    camera: str
    domain: str
    dice_before: float | None
    dice_after: float | None
    joint_mae_deg_before: float | None
    joint_mae_deg_after: float | None
    iterations: int
    seconds: float
    stopped: str
    """Termination reason, or the source of the frame's values in sequence mode."""
    joint_std_deg: float | None = None
    """Mean standard deviation of measured revolute joints [deg]; None if unknown."""
    verdict: str | None = None
    """Verdict on the mask: `good`, `doubtful` or `failed`; None if not assessed."""
    reason: str | None = None
    """Reason for the verdict, one sentence."""
    not_determined: list[str] | None = None
    """Undetermined joints as `ARM.JOINT`; None if no standard deviation is known."""
    base_frame_gain: float | None = None
    """Share of the residual that free base frames would explain [1]; None if unknown."""


@dataclass(frozen=True)
class Estimate:
    """Estimate of a frame by `FrameOptimizer` or `SequenceOptimizer`."""

    state: SceneState
    joint_positions: dict[str, np.ndarray]
    """Arm name -> joint positions [rad, m]."""
    joint_std: dict[str, np.ndarray]
    """Arm name -> standard deviations [rad, m]."""
    iterations: int
    seconds: float
    stopped: str
    """Termination reason, or the source of the frame's values in sequence mode."""
    base_frame_gain: float | None = None
    assessment: Assessment | None = None

    @staticmethod
    def best(optimizer: FrameOptimizer, seconds: float) -> "Estimate":
        """Best iterate of a finished optimizer."""
        best, stopped = optimizer.best, optimizer.stop_reason
        assert best is not None and stopped is not None
        steps, gain = len(optimizer.history) - 1, optimizer.base_frame_gain()
        positions, std = best.joint_positions(), best.joint_std()
        return Estimate(best.state, positions, std, steps, seconds, stopped, gain, optimizer.assessment)


def evaluate(
    sequence: Sequence,
    networks: FeatureExtractor | SurfacePredictor,
    *,
    frames: Names[int],
    cameras: Names[str],
    domains: Names[str],
    settings: SolverSettings,
    free: FreeParameters,
    model: SequenceSettings | None = None,
    perturb_deg: float = 0.0,
    seed: int = 0,
    together: bool = False,
    given: GivenMasks | None = None,
) -> Iterator[FrameScore]:
    """Optimize each frame in each domain and camera, and yield its score.

    Args:
        sequence: sequence with or without ground truth of masks and kinematics.
        networks: networks, or a predictor of surface maps.
        frames: indices in the sequence; frames without an image are left out.
        cameras: names of cameras, optimized separately unless `together`.
        domains: names of domains.
        settings, free: settings and free parameters of the optimization.
        model: settings of sequence mode (see `SequenceOptimizer`); by default, frames are optimized separately.
        perturb_deg: perturbation of each measured joint at the start, relative to the true joint positions (measured
            joint positions without ground truth); see `perturb`. 0 starts at the measured joint positions.
        seed: seed of the perturbation, which is the same for a frame in all cameras and domains. In sequence mode, it
            is the same for all frames, like a calibration error.
        together: optimize all cameras jointly; the time is divided equally among their scores.
        given: masks that are fitted, and the ground truth of cameras without masks in the sequence. Their ignored
            pixels are not compared.
    """

    for domain, group in product(domains, camera_groups(cameras, together)):
        ignore = (lambda _: {}) if given is None else given.ignored
        if not (seen := sequence.with_image(frames, group)):
            continue
        setup = Setup(sequence, domain, group, networks, settings, free, model, perturb_deg, seed, ignore)
        scene = sequence.scene.with_cameras(group)
        renderers = {camera: Renderer(scene, cameras=[camera]) for camera in group}
        for frame, estimate in _estimates(setup, seen):
            share = replace(estimate, seconds=estimate.seconds / len(group))
            scored = frame if given is None else given.filled(frame)
            for camera, renderer in renderers.items():
                yield frame_score(sequence, scored, camera, renderer, frame.measured, share)


def _estimates(setup: "Setup", frames: Names[int]) -> Iterator[tuple[Frame, Estimate]]:
    """Solve frames, and yield each frame, with its initial joint positions as `measured`, and its estimate."""
    if setup.model is None:
        _ = setup.backgrounds  # The computation of the background is not part of a frame's time.
        for index in frames:
            frame, began = setup.frame(index), time.perf_counter()
            yield frame, Estimate.best(setup.solved(frame), time.perf_counter() - began)
        return
    optimizer = setup.sequence_optimizer(frames)
    for _ in optimizer:
        pass
    for index, found in sorted(optimizer.estimates.items()):
        joints, spent = (found.joint_positions, found.joint_std), (found.iterations, found.seconds)
        yield setup.frame(index), Estimate(found.state, *joints, *spent, found.start, assessment=found.assessment)


def frame_score(
    sequence: Sequence, frame: Frame, camera: str, renderer: Renderer, start: Joints, found: Estimate
) -> FrameScore:
    """Score an estimate of a frame against ground truth.

    Args:
        sequence, frame, camera: optimized sequence, frame and camera.
        renderer: renderer of that camera at full resolution.
        start: arm name -> initial joint positions [rad, m].
        found: estimate to score.
    """
    mask, assessment = (frame.masks or {}).get(camera), found.assessment

    def overlap(state: SceneState) -> float | None:
        if mask is None:
            return None
        return dice(renderer.segment(state)[0] >= 0, mask, frame.unlabelled.get(camera))

    def mae(estimate: Joints) -> float | None:
        return joint_mae_deg(sequence.scene, estimate, frame.truth or {}, sequence.measured_joints)

    return FrameScore(
        frame=frame.frame_id,
        camera=camera,
        domain=frame.domain,
        dice_before=overlap(sequence.scene.with_cameras([camera]).state(start, mounts=frame.mounts)),
        dice_after=overlap(found.state.to("cpu")),
        joint_mae_deg_before=mae(start),
        joint_mae_deg_after=mae(found.joint_positions),
        iterations=found.iterations,
        seconds=round(found.seconds, 4),
        stopped=found.stopped,
        joint_std_deg=joint_std_deg(sequence.scene, found.joint_std, sequence.measured_joints),
        verdict=assessment and assessment.verdict.value,
        reason=assessment and assessment.reason,
        not_determined=undetermined_joints(sequence.scene, found.joint_std),
        base_frame_gain=found.base_frame_gain,
    )


def camera_groups(cameras: Names[str], together: bool) -> list[tuple[str, ...]]:
    """Groups of jointly optimized cameras: one group of all cameras, or one group per camera."""
    return [tuple(cameras)] if together else [(camera,) for camera in cameras]


def start_positions(
    sequence: Sequence, frame: Frame, perturb_deg: float, seed: int | tuple[int, ...]
) -> dict[str, np.ndarray]:
    """Initial joint positions of a frame [rad, m]; see `evaluate`. With a tuple as seed, the signs are equal in all
    frames."""
    if perturb_deg == 0:
        return frame.measured
    origin = {**frame.measured, **(frame.truth or {})}
    seed = seed if isinstance(seed, tuple) else (seed, frame.index)
    return perturb(sequence.scene, origin, perturb_deg, seed, sequence.measured_joints)


def mean_score(scores: Names[FrameScore]) -> dict[str, Any]:
    """Means over frames, under the names of the fields; None for missing or non-numeric values."""
    result: dict[str, Any] = {}
    for field in fields(FrameScore):
        values = [value for score in scores if isinstance(value := getattr(score, field.name), (int, float))]
        result[field.name] = float(np.mean(values)) if values else None
    return result


def to_json(scores: Names[FrameScore]) -> dict[str, Any]:
    """Content of `carts evaluate --json`."""
    return {"frames": [asdict(score) for score in scores], "mean": mean_score(scores)}


@dataclass(frozen=True)
class Setup:
    """Solver and its settings, with the recording, domain and cameras of the frames.

    Initial joint positions are the `measured` positions of the frames; see `evaluate` for other arguments.
    """

    sequence: Sequence
    domain: str
    cameras: tuple[str, ...]
    """Names of the cameras, which are optimized jointly."""
    networks: FeatureExtractor | SurfacePredictor
    settings: SolverSettings
    free: FreeParameters
    model: SequenceSettings | None = None
    perturb_deg: float = 0.0
    seed: int = 0
    ignore: Ignore = lambda _: {}
    """Frame index -> camera name -> pixels excluded from comparison."""

    __repr__ = short_repr

    def frame(self, index: int, cameras: Names[str] | None = None) -> Frame:
        """Frame at an index of the sequence, with images of the given cameras (all by default)."""
        frame = self.sequence.frame(index, self.domain, self.cameras if cameras is None else cameras)
        seed = self.seed if self.model is None else (self.seed,)
        return replace(frame, measured=start_positions(self.sequence, frame, self.perturb_deg, seed))

    @property
    def backgrounds(self) -> Backgrounds:
        """Mean backgrounds of the cameras; `SequenceError` if a required background cannot be estimated."""
        return Backgrounds.of(self.sequence, self.cameras, self.domain, required=self.settings.needs_background)

    def solved(self, frame: Frame) -> FrameOptimizer:
        """Single-frame optimizer of a frame, run to completion."""
        optimizer = FrameOptimizer(
            self.sequence.scene,
            frame,
            self.backgrounds,
            self.networks,
            ignore=self.ignore(frame.index),
            settings=self.settings,
            free=self.free,
            cameras=self.cameras,
            live=False,
        )
        for _ in optimizer:
            pass
        return optimizer

    def arm_masks(self, index: int) -> dict[str, Bool[np.ndarray, "h w"]]:
        """Arm name -> mask of its visible pixels in the first camera, after optimization of a frame."""
        best = self.solved(self.frame(index)).best
        assert best is not None
        renderer = Renderer(self.sequence.scene.with_cameras(self.cameras), cameras=self.cameras[:1])
        arms = renderer.segment(best.state.to("cpu"))[0]
        return {arm.name: arms == number for number, arm in enumerate(self.sequence.scene.arms)}

    def sequence_optimizer(self, frames: Names[int], **more: Any) -> SequenceOptimizer:
        """Joint optimizer of the given frames; `more` are further arguments of `SequenceOptimizer`."""
        stamps = self.sequence.timestamps
        return SequenceOptimizer(
            self.sequence.scene,
            self.frame,
            {index: None if stamps is None else float(stamps[index]) for index in frames},
            self.networks,
            settings=self.settings,
            model=self.model,
            free=self.free,
            ignore=self.ignore,
            backgrounds=self.backgrounds,
            cameras=self.cameras,
            **more,
        )
