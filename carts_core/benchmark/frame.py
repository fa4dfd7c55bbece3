"""One run: a method on one frame, every iterate scored."""

import time
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, UInt8

from ..data import Frame
from ..evaluation import dice, joint_mae_deg, normalized_surface_distance
from ..features.extractor import FeatureExtractor
from ..optimization import FrameOptimizer, Iterate, OptimizerSettings
from ..perturbation import perturb
from ..rendering import Renderer
from ..scene import Scene
from .machine import machine
from .measurement import Measurement, Score
from .plan import Run

TOLERANCE = 2.0
"""Of the normalized surface distance [px]."""
_SEED = 0
"""Of the signs of errors made on purpose."""


@dataclass(frozen=True)
class Truth:
    """What the estimates of one frame are compared with."""

    mask: Bool[np.ndarray, "h w"]
    joint_positions: Mapping[str, np.ndarray]
    """Arm -> true joint positions [rad, m]; empty where they are not known."""
    measured_joints: Mapping[str, tuple[str, ...]]
    """Arm -> joints that count."""

    def score_mask(self, mask: Bool[np.ndarray, "h w"], seconds: float) -> Score:
        """The score of a mask without kinematics."""
        nsd = normalized_surface_distance(mask, self.mask, TOLERANCE)
        return Score(None, dice(mask, self.mask), nsd, None, None, seconds)

    def score(self, iterate: Iterate, renderer: Renderer, seconds: float) -> Score:
        """The score of an iterate."""
        mask = renderer.segment(iterate.state.to("cpu"))[0] >= 0
        estimate, visible = iterate.joint_positions(), visible_joints(iterate, self.measured_joints)
        return Score(
            loss=iterate.loss,
            dice=dice(mask, self.mask),
            nsd=normalized_surface_distance(mask, self.mask, TOLERANCE),
            joint_mae_deg=joint_mae_deg(renderer.scene, estimate, self.joint_positions, self.measured_joints),
            visible_joint_mae_deg=None
            if visible is None
            else joint_mae_deg(renderer.scene, estimate, self.joint_positions, visible),
            seconds=seconds,
        )


def visible_joints(
    iterate: Iterate, measured_joints: Mapping[str, tuple[str, ...]]
) -> Mapping[str, tuple[str, ...]] | None:
    """Arm -> measured joints that the image determines; None for losses that do not say which.

    This is the one place that reads it: what is returned here appears as "visible joints" in the whole report.
    """
    known = iterate.uncertainty
    if known is None:
        return None
    return {
        arm: tuple(
            joint
            for joint in joints
            if f"{arm}/{joint}" in known.names and known.verdict(f"{arm}/{joint}") == "determined"
        )
        for arm, joints in measured_joints.items()
    }


def start_of(
    scene: Scene, frame: Frame, error_deg: float | None, joints: Mapping[str, tuple[str, ...]]
) -> dict[str, np.ndarray]:
    """Joint positions that a run starts from; see `Run.error_deg`. All methods and domains get the same error."""
    if error_deg is None:
        return frame.measured
    origin = {**frame.measured, **(frame.truth or {})}
    return perturb(scene, origin, error_deg, (_SEED, frame.index), joints)


def optimize(
    run: Run,
    scene: Scene,
    frame: Frame,
    background: dict[str, UInt8[np.ndarray, "h w 3"]],
    extractor: FeatureExtractor,
    settings: OptimizerSettings,
    truth: Truth,
    renderer: Renderer,
) -> Measurement:
    """Run the optimizer on one frame in one camera, and score every iterate.

    Args:
        run: which.
        scene: with the one camera.
        frame: its image and kinematics.
        background: camera name -> mean background.
        extractor: the feature network.
        settings: of the method.
        truth: what estimates are compared with.
        renderer: draws the masks, at the camera's size.
    """
    start = start_of(scene, frame, run.error_deg, truth.measured_joints)
    began = time.perf_counter()
    optimizer = FrameOptimizer(scene, frame, background, extractor, start=start, settings=settings)
    seconds = time.perf_counter() - began
    trace: list[Score] = []
    best: list[int] = []
    while True:
        began = time.perf_counter()
        iterate = optimizer.step()
        seconds += time.perf_counter() - began
        if iterate is None:
            break
        best.append(len(trace) if optimizer.best is iterate else best[-1])
        trace.append(truth.score(iterate, renderer, seconds))
    assert optimizer.best is not None and optimizer.stop_reason is not None
    final = truth.score(optimizer.best, renderer, seconds)
    return Measurement(run, final, tuple(trace), tuple(best), optimizer.stop_reason, machine())


def segment(run: Run, image: UInt8[np.ndarray, "h w 3"], extractor: FeatureExtractor, truth: Truth) -> Measurement:
    """The network's own mask of one image, at the size that it was trained for."""
    began = time.perf_counter()
    small = cv2.resize(image, extractor.working_size, interpolation=cv2.INTER_AREA)
    tensor = torch.from_numpy(small).to(extractor.device).permute(2, 0, 1)[None].float() / 255.0
    with torch.no_grad():
        probability = extractor.probability(tensor)[0, 0].cpu().numpy()
    height, width = image.shape[:2]
    mask = cv2.resize(probability, (width, height), interpolation=cv2.INTER_LINEAR) >= 0.5
    seconds = time.perf_counter() - began
    return Measurement(run, truth.score_mask(mask, seconds), (), (), "not iterative", machine())
