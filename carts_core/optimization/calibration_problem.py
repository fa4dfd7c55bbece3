"""Optimization problem of many frames in their shared calibration."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..model.scene import Scene
from ..recording import Frame
from ..recording.background import evenly_spaced
from ..settings import FreeParameters, SurfaceSolver
from ..settings.stages import Descend, Observe, SilhouetteSearch
from .factors import Prior
from .frame_problem import FrameProblem, search_silhouettes
from .image_factors import SurfaceFactor
from .observability import Evaluation
from .observation import Backgrounds
from .predictor import SurfacePredictor
from .variables import Variables
from .verdict import Evidence


@dataclass(frozen=True)
class Eliminated:
    """Quadratic model of the shared unknowns after elimination of a frame's own unknowns (Schur complement), in double
    precision on the CPU.
    """

    gradient: Float[Tensor, " shared"]
    curvature: Float[Tensor, "shared shared"]
    """Schur complement of the block of own unknowns."""
    _step: Float[Tensor, " own"]
    _gain: Float[Tensor, "own shared"]

    def own_step(self, shared_step: Float[Tensor, " shared"]) -> Float[Tensor, " own"]:
        """Step of the own unknowns for a step of the shared ones."""
        return -(self._step + self._gain @ shared_step.double().cpu())


def eliminate(gradient: Float[Tensor, " n"], curvature: Float[Tensor, "n n"], own: int) -> Eliminated:
    """Eliminate the first `own` unknowns of a quadratic model.

    Args:
        gradient, curvature: quadratic model; the block of the own unknowns must be positive definite.
    """
    gradient, curvature = gradient.double().cpu(), curvature.double().cpu()
    across = curvature[:own, own:]
    right = torch.cat([gradient[:own, None], across], 1)
    solved = torch.linalg.solve(curvature[:own, :own], right) if own else right
    step, gain = solved[:, 0], solved[:, 1:]
    return Eliminated(gradient[own:] - across.T @ step, curvature[own:, own:] - across.T @ gain, step, gain)


Ignored = Sequence[Mapping[str, Bool[np.ndarray, "h w"]]]
"""Per frame: camera name -> pixels that show an occluder."""

_GOOD = 1.5
"""Multiple of the median loss up to which a frame has full weight [1]."""


_ASSESSED, _COMPARED = 12, 4
"""Maximum number of frames for the assessment, and for a search."""


@dataclass(frozen=True)
class CalibrationEvaluation(Evaluation):
    """Evaluation of all frames at one calibration; the maps are those of the first frame."""

    frame_losses: Float[Tensor, " frames"]
    frame_weights: Float[Tensor, " frames"]
    """Weight of each frame, in [0, 1]."""
    frame_gradients: Float[Tensor, "frames n"] | None
    """Each frame's contribution to the gradient, without the prior."""
    frame_curvatures: Float[Tensor, "frames n n"] | None
    """Each frame's contribution to the curvature, without the prior."""
    outline: Float[Tensor, " n"] | None
    """Change of the gradient for one standard deviation of an error common to all outlines [1]."""


class _FramePart:
    """Problem of one frame in its own unknowns (joint offsets), whose values are stored, and the shared unknowns."""

    def __init__(self, problem: FrameProblem, own: int) -> None:
        self.problem = problem
        self.own = torch.zeros(own, device=problem.variables.lower.device)
        self._anchor: tuple[Tensor, Tensor, Eliminated] | None = None

    def at(self, shared: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch m"]:
        """All unknowns of the frame, with measured joints, at one calibration or a batch of calibrations."""
        return torch.cat([shared.new_zeros(*shared.shape[:-1], len(self.own)), shared], -1)

    def follow(self, shared: Float[Tensor, " n"]) -> None:
        """Update the own unknowns for a calibration, using the stored model."""
        if self._anchor is not None and len(self.own):
            at, own, model = self._anchor
            moved = own + model.own_step(shared - at).to(own)
            self.own = self.problem.variables.clamp(torch.cat([moved, shared]))[: len(own)]

    def anchor(self, shared: Float[Tensor, " n"], model: Eliminated) -> None:
        """Store a quadratic model around the current own unknowns."""
        self._anchor = (shared, self.own, model)

    def observe(self, stage: Observe, shared: Float[Tensor, " n"]) -> None:
        """Observe this frame."""
        self.problem.observe(stage, torch.cat([self.own, shared]))

    def evaluate(self, shared: Float[Tensor, " n"], own: Tensor, stage: Descend, *, gradient: bool) -> Evaluation:
        """Evaluate this frame."""
        return self.problem.evaluate(torch.cat([own, shared]), stage, gradient=gradient)

    def curvature_with_intrinsics(
        self, shared: Float[Tensor, " n"], stage: Descend, free: FreeParameters
    ) -> Float[Tensor, "n k"]:
        """Mixed second derivatives with respect to the shared unknowns and the fixed intrinsics of all cameras."""
        problem, own = self.problem, len(self.own)
        known = problem.variables
        every = Variables(problem.scene, known.start, replace(free, intrinsics=True), problem.settings.length_scale)
        columns = torch.tensor([every.names.index(name) for name in known.names])
        offsets = torch.zeros_like(every.lower)
        offsets[columns] = torch.cat([self.own, shared])
        model = SurfaceFactor(problem.scene, every, problem.observation, problem.settings, stage).linearize(offsets)
        hessian = model.hessian.clone()
        hessian[:own, :own] += problem.prior.precision[:own, :own]
        held = [index for index in range(own, len(every)) if index not in set(columns.tolist())]
        curvature = eliminate(model.gradient, hessian, own).curvature
        return curvature[columns[own:] - own][:, torch.tensor(held) - own]


class CalibrationProblem:
    """Sum of the frames' factors as a function of the calibration alone. Implements `Problem`.

    Args:
        free: unknowns; free joints have separate values in each frame.
        joint_prior_deg: expected error of free joints [deg]; `settings.length_scale` converts it to metres.
        backgrounds: known mean backgrounds of the cameras; see `FrameProblem`.
        known_base_frames: arm -> covariance of the base frame's rotation and translation in its own axes [rad, m], if
            more accurate than the prior of `settings`.

    Attributes:
        variables: unknowns of the calibration.
        stage: index of the current descent.
        present: the current descent.

    Raises:
        SettingsError: an image is missing or its size differs from that of its camera, or no calibration parameter is
            free.
    """

    def __init__(
        self,
        scene: Scene,
        frames: Sequence[Frame],
        predictor: SurfacePredictor,
        free: FreeParameters,
        settings: SurfaceSolver,
        joint_prior_deg: float,
        ignore: Ignored | None = None,
        backgrounds: Backgrounds | None = None,
        known_base_frames: Mapping[str, Float[np.ndarray, "6 6"]] | None = None,
    ) -> None:
        starts = [scene.state(frame.measured, predictor.device, frame.mounts) for frame in frames]
        self.variables = Variables(scene, starts[0], replace(free, joints=False), settings.length_scale)
        self._parts: list[_FramePart] = []
        for index, (frame, start) in enumerate(zip(frames, starts, strict=True)):
            unknowns = Variables(scene, start, free, settings.length_scale)
            own = len(unknowns) - len(self.variables)
            # The prior of the calibration is shared across frames, so per-frame terms do not include it.
            precision = torch.zeros_like(unknowns.lower)
            precision[:own] = math.radians(joint_prior_deg) ** -2
            problem = FrameProblem(
                scene,
                frame.images,
                predictor.for_frame(frame, [camera.name for camera in scene.cameras]),
                unknowns,
                settings,
                frame.ignoring(ignore[index] if ignore else None),
                prior=Prior.around_start(precision),
                backgrounds=backgrounds,
                live=False,
            )
            self._parts.append(_FramePart(problem, own))
        self.prior = _with_base_frames(self.variables, settings, known_base_frames or {})
        self._given_prior = bool(known_base_frames)
        self._free = free
        self._weights = torch.ones(len(frames), dtype=torch.float64)
        self._losses: Tensor | None = None
        self.stage = -1
        self.present: Descend | None = None
        self._lowest, self._begun = math.inf, False

    def objective_key(self, blur: float) -> tuple[int, float]:
        """Key of the objective: the observation and the blur. Losses are comparable within one key."""
        return self._parts[0].problem.objective_key(blur)

    def observe(self, stage: Observe, offsets: Float[Tensor, " n"]) -> None:
        """Observe all frames, and update their weights."""
        if self._losses is not None:
            self._weights = frame_weights(self._losses)
        for part in self._parts:
            part.observe(stage, offsets)
        self._begun = False

    def evaluate(self, offsets: Float[Tensor, " n"], stage: Descend, *, gradient: bool = True) -> CalibrationEvaluation:
        """Evaluate a calibration; free joints are updated for this calibration."""
        if stage is not self.present or not self._begun:
            self.present, self._lowest, self._begun = stage, math.inf, True
            self.stage += 1
        for part in self._parts:
            part.follow(offsets)
        evaluations = [part.evaluate(offsets, part.own, stage, gradient=gradient) for part in self._parts]
        models, outlines = [], []
        for evaluation, part in zip(evaluations, self._parts, strict=True):
            if evaluation.hessian is not None and evaluation.outline_gradient is not None:
                own = len(part.own)
                models.append(eliminate(evaluation.gradient, evaluation.hessian, own))
                outlines.append(eliminate(evaluation.outline_gradient, evaluation.hessian, own).gradient)
        combined = self._combined(offsets, evaluations, models, outlines)
        self._losses = combined.frame_losses
        # The solver steps from the best point so far, so the frames' own unknowns start there as well.
        if models and combined.value < self._lowest:
            self._lowest = combined.value
            for part, model in zip(self._parts, models, strict=True):
                part.anchor(offsets, model)
        return combined

    def frame_losses(self, offsets: Float[Tensor, " n"]) -> Float[np.ndarray, " frames"]:
        """Loss of each frame at a calibration with measured joints, under the current descent."""
        assert self.present is not None
        at_measured = [
            part.evaluate(offsets, torch.zeros_like(part.own), self.present, gradient=False) for part in self._parts
        ]
        return np.array([evaluation.loss for evaluation in at_measured])

    @property
    def masked(self) -> bool:
        """Whether given masks are the target in all frames."""
        return all(part.problem.masked for part in self._parts)

    @property
    def some_masked(self) -> bool:
        """Whether given masks are the target in at least one frame."""
        return any(part.problem.masked for part in self._parts)

    def silhouette_overlap(self, offsets: Float[Tensor, " n"], scale: float) -> float:
        """Mean Dice of silhouettes and masks over a subset of frames, with measured joints."""
        parts = self._some(_COMPARED)
        return float(np.mean([part.problem.silhouette_overlap(part.at(offsets), scale) for part in parts]))

    def search_silhouettes(self, stage: SilhouetteSearch) -> Float[Tensor, " n"]:
        """Offsets whose silhouettes are nearest to the masks in a subset of frames. Unless base frames are known, the
        prior is replaced by the search range around these offsets.
        """
        parts = self._some(_COMPARED)
        compared = [(part, part.problem.silhouettes(stage.scale)) for part in parts]
        distance = float(np.mean([part.problem.distance for part in parts]))

        def distances(trials: Tensor) -> np.ndarray:
            found = [one.distances(part.problem.variables.state(part.at(trials))) for part, one in compared]
            return np.mean(found, axis=0)

        deviation = self.variables.standard_deviations(stage.joints_deg, stage.frames_deg, distance)
        found = search_silhouettes(distances, deviation, self.variables.clamp, stage)
        if self._given_prior:
            return found
        # The search range is the prior of the searched unknowns; the other unknowns keep their prior.
        wide = torch.where(deviation > 0, deviation, self.prior.marginal_precision.rsqrt().to(deviation))
        self.prior = replace(Prior.around_start(wide.to(found) ** -2), mean=found)
        return found

    def _some(self, count: int) -> list[_FramePart]:
        """A subset of evenly spaced frames."""
        return [self._parts[index] for index in evenly_spaced(len(self._parts), count)]

    def evidence(self, offsets: Float[Tensor, " n"]) -> list[Evidence]:
        """Evidence for and against a calibration from evenly spaced frames, with measured joints."""
        losses = [float(loss) for loss in self.frame_losses(offsets)[evenly_spaced(len(self._parts), _ASSESSED)]]
        parts = zip(self._some(_ASSESSED), losses, strict=True)
        return [part.problem.evidence(part.at(offsets), loss) for part, loss in parts]

    def curvature_with_intrinsics(self, offsets: Float[Tensor, " n"]) -> Float[Tensor, "n k"]:
        """Mixed second derivatives with respect to the calibration and fixed intrinsics, at the current stage."""
        assert self.present is not None
        found = [part.curvature_with_intrinsics(offsets, self.present, self._free) for part in self._parts]
        return torch.einsum("f,fnk->nk", self._weights, torch.stack(found))

    def _combined(
        self, offsets: Tensor, evaluations: list[Evaluation], models: list[Eliminated], outlines: list[Tensor]
    ) -> CalibrationEvaluation:
        weights = self._weights
        prior = self.prior.linearize(offsets)
        values = torch.tensor([evaluation.value for evaluation in evaluations], dtype=torch.float64)
        losses = torch.tensor([evaluation.loss for evaluation in evaluations], dtype=torch.float64)
        slope, hessian, gradients, curvatures, outline = torch.zeros_like(offsets), None, None, None, None
        if models:
            gradients = weights[:, None] * torch.stack([model.gradient for model in models])
            curvatures = weights[:, None, None] * torch.stack([model.curvature for model in models])
            outline = weights @ torch.stack(outlines)
            total = curvatures.sum(0)
            slope = prior.gradient + gradients.sum(0).to(offsets)
            hessian = prior.hessian.double() + total.to(offsets.device)
        loss = float(weights @ losses / weights.sum())
        value = float(weights @ values) + prior.cost
        first = replace(evaluations[0], value=value, loss=loss, stage_loss=loss, gradient=slope, hessian=hessian)
        return CalibrationEvaluation(
            **vars(first),
            frame_losses=losses,
            frame_weights=weights,
            frame_gradients=gradients,
            frame_curvatures=curvatures,
            outline=outline,
        )


def with_joint_errors(covariance: Float[np.ndarray, "6 6"], length_scale: float) -> Float[np.ndarray, "6 6"]:
    """Convert the covariance of a base frame [rad, m] to radian-like units, increased by constant joint errors, which
    points cannot distinguish from a base frame error.
    """
    scales = np.repeat([1.0, length_scale], 3)
    return covariance / np.outer(scales, scales) + np.radians(SurfaceSolver.frame_prior_deg) ** 2 * np.eye(6)


def _with_base_frames(
    variables: Variables, settings: SurfaceSolver, known: Mapping[str, Float[np.ndarray, "6 6"]]
) -> Prior:
    """Prior of the settings with known covariances of base frames."""
    prior = variables.prior(settings)
    precision = prior.precision.clone()
    for arm, covariance in known.items():
        rows = [index for index, name in enumerate(variables.names) if name.startswith(f"{arm}/base/")]
        if rows:
            here = torch.tensor(rows, device=precision.device)
            inverse = np.linalg.inv(with_joint_errors(covariance, settings.length_scale))
            precision[here[:, None], here] = torch.from_numpy(inverse).to(precision)
    return replace(prior, precision=precision)


def frame_weights(losses: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """Robust frame weights in [0, 1], which reduce the influence of outliers (bad kinematics, smoke): 1 up to a
    multiple of the median loss, then decreasing.
    """
    shown = losses[losses > 0]
    if not len(shown):
        return torch.ones_like(losses)
    return (_GOOD * shown.median() / losses.clamp(min=1e-12)).clamp(max=1.0).square()
