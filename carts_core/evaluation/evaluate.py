"""Optimize frames whose masks or true kinematics are known, and say how well it went."""

import time
from collections.abc import Iterator
from collections.abc import Sequence as Names
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from ..data import Frame, Sequence
from ..features.extractor import FeatureExtractor
from ..optimization import FrameOptimizer, FreeParameters, OptimizerSettings
from ..perturbation import perturb
from ..rendering import Renderer
from .metrics import dice, joint_mae_deg


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


def evaluate(
    sequence: Sequence,
    extractor: FeatureExtractor,
    *,
    frames: Names[int],
    cameras: Names[str],
    domains: Names[str],
    settings: OptimizerSettings,
    free: FreeParameters,
    perturb_deg: float = 0.0,
    seed: int = 0,
) -> Iterator[FrameScore]:
    """Optimize every frame in every camera and domain, each on its own, and yield its score.

    Args:
        sequence: with masks, true kinematics, both or neither.
        extractor: the feature network.
        frames: positions in the sequence.
        cameras: names; every one sees the frame alone.
        domains: names.
        settings, free: of the optimization.
        perturb_deg: 0 starts at the measured joint positions. Otherwise the start is the true joint positions (the
            measured ones where there is no truth) with every measured joint moved by this much; see `perturb`.
        seed: of the perturbation; the same frame gets the same one in every camera and domain.
    """
    for domain in domains:
        for camera in cameras:
            renderer = Renderer(sequence.scene, cameras=[camera])
            background = {camera: sequence.background(camera, domain)}
            for index in frames:
                frame = sequence.frame(index, domain, [camera])
                start = start_positions(sequence, frame, perturb_deg, seed)
                began = time.perf_counter()
                optimizer = FrameOptimizer(
                    sequence.scene,
                    frame,
                    background,
                    extractor,
                    start=start,
                    settings=settings,
                    free=free,
                    cameras=[camera],
                )
                for _ in optimizer:
                    pass
                seconds = time.perf_counter() - began
                yield _score(sequence, frame, camera, renderer, start, optimizer, seconds)


def start_positions(sequence: Sequence, frame: Frame, perturb_deg: float, seed: int) -> dict[str, np.ndarray]:
    """Where the optimization of a frame starts; see `evaluate`."""
    if perturb_deg == 0:
        return frame.measured
    origin = {**frame.measured, **(frame.truth or {})}
    return perturb(sequence.scene, origin, perturb_deg, (seed, frame.index), sequence.measured_joints)


def _score(
    sequence: Sequence,
    frame: Frame,
    camera: str,
    renderer: Renderer,
    start: dict[str, np.ndarray],
    optimizer: FrameOptimizer,
    seconds: float,
) -> FrameScore:
    assert optimizer.best is not None and optimizer.stop_reason is not None
    mask = (frame.masks or {}).get(camera)
    truth = frame.truth or {}

    def overlap(state) -> float | None:
        return None if mask is None else dice(renderer.segment(state)[0] >= 0, mask)

    def mae(estimate: dict[str, np.ndarray]) -> float | None:
        return joint_mae_deg(sequence.scene, estimate, truth, sequence.measured_joints)

    return FrameScore(
        frame=frame.frame_id,
        camera=camera,
        domain=frame.domain,
        dice_before=overlap(sequence.scene.with_cameras([camera]).state(start)),
        dice_after=overlap(optimizer.best.state.to("cpu")),
        joint_mae_deg_before=mae(start),
        joint_mae_deg_after=mae(optimizer.best.joint_positions()),
        iterations=len(optimizer.history) - 1,
        seconds=round(seconds, 4),
        stopped=optimizer.stop_reason,
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
