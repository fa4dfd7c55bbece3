"""Optimize frames whose masks or true kinematics are known, and say how well it went."""

import time
from collections.abc import Iterator
from collections.abc import Sequence as Names
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from ..model.perturbation import perturb
from ..model.scene import SceneState
from ..networks.extractor import FeatureExtractor
from ..optimization import (
    Assessment,
    Backgrounds,
    FrameOptimizer,
    FreeParameters,
    GivenMasks,
    SolverSettings,
    SurfacePredictor,
    undetermined_joints,
)
from ..recording import Frame, Sequence
from ..rendering import Renderer
from .metrics import dice, joint_mae_deg, joint_std_deg


@dataclass(frozen=True)
class FrameScore:
    """One optimized frame; None where there is no truth."""

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
    """Why the optimization ended, or in sequence mode where the frame's values come from."""
    joint_std_deg: float | None = None
    """Mean standard deviation of measured revolute joints [deg]; None where it is not known."""
    verdict: str | None = None
    """good, doubtful or failed, of the mask and as far as the image tells; None where it is not assessed."""
    reason: str | None = None
    """Of the verdict, one sentence."""
    not_determined: list[str] | None = None
    """`ARM.JOINT` of the joints that the images leave open; None where no deviation is known."""
    base_frame_gain: float | None = None
    """What free base frames would explain of the remaining difference [1]; None where it is not known."""


def evaluate(
    sequence: Sequence,
    networks: FeatureExtractor | SurfacePredictor,
    *,
    frames: Names[int],
    cameras: Names[str],
    domains: Names[str],
    settings: SolverSettings,
    free: FreeParameters,
    perturb_deg: float = 0.0,
    seed: int = 0,
    together: bool = False,
    given: GivenMasks | None = None,
) -> Iterator[FrameScore]:
    """Optimize every frame in every domain and camera, each on its own, and yield its score.

    Args:
        sequence: with masks, true kinematics, both or neither.
        networks: the networks, or another predictor of surface maps.
        frames: positions in the sequence.
        cameras: names; each is optimized alone, unless `together`.
        domains: names.
        settings, free: of the optimization.
        perturb_deg: 0 starts at the measured joint positions. Otherwise the start is the true joint positions (the
            measured ones where there is no truth) with every measured joint moved by this much; see `perturb`.
        seed: of the perturbation; the same frame gets the same one in every camera and domain.
        together: one optimization for all cameras; a frame has a score for each, which share its time.
        given: masks from elsewhere that `networks` fits: their ignored pixels are not compared, and they are the truth
            of cameras that the sequence has no masks of.
    """
    for domain in domains:
        for group in camera_groups(cameras, together):
            scene = sequence.scene.with_cameras(group)
            renderers = {camera: Renderer(scene, cameras=[camera]) for camera in group}
            backgrounds = Backgrounds.of(sequence, group, domain, required=settings.needs_background)
            for index in frames:
                frame = sequence.frame(index, domain, list(group))
                frame = frame if given is None else given.filled(frame)
                start = start_positions(sequence, frame, perturb_deg, seed)
                began = time.perf_counter()
                optimizer = FrameOptimizer(
                    scene,
                    frame,
                    backgrounds,
                    networks,
                    ignore=None if given is None else given.ignored(index),
                    start=start,
                    settings=settings,
                    free=free,
                    live=False,
                )
                for _ in optimizer:
                    pass
                seconds = (time.perf_counter() - began) / len(group)
                for camera, renderer in renderers.items():
                    yield _optimized_score(sequence, frame, camera, renderer, start, optimizer, seconds)


def _optimized_score(
    sequence: Sequence,
    frame: Frame,
    camera: str,
    renderer: Renderer,
    start: dict[str, np.ndarray],
    optimizer: FrameOptimizer,
    seconds: float,
) -> FrameScore:
    """The score of a frame at the best iterate of an optimizer that has ended."""
    best = optimizer.best
    assert best is not None and optimizer.stop_reason is not None
    return frame_score(
        sequence,
        frame,
        camera,
        renderer,
        start,
        best.state,
        best.joint_positions(),
        best.joint_std(),
        len(optimizer.history) - 1,
        seconds,
        optimizer.stop_reason,
        optimizer.base_frame_gain(),
        optimizer.assessment,
    )


def camera_groups(cameras: Names[str], together: bool) -> list[tuple[str, ...]]:
    """Cameras that take part in one optimization: all of them, or each alone."""
    return [tuple(cameras)] if together else [(camera,) for camera in cameras]


def start_positions(
    sequence: Sequence, frame: Frame, perturb_deg: float, seed: int | tuple[int, ...]
) -> dict[str, np.ndarray]:
    """Where the optimization of a frame starts; see `evaluate`. A seed in a tuple gives all frames the same signs."""
    if perturb_deg == 0:
        return frame.measured
    origin = {**frame.measured, **(frame.truth or {})}
    seed = seed if isinstance(seed, tuple) else (seed, frame.index)
    return perturb(sequence.scene, origin, perturb_deg, seed, sequence.measured_joints)


def frame_score(
    sequence: Sequence,
    frame: Frame,
    camera: str,
    renderer: Renderer,
    start: dict[str, np.ndarray],
    state: SceneState,
    joint_positions: dict[str, np.ndarray],
    joint_std: dict[str, np.ndarray],
    iterations: int,
    seconds: float,
    stopped: str,
    base_frame_gain: float | None = None,
    assessment: Assessment | None = None,
) -> FrameScore:
    """Compare an estimate of a frame with the truth.

    Args:
        sequence, frame, camera: what was optimized.
        renderer: of that camera in full size.
        start: arm name -> joint positions before [rad, m].
        state, joint_positions, joint_std: after.
        iterations, seconds, stopped, base_frame_gain: as in the score.
        assessment: how far the estimate can be relied on, where it is assessed.
    """
    mask = (frame.masks or {}).get(camera)
    truth = frame.truth or {}

    def overlap(state: SceneState) -> float | None:
        return None if mask is None else dice(renderer.segment(state)[0] >= 0, mask)

    def mae(estimate: dict[str, np.ndarray]) -> float | None:
        return joint_mae_deg(sequence.scene, estimate, truth, sequence.measured_joints)

    return FrameScore(
        frame=frame.frame_id,
        camera=camera,
        domain=frame.domain,
        dice_before=overlap(sequence.scene.with_cameras([camera]).state(start, mounts=frame.mounts)),
        dice_after=overlap(state.to("cpu")),
        joint_mae_deg_before=mae(start),
        joint_mae_deg_after=mae(joint_positions),
        iterations=iterations,
        seconds=round(seconds, 4),
        stopped=stopped,
        joint_std_deg=joint_std_deg(sequence.scene, joint_std, sequence.measured_joints),
        base_frame_gain=base_frame_gain,
        verdict=None if assessment is None else assessment.verdict.value,
        not_determined=undetermined_joints(sequence.scene, joint_std),
        reason=None if assessment is None else assessment.reason,
    )


def mean_score(scores: Names[FrameScore]) -> dict[str, Any]:
    """Means over frames under the same keys; None where a value cannot be averaged or no frame has it."""
    result: dict[str, Any] = {}
    for field in fields(FrameScore):
        values = [value for score in scores if isinstance(value := getattr(score, field.name), (int, float))]
        result[field.name] = float(np.mean(values)) if values else None
    return result


def to_json(scores: Names[FrameScore]) -> dict[str, Any]:
    """What `carts evaluate --json` writes."""
    return {"frames": [asdict(score) for score in scores], "mean": mean_score(scores)}
