"""The surface objective over many frames that share one calibration.

Every frame contributes its own residuals. The prior on the calibration counts once. Joint offsets, where they are free,
belong to one frame each, have a tight prior, and are eliminated by the Schur complement, so that a solver sees the
calibration alone.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..data import Frame
from ..features.extractor import FeatureExtractor
from ..scene import Scene, SceneState
from ..settings import FreeParameters, OptimizerSettings
from .elimination import Eliminated, eliminate
from .evaluation import Evaluation
from .parameters import ParameterVector
from .surface_objective import SurfaceObjective

Ignored = Sequence[Mapping[str, Bool[np.ndarray, "h w"]]]
"""Per frame: camera name -> pixels that show an occluder."""

_GOOD = 1.5
"""A frame whose loss is at most this many times the median counts in full, and less beyond it [1]."""


@dataclass(frozen=True)
class CalibrationEvaluation(Evaluation):
    """All frames at one calibration; the maps are those of the first frame."""

    frame_losses: Float[Tensor, " frames"]
    frame_weights: Float[Tensor, " frames"]
    """How far each frame counts, in [0, 1]."""
    frame_gradients: Float[Tensor, "frames n"] | None
    """Each frame's part of the gradient, without the prior."""


class _FrameUnknowns(ParameterVector):
    """Joint offsets of one frame, then the calibration, whose prior is somebody else's."""

    def __init__(
        self, scene: Scene, start: SceneState, free: FreeParameters, lever: float, shared: int, joint_prior_deg: float
    ) -> None:
        super().__init__(scene, start, free, lever)
        self.own = len(self) - shared
        self._joint_prior_deg = joint_prior_deg

    def prior_precision(
        self, joints_deg: float, frames_deg: float = 0.5, intrinsics: float = 0.01
    ) -> Float[Tensor, " n"]:
        """That of the joints; 0 for the calibration."""
        precision = torch.zeros_like(self.lower)
        precision[: self.own] = math.radians(self._joint_prior_deg) ** -2
        return precision


class _Observation:
    """One frame, and where its own unknowns are."""

    def __init__(self, parameters: _FrameUnknowns, objective: SurfaceObjective) -> None:
        self.parameters, self.objective = parameters, objective
        self.own = torch.zeros(parameters.own, device=parameters.lower.device)
        self._anchor: tuple[Tensor, Tensor, Eliminated] | None = None

    def follow(self, shared: Float[Tensor, " n"]) -> None:
        """Move the own unknowns to where the anchor's model has them for a calibration."""
        if self._anchor is not None and len(self.own):
            at, own, model = self._anchor
            moved = own + model.own_step(shared - at).to(own)
            self.own = self.parameters.clamp(torch.cat([moved, shared]))[: len(own)]

    def anchor(self, shared: Float[Tensor, " n"], model: Eliminated) -> None:
        """Remember a model, made at the present own unknowns."""
        self._anchor = (shared, self.own, model)

    def __call__(self, shared: Float[Tensor, " n"], stage: int, *, gradient: bool, own: Tensor) -> Evaluation:
        return self.objective(torch.cat([own, shared]), stage, gradient=gradient)


class CalibrationObjective:
    """Sum of the frames' surface objectives as a function of the calibration alone.

    Args:
        scene: with the cameras that take part.
        frames: observed images and measured joint positions.
        extractor: the networks.
        free: what is unknown; joints are so in every frame for itself.
        settings: blurs, noise, and the prior on the calibration.
        joint_prior_deg: expected error of free joints [deg]; `settings.lever` turns it into metres.
        ignore: per frame, pixels that show an occluder.

    Raises:
        SettingsError: an image is missing or of another size than its camera, or nothing of the calibration is free.
    """

    def __init__(
        self,
        scene: Scene,
        frames: Sequence[Frame],
        extractor: FeatureExtractor,
        free: FreeParameters,
        settings: OptimizerSettings,
        joint_prior_deg: float,
        ignore: Ignored | None = None,
    ) -> None:
        calibration = replace(free, joints=False)
        starts = [scene.state(frame.measured, extractor.device) for frame in frames]
        self.parameters = ParameterVector(scene, starts[0], calibration, settings.lever)
        self._observations: list[_Observation] = []
        for index, (frame, start) in enumerate(zip(frames, starts, strict=True)):
            unknowns = _FrameUnknowns(scene, start, free, settings.lever, len(self.parameters), joint_prior_deg)
            ignored = ignore[index] if ignore else None
            objective = SurfaceObjective(scene, frame.images, extractor, unknowns, settings, ignored, live=False)
            self._observations.append(_Observation(unknowns, objective))
        self.stages = self._observations[0].objective.stages
        self._prior = self.parameters.prior_precision(
            settings.prior_deg, settings.frame_prior_deg, settings.intrinsics_prior
        )
        self._weights = torch.ones(len(frames), dtype=torch.float64)
        self._losses = torch.zeros(len(frames), dtype=torch.float64)
        self._stage, self._lowest = -1, math.inf

    def epoch(self, stage: int) -> int:
        """Losses compare within an epoch only."""
        return self._observations[0].objective.epoch(stage)

    def __call__(self, offsets: Float[Tensor, " n"], stage: int, *, gradient: bool) -> CalibrationEvaluation:
        """Evaluate at a calibration; free joints follow it."""
        if stage != self._stage:
            look = self._observations[0].objective.look
            if self._stage >= 0 and look(stage) != look(self._stage):
                self._weights = trust_of_frames(self._losses)
            self._stage, self._lowest = stage, math.inf
        for observation in self._observations:
            observation.follow(offsets)
        evaluations = self._evaluate(offsets, stage, gradient)
        models = [
            eliminate(evaluation.gradient, evaluation.curvature, observation.parameters.own)
            for evaluation, observation in zip(evaluations, self._observations, strict=True)
            if evaluation.curvature is not None
        ]
        combined = self._combined(offsets, evaluations, models)
        self._losses = combined.frame_losses
        # What is lowest so far is where the solver steps from, so there the frames' own unknowns step from too.
        if models and combined.value < self._lowest:
            self._lowest = combined.value
            for observation, model in zip(self._observations, models, strict=True):
                observation.anchor(offsets, model)
        return combined

    def frame_losses(self, offsets: Float[Tensor, " n"]) -> Float[np.ndarray, " frames"]:
        """Loss of every frame at a calibration with joints as measured, as of the present stage."""
        at_measured = [torch.zeros_like(observation.own) for observation in self._observations]
        evaluations = self._evaluate(offsets, max(self._stage, 0), False, at_measured)
        return np.array([evaluation.loss for evaluation in evaluations])

    def _evaluate(
        self, offsets: Tensor, stage: int, gradient: bool, own: list[Tensor] | None = None
    ) -> list[Evaluation]:
        parts = own or [observation.own for observation in self._observations]
        return [
            observation(offsets, stage, gradient=gradient, own=part)
            for observation, part in zip(self._observations, parts, strict=True)
        ]

    def _combined(
        self, offsets: Tensor, evaluations: list[Evaluation], models: list[Eliminated]
    ) -> CalibrationEvaluation:
        weights = self._weights
        prior = 0.5 * float((self._prior * offsets.square()).sum())
        values = torch.tensor([evaluation.value for evaluation in evaluations], dtype=torch.float64)
        losses = torch.tensor([evaluation.loss for evaluation in evaluations], dtype=torch.float64)
        slope, curvature, gradients = torch.zeros_like(offsets), None, None
        if models:
            gradients = weights[:, None] * torch.stack([model.gradient for model in models])
            total = torch.einsum("f,fij->ij", weights, torch.stack([model.curvature for model in models]))
            slope = self._prior * offsets + gradients.sum(0).to(offsets)
            curvature = torch.diag(self._prior).double() + total.to(offsets.device)
        maps = vars(evaluations[0])
        return CalibrationEvaluation(
            **maps
            | {
                "value": float(weights @ values) + prior,
                "loss": float(weights @ losses / weights.sum()),
                "prior": prior,
                "gradient": slope,
                "curvature": curvature,
                "frame_losses": losses,
                "frame_weights": weights,
                "frame_gradients": gradients,
            }
        )


def trust_of_frames(losses: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """How far each frame is believed, in [0, 1]: in full up to a multiple of the median loss, and beyond it less, so
    that a wrong frame (bad kinematics, smoke) does not decide what all share."""
    shown = losses[losses > 0]
    if not len(shown):
        return torch.ones_like(losses)
    return (_GOOD * shown.median() / losses.clamp(min=1e-12)).clamp(max=1.0).square()
