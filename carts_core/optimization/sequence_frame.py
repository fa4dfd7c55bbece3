"""Measurements and estimates of single frames in a sequence, with checkpoints and verdicts."""

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import astuple, dataclass, replace
from enum import StrEnum
from functools import partial, wraps
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..files import OutputPath
from ..imaging.working_image import working_size
from ..model.scene import Scene, SceneState
from ..provenance import Checkpoint, fingerprint
from ..recording import Frame
from ..rendering import Renderer
from ..reprs import short_repr
from ..settings import FreeParameters, SequenceSettings, SurfaceSolver
from ..settings.stages import COMPARE, FINEST, AlignRegions, Descend, Observe, Stage, first_observe, reduced
from .factors import Prior
from .frame import base_frame_gain
from .frame_problem import FrameProblem
from .kalman import Gaussian, Information
from .observability import Evaluation, Uncertainty
from .observation import Backgrounds
from .predictor import SurfacePredictor
from .regions import ColourModel, RegionFactor, RegionImages, align_regions
from .stages import Fit, arm_is_lost, run_stages
from .variables import Variables
from .verdict import OUT_OF_VIEW, Assessment, Evidence

P = ParamSpec("P")
Found = TypeVar("Found")

Ignore = Callable[[int], Mapping[str, Bool[np.ndarray, "h w"]]]

_QUICK_SCALE = 1.0
"""Maximum `Observe.scale` of a quick cold start [1]."""
_SEARCHES = 2
"""Maximum number of searches in one frame [1]."""
_BLUR = 3.0
"""Blur under which a prediction from the image alone is compared [px]."""


@dataclass(frozen=True)
class Measurement:
    """Measurement of one frame at the end of a descent."""

    correction: Float[np.ndarray, " n"]
    """Correction at which the frame is linearized [rad]: the best evaluated, aligned or given one."""
    information: Information
    """Information of the image alone, linearized at the correction and scaled for correlated pixels."""
    loss: float
    """Loss of the surface factor; that of the last frame with the network if this frame is measured without it."""
    iterations: int
    by_colours: bool = False
    """Whether the outlines were aligned with colours and edges, without the network."""

    def left_out(self) -> "Measurement":
        """Copy without the information of its image."""
        return replace(self, information=Information.nothing(len(self.correction)))


@dataclass(frozen=True)
class SingleFrameFit:
    """Result of the single-frame solver."""

    correction: Float[np.ndarray, " n"]
    """Correction of the measured values [rad]."""
    uncertainty: Uncertainty | None
    """Uncertainty that accounts for the verdict; None if unknown."""
    loss: float
    iterations: int
    assessment: Assessment | None
    """Verdict; None for stages without `RejectFailed`."""


def sequence_checkpoint(path: OutputPath, made_with: str) -> Checkpoint:
    """Create the checkpoint of a `SequenceOptimizer`.

    Args:
        made_with: fingerprint of scene, weights, settings and code; frames and predictions need not be included.
    """
    return Checkpoint(path, made_with, (Measurement, Information, Evidence))


def _checkpointed(
    method: "Callable[Concatenate[SequenceFrameSolver, Frame, Variables, P], Found]",
) -> "Callable[Concatenate[SequenceFrameSolver, Frame, Variables, P], Found]":
    """Decorator that caches results of a solver's method in its checkpoint; cached results are bit-identical."""

    @wraps(method)
    def looked_up(
        self: "SequenceFrameSolver", frame: Frame, variables: Variables, *arguments: P.args, **options: P.kwargs
    ) -> Found:
        compute = partial(method, self, frame, variables, *arguments, **options)
        if self._checkpoint is None:
            return compute()
        images = [(name, frame.images[name]) for name in sorted(frame.images)]
        measured = [(name, frame.measured[name]) for name in sorted(frame.measured)]
        masks, mounts = sorted((frame.masks or {}).items()), sorted(frame.mounts.items())
        hidden = sorted(frame.ignoring(self._ignore(frame.index)).items())
        given = [value for value in (*arguments, *options.values()) if not callable(value)]
        plain = [astuple(value) if isinstance(value, Gaussian) else value for value in given]
        key = fingerprint(method.__name__, frame.index, images, masks, measured, mounts, hidden, plain)
        return self._checkpoint.value(key, compute)

    return looked_up


class SequenceFrameSolver:
    """Solves single frames of a sequence.

    Args:
        model: stages of cold and warm starts, and the noise of a measurement.
        ignore: frame index -> camera name -> pixels that show an occluder.
        checkpoint: created by `sequence_checkpoint`; stores the results.
    """

    def __init__(
        self,
        scene: Scene,
        predictor: SurfacePredictor,
        settings: SurfaceSolver,
        model: SequenceSettings,
        ignore: Ignore,
        backgrounds: Backgrounds | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> None:
        self._scene, self._predictor, self._settings, self._ignore = scene, predictor, settings, ignore
        self._backgrounds, self._checkpoint = backgrounds, checkpoint
        self._share = (settings.noise / model.measurement_noise) ** 2
        self._cold, self._warm, self._wide = model.cold, model.warm, model.wide

    @_checkpointed
    def warm(
        self, frame: Frame, variables: Variables, expected: Gaussian, start: np.ndarray, *, wide: bool = False
    ) -> Measurement:
        """Find the correction near `start` [n]; with `wide`, use a larger margin around the arms, and more steps."""
        prior = _prior(expected, variables)
        fit = self._run(frame, variables, prior, self._wide if wide else self._warm, start)
        return self._measurement(fit, prior)

    def search(
        self,
        frame: Frame,
        variables: Variables,
        expected: Gaussian,
        hypotheses: Sequence[np.ndarray],
        cancelled: Callable[[], bool] = lambda: False,
        *,
        sure_loss: float,
    ) -> Measurement:
        """Find the correction with the cold stages alone; without information if an arm is lost (see `arm_is_lost`).

        Args:
            hypotheses: corrections [n] that are further candidates of `RandomRestart`.
            cancelled: see `cold`.
            sure_loss: loss above which the search is repeated with other random states, as it is if an arm is lost;
                the better result counts [1].
        """
        prior, start, found = _prior(expected, variables), np.zeros(len(variables)), []
        for seed in range(_SEARCHES):
            fit = self._run(frame, variables, prior, self._cold, start, cancelled, hypotheses, seed)
            measurement = self._measurement(fit, prior)
            assert isinstance(fit.problem, FrameProblem)
            lost = arm_is_lost(fit.problem, _offsets(measurement.correction, variables))
            found.append((lost, measurement.loss, measurement.left_out() if lost else measurement))
            if not lost and measurement.loss <= sure_loss:
                break
        return min(found, key=lambda one: one[:2])[2]

    def visible(self, frame: Frame, variables: Variables, correction: np.ndarray) -> tuple[float, float]:
        """Area predicted as arms in the whole image, from the image alone, relative to the rendered area at a
        correction [n]; and the loss of the correction under this prediction [1]."""
        problem, offsets = self._problem(frame, variables, None), _offsets(correction, variables)
        stage = first_observe(self._settings.stages)
        problem.observe(stage, offsets, whole=True)
        found = problem.evaluate(offsets, Descend(blur=_BLUR), gradient=False)
        seen = problem.observation.whole_coverage().mean()
        return float(seen / found.silhouette.mean().clamp(min=OUT_OF_VIEW)), found.stage_loss

    def _measurement(self, fit: Fit, prior: Prior) -> Measurement:
        """Measurement at the end of a descent, with the edges if they were aligned."""
        assert fit.best_of_descent is not None
        seen = _information(fit.best_of_descent.offsets, fit.best_of_descent.evaluation, prior)
        correction = fit.best_of_descent.offsets
        if fit.edges is not None:
            correction, precision = fit.offsets, _double(fit.edges.hessian)
            seen += Information(precision, precision @ _double(correction) - _double(fit.edges.gradient))
        loss = fit.best_of_descent.evaluation.stage_loss
        return Measurement(_double(correction), seen.scaled(self._share), loss, fit.used)

    @_checkpointed
    def cold(
        self,
        frame: Frame,
        variables: Variables,
        expected: Gaussian,
        *,
        quick: bool = False,
        cancelled: Callable[[], bool] = lambda: False,
    ) -> Measurement:
        """Find the correction with the cold stages, starting at the measured values, and then the warm stages; with
        `quick`, use smaller images in the cold stages.

        Raises:
            CancelledError: `cancelled` returned True after an evaluation.
        """
        stages = reduced(self._cold, _QUICK_SCALE) if quick else self._cold
        start = np.zeros(len(variables))
        fit = self._run(frame, variables, _prior(expected, variables), stages, start, cancelled)
        assert fit.best_of_descent is not None
        end = self.warm(frame, variables, expected, _double(fit.best_of_descent.offsets))
        return replace(end, iterations=fit.used + end.iterations)

    def run_frame_stages(self, frame: Frame, variables: Variables) -> SingleFrameFit | None:
        """Run the stages of the settings, like `FrameOptimizer`; None if nothing was evaluated."""
        fit = self._run(frame, variables, None, self._settings.stages, np.zeros(len(variables)))
        if fit.best is None:
            return None
        found, used = fit.best.evaluation, fit.used
        return SingleFrameFit(_double(fit.best.offsets), found.uncertainty, found.loss, used, fit.assessment)

    def between(
        self, frame: Frame, variables: Variables, expected: Gaussian, colours: ColourModel, stage: AlignRegions
    ) -> tuple[Measurement, Float[np.ndarray, " arms"]]:
        """Find the correction near its prediction without the network; returns it and the likelihood of each arm (see
        `Alignment`)."""
        images, prior = self._region_images(frame), _prior(expected, variables)
        start = _offsets(expected.mean, variables)
        factor = RegionFactor(images, variables, colours, stage)
        found = align_regions(factor, prior.linearize(start), stage, start, variables)
        precision, correction = _double(found.model.hessian), _double(found.offsets)
        seen = Information(precision, precision @ correction - _double(found.model.gradient))
        measurement = Measurement(correction, seen.scaled(self._share), math.nan, stage.steps, True)
        return measurement, found.likelihood

    def colours(self, frame: Frame, variables: Variables, correction: np.ndarray) -> ColourModel | None:
        """Colours at the outlines of a correction [n]; see `RegionImages.learnt`."""
        return self._region_images(frame).learnt(variables.state(_offsets(correction, variables)))

    def masked(self, frame: Frame) -> bool:
        """Whether given masks are the target in a frame."""
        return self._predictor.for_frame(frame, [camera.name for camera in self._scene.cameras]).masked

    def _region_images(self, frame: Frame) -> RegionImages:
        ignore = frame.ignoring(self._ignore(frame.index))
        return RegionImages(self._scene, frame.images, ignore, self._settings)

    @_checkpointed
    def at(self, frame: Frame, variables: Variables, expected: Gaussian, correction: np.ndarray) -> Measurement:
        """Evaluate a given correction [n]."""
        problem = self._problem(frame, variables, _prior(expected, variables))
        offsets = torch.from_numpy(correction).to(variables.lower)
        problem.observe(first_observe(self._warm), offsets)
        evaluation = problem.evaluate(offsets, FINEST)
        information = _information(offsets, evaluation, problem.prior).scaled(self._share)
        return Measurement(correction, information, evaluation.stage_loss, 0)

    @_checkpointed
    def losses(self, frame: Frame, variables: Variables, corrections: Sequence[np.ndarray]) -> list[float]:
        """Losses of corrections [n] in a smaller image, each under an observation conditioned on that correction."""
        problem, found = self._problem(frame, variables, None), []
        for correction in corrections:
            offsets = _offsets(correction, variables)
            problem.observe(first_observe(COMPARE), offsets)
            found.append(problem.evaluate(offsets, FINEST, gradient=False).stage_loss)
        return found

    @_checkpointed
    def evidence(self, frame: Frame, variables: Variables, correction: np.ndarray, loss: float) -> Evidence:
        """Evidence for and against a correction [n] with known loss."""
        offsets = _offsets(correction, variables)
        return self._problem(frame, variables, None).evidence(offsets, loss)

    def arms_out_of_view(self, variables: Variables, correction: np.ndarray) -> bool:
        """Whether any arm is out of view at a correction [n]."""
        offsets = _offsets(correction, variables)
        width, height = working_size(self._scene, self._settings.working_width, 1)
        labels = Renderer(self._scene, width=width, height=height).segment(variables.state(offsets).to("cpu"))
        return any(not (labels == arm).any() for arm in range(len(self._scene.arms)))

    def base_frame_gain(
        self, frame: Frame, variables: Variables, correction: np.ndarray, free: FreeParameters
    ) -> float:
        """Share of the surface residual at a correction [n] that free base frames would explain [1]."""
        offsets = _offsets(correction, variables)
        problem = self._problem(frame, variables, None)
        problem.observe(Observe(), offsets)
        return base_frame_gain(problem, offsets, free)

    def _problem(self, frame: Frame, variables: Variables, prior: Prior | None) -> FrameProblem:
        return FrameProblem(
            self._scene,
            frame.images,
            self._predictor.for_frame(frame, [camera.name for camera in self._scene.cameras]),
            variables,
            self._settings,
            frame.ignoring(self._ignore(frame.index)),
            prior=prior,
            backgrounds=self._backgrounds,
            live=False,
        )

    def _run(
        self,
        frame: Frame,
        variables: Variables,
        prior: Prior | None,
        stages: tuple[Stage, ...],
        start: np.ndarray,
        cancelled: Callable[[], bool] = lambda: False,
        hypotheses: Sequence[np.ndarray] = (),
        seed: int = 0,
    ) -> Fit:
        problem = self._problem(frame, variables, prior)
        offsets, further = _offsets(start, variables), tuple(_offsets(one, variables) for one in hypotheses)
        fit = Fit(problem, offsets, self._settings.iterations, hypotheses=further, seed=seed)
        for _ in run_stages(stages, fit):
            if cancelled():
                raise CancelledError
        return fit


class ColourTracker:
    """Measures frames without the network, by the colours of earlier frames.

    If the colours do not identify the arms (such as in smoke), the network is evaluated in the next frames: in one at
    first, then in twice as many each time.

    Args:
        model: settings `between`, `look_every` and `min_likelihood`.
    """

    def __init__(self, model: SequenceSettings) -> None:
        self._model = model
        self._colours: ColourModel | None = None
        self._usual: np.ndarray | None = None
        """Usual likelihood of each arm [1]."""
        self._loss = math.nan
        self._since = 0
        """Number of frames since the last one with the network."""
        self._pause, self._pauses = 0, 0
        """Number of following frames that require the network, and of such pauses since the last frame without it."""

    @property
    def due(self) -> bool:
        """Whether the next frame requires the network even if the colours fit well."""
        return self._since + 1 >= self._model.look_every

    @property
    def ready(self) -> bool:
        """Whether the next frame requires the network at most because it is due."""
        return self._colours is not None and self._pause == 0

    def measured(
        self,
        solver: SequenceFrameSolver,
        frame: Frame,
        variables: Variables,
        expected: Gaussian,
        *,
        overdue: bool = False,
    ) -> Measurement | None:
        """Measurement of a frame without the network; None if the network is needed.

        Args:
            overdue: whether the frame is measured without the network even if the network is due.
        """
        if not self.ready or self._colours is None or (self.due and not overdue) or solver.masked(frame):
            return None
        (stage,) = self._model.between
        assert isinstance(stage, AlignRegions)
        found, likelihood = solver.between(frame, variables, expected, self._colours, stage)
        usual = likelihood if self._usual is None else self._usual
        least = np.maximum(self._model.min_likelihood, _USUAL_SHARE * np.nan_to_num(usual))
        if (
            np.isnan(likelihood).all()
            or (likelihood < least).any()
            or found.information.contradicts(expected, variables.groups)
        ):
            self._wait()
            return None
        mean = (1.0 - _NEWEST) * usual + _NEWEST * likelihood
        self._usual = np.where(np.isnan(mean), likelihood, mean)
        self._since, self._pauses = self._since + 1, 0
        return replace(found, loss=self._loss)

    def learn(
        self,
        solver: SequenceFrameSolver,
        frame: Frame,
        variables: Variables,
        found: Measurement,
        good: bool,
        colours: ColourModel | None = None,
    ) -> None:
        """Learn the colours of a frame that was measured with the network, if the fit is good.

        Args:
            colours: the colours of the frame; computed if None.
        """
        self._since, self._loss = 0, found.loss
        if not good:
            self._colours = self._usual = None
        if self._pause > 1:
            self._pause -= 1
        elif good and self._model.between and self._model.look_every > 1 and not solver.masked(frame):
            self._pause = 0
            new = colours or solver.colours(frame, variables, found.correction)
            self._colours = self._colours.updated(new, _NEWEST) if self._colours and new else new
            if new is None:
                self._wait()

    def _wait(self) -> None:
        """Require the network in the next frames."""
        self._pause, self._pauses = _SHORTEST << min(self._pauses, _MOST_PAUSES), self._pauses + 1


_NEWEST = 0.3
"""Weight of the newest frame in averages of colours and likelihoods [1]."""
_SHORTEST = 1
"""Number of frames with the network after an alignment was rejected."""
_USUAL_SHARE = 0.5
"""Share of the usual likelihood below which the network is needed [1]."""
_MOST_PAUSES = 5
"""Maximum number of doublings of a pause."""


def _prior(expected: Gaussian, variables: Variables) -> Prior:
    parts = expected.mean, np.linalg.inv(expected.covariance)
    return Prior(*(torch.from_numpy(part).to(variables.lower) for part in parts))


def _offsets(correction: np.ndarray, variables: Variables) -> Tensor:
    """Convert a correction [n] to offsets, clamped to the joint limits."""
    return variables.clamp(torch.from_numpy(correction).to(variables.lower))


def _information(offsets: Tensor, evaluation: Evaluation, prior: Prior) -> Information:
    """Information of the image alone: the quadratic model without the prior."""
    assert evaluation.hessian is not None
    known = prior.linearize(offsets)
    precision = _double(evaluation.hessian - known.hessian)
    # Rounding errors must not make information negative.
    values, vectors = np.linalg.eigh(0.5 * (precision + precision.T))
    precision = vectors @ np.diag(values.clip(min=0.0)) @ vectors.T
    slope = _double(evaluation.gradient - known.gradient)
    return Information(precision, precision @ _double(offsets) - slope)


def _double(values: Tensor) -> np.ndarray:
    return values.detach().cpu().double().numpy()


class Origin(StrEnum):
    """Source of a frame's values."""

    WARM = "warm"
    """Optimized from the correction predicted by other frames."""
    COLD = "cold"
    """Optimized from the measured values or, for the first frame, from the initial correction."""
    KEYFRAME = "keyframe"
    """Joint positions set manually."""
    CARRIED = "carried"
    """Predicted from the other frames; the image contradicts them and is ignored, or is missing."""
    MEASURED = "measured"
    """Measured values, restored because the sequence and this frame failed."""


@dataclass(frozen=True)
class FrameEstimate:
    """Estimate of one frame from the measurements of all frames."""

    index: int
    frame_id: str
    state: SceneState
    joint_positions: dict[str, Float[np.ndarray, " dofs"]]
    """Arm name -> joint positions [rad, m]."""
    joint_std: dict[str, Float[np.ndarray, " dofs"]]
    """Arm name -> standard deviation [rad, m]; 0 for exact keyframes, NaN for fixed joints."""
    uncertainty: Uncertainty
    """Posterior and prior standard deviations of all unknowns."""
    loss: float
    """Loss of the surface factor at the last visit."""
    start: Origin
    iterations: int
    """Number of optimization steps over all visits."""
    seconds: float
    """Time spent on the frame over all visits, including reading [s]."""
    assessment: Assessment | None = None
    """Verdict; None before all frames are visited, and for a frame without an image."""

    __repr__ = short_repr

    def judged(self, assessment: Assessment, scene: Scene) -> "FrameEstimate":
        """Estimate with a verdict, and standard deviations that account for a wrong fit.

        Standard deviations of keyframes, of values predicted from other frames, and of frames with
        `Assessment.nothing_there` are not changed.
        """
        if assessment.nothing_there or self.start in (Origin.KEYFRAME, Origin.CARRIED):
            return replace(self, assessment=assessment)
        known = assessment.of(self.uncertainty)
        return replace(self, assessment=assessment, uncertainty=known, joint_std=_joint_std(known, scene))

    def with_single_frame_fit(
        self, scene: Scene, variables: Variables, found: SingleFrameFit, seconds: float
    ) -> "FrameEstimate":
        """Estimate whose values are replaced by those of the single-frame solver.

        Args:
            found: the result; its uncertainty must be known.
            seconds: additional time [s].
        """
        assert found.uncertainty is not None
        state, joints = _positions(scene, variables, found.correction)
        return replace(
            self,
            state=state,
            joint_positions=joints,
            joint_std=_joint_std(found.uncertainty, scene),
            uncertainty=found.uncertainty,
            loss=found.loss,
            start=Origin.COLD,
            iterations=self.iterations + found.iterations,
            seconds=self.seconds + seconds,
            assessment=found.assessment,
        )


@dataclass(frozen=True)
class Visit:
    """Record of a solved frame."""

    frame_id: str
    variables: Variables
    measurement: Measurement
    start: Origin
    seconds: float
    routine: bool = False
    """Whether the network was evaluated only because it was due, with the usual result."""
    blank: bool = False
    """Whether the frame has no image of any camera."""

    def estimate(self, scene: Scene, index: int, correction: Gaussian, prior: Gaussian) -> FrameEstimate:
        """Estimate of the frame for a correction of the measured values [rad], given the prior before any image."""
        variables = self.variables
        state, joint_positions = _positions(scene, variables, correction.mean)
        scales = variables.scales.cpu().double().numpy()
        std, expected = (np.sqrt(known.covariance.diagonal().clip(min=0.0)) * scales for known in (correction, prior))
        uncertainty = Uncertainty(tuple(variables.names), tuple(std.tolist()), tuple(expected.tolist()))
        return FrameEstimate(
            index=index,
            frame_id=self.frame_id,
            state=state,
            joint_positions=joint_positions,
            joint_std=_joint_std(uncertainty, scene),
            uncertainty=uncertainty,
            loss=self.measurement.loss,
            start=self.start,
            iterations=self.measurement.iterations,
            seconds=self.seconds,
        )


def _joint_std(known: Uncertainty, scene: Scene) -> dict[str, Float[np.ndarray, " dofs"]]:
    return {arm.name: known.joint_std(arm.name, arm.robot.joint_names) for arm in scene.arms}


def _positions(
    scene: Scene, variables: Variables, correction: Float[np.ndarray, " n"]
) -> tuple[SceneState, dict[str, Float[np.ndarray, " dofs"]]]:
    offsets = torch.from_numpy(correction).to(variables.lower)
    state = variables.state(variables.clamp(offsets)).detached()
    joints = [values.cpu().double().numpy().copy() for values in state.joint_positions]
    return state, {arm.name: values for arm, values in zip(scene.arms, joints, strict=True)}
