"""Optimizer of single frames."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy.typing import ArrayLike
from torch import Tensor

from ..errors import SettingsError
from ..model.scene import Scene
from ..networks.extractor import FeatureExtractor
from ..recording import Frame
from ..settings import FreeParameters, SolverSettings, SurfaceSolver
from ..settings.stages import FINEST, Descend
from .factors import Factor, bounded_step
from .feature_problem import FeatureProblem
from .frame_problem import FrameProblem
from .image_factors import SurfaceFactor
from .observability import Evaluation
from .observation import Backgrounds
from .predictor import SurfacePredictor, predictor_of
from .results import Iterate, Progress, StopReason
from .stages import Fit, Point, run_stages
from .variables import Variables
from .verdict import Assessment

_BLUR = 3.0
"""Blur of the linear model, approximately its range of validity [px of the working image]."""


@torch.no_grad()
def base_frame_gain(problem: FrameProblem, offsets: Float[Tensor, " n"], free: FreeParameters) -> float:
    """Share of the surface residual at a point that free base frames would explain [1].

    The part that the current unknowns would explain is excluded; joints at a limit are fixed.
    """
    settings, own = problem.settings, problem.variables
    wider = Variables(problem.scene, own.start, replace(free, base_frames=True), settings.length_scale)
    columns = [wider.names.index(name) for name in own.names]
    point = torch.zeros_like(wider.lower).index_copy(0, torch.tensor(columns, device=offsets.device), offsets)
    factor = SurfaceFactor(problem.scene, wider, problem.observation, settings, Descend(_BLUR))
    surface = factor.linearize(point)
    total = wider.prior(settings).linearize(point) + surface
    gradient, hessian = surface.gradient.double(), surface.hessian.double()
    explained = []
    for unknowns in (list(range(len(wider))), columns):
        part = torch.tensor(unknowns, device=offsets.device)
        step = torch.zeros_like(gradient)
        step[part] = bounded_step(
            point[part],
            total.gradient.double()[part],
            total.hessian.double()[part][:, part],
            wider.lower[part],
            wider.upper[part],
        )
        explained.append(-float(gradient @ step + 0.5 * step @ hessian @ step))
    return (explained[0] - explained[1]) / max(surface.cost, 1e-12)


class FrameOptimizer:
    """Step-wise optimization of one frame (paper, section 3).

    Args:
        frame: observed images and measured joint positions.
        backgrounds: camera name -> mean background BG_m. A `DescentSolver` requires all of them; a `SurfaceSolver` uses
            them to discard false detections if there is one for each camera. A `Backgrounds` object caches its
            predictions across frames.
        networks: the networks, or a predictor of surface maps.
        ignore: camera name -> pixels that show an occluder; a `SurfaceSolver` excludes them.
        start: arm name -> joint positions to start from, the measured ones by default.
        settings: the solver, `SurfaceSolver()` by default.
        factors: creates additional factors over the unknowns for the objective of a `SurfaceSolver`.
        cameras: names of the cameras to use, all by default.
        live: whether iterates are displayed. If not, a `SurfaceSolver` renders iterates of coarse stages only at the
            stage's resolution, which saves a third of the time. The result is the same.

    Raises:
        SettingsError: an image or background is missing or of the wrong size, no parameter is free, or factors are
            given to a `DescentSolver`.
        RobotError: `start` lacks an arm or has the wrong number of joint positions.
    """

    def __init__(
        self,
        scene: Scene,
        frame: Frame,
        backgrounds: Mapping[str, UInt8[np.ndarray, "h w 3"]] | Backgrounds,
        networks: FeatureExtractor | SurfacePredictor,
        *,
        ignore: Mapping[str, Bool[np.ndarray, "h w"]] | None = None,
        start: Mapping[str, ArrayLike] | None = None,
        settings: SolverSettings | None = None,
        free: FreeParameters | None = None,
        factors: Callable[[Variables], Sequence[Factor]] = lambda variables: (),
        cameras: Sequence[str] | None = None,
        live: bool = True,
    ) -> None:
        self.settings = settings = settings or SurfaceSolver()
        self._scene = scene = scene.with_cameras(cameras)
        lacking = [camera.name for camera in scene.cameras if camera.name in frame.missing]
        if len(lacking) == len(scene.cameras) or (lacking and not isinstance(settings, SurfaceSolver)):
            names = ", ".join(lacking)
            raise SettingsError(
                f"frame {frame.frame_id} has no image of {names}. Choose other cameras or another frame."
            )
        self._arm_names = tuple(arm.name for arm in scene.arms)
        self._joint_names = tuple(arm.robot.joint_names for arm in scene.arms)
        source = predictor_of(networks) if isinstance(settings, SurfaceSolver) else networks
        state = scene.state(frame.measured if start is None else start, source.device, frame.mounts)
        self._free = free or FreeParameters()
        self._variables = Variables(scene, state, self._free, settings.length_scale)
        known = backgrounds if isinstance(backgrounds, Backgrounds) else Backgrounds(backgrounds)
        further = tuple(factors(self._variables))
        self._problem: FrameProblem | FeatureProblem
        if isinstance(settings, SurfaceSolver):
            predictor = predictor_of(networks).for_frame(frame, [camera.name for camera in scene.cameras])
            given = scene, frame.images, predictor, self._variables, settings, frame.ignoring(ignore)
            self._problem = FrameProblem(*given, factors=further, backgrounds=known, live=live)
        elif further:
            raise SettingsError(
                f"the loss {settings.loss} does not support additional factors. Use the solver `surface`."
            )
        elif isinstance(networks, FeatureExtractor):
            self._problem = FeatureProblem(scene, frame.images, known.images, networks, self._variables, settings)
        else:
            raise SettingsError(f"the loss {settings.loss} requires the feature network. Give a FeatureExtractor.")
        self.reset()

    def reset(self) -> None:
        """Return to the start and clear the history."""
        self.history: list[Progress] = []
        self._visited: list[tuple[torch.Tensor, object]] = []
        self.best: Iterate | None = None
        self.stop_reason: StopReason | None = None
        if isinstance(self._problem, FrameProblem):
            self._problem.reset()
        # A first-order descent also evaluates the point after its last step.
        budget = self.settings.iterations + int(isinstance(self._problem, FeatureProblem))
        self._fit = Fit(self._problem, torch.zeros_like(self._variables.lower), budget)
        self._points = run_stages(self.settings.stages, self._fit)

    @property
    def assessment(self) -> Assessment | None:
        """Final verdict; None before the end, and for solvers without `RejectFailed`."""
        return self._fit.assessment

    @property
    def proposed(self) -> dict[str, Bool[np.ndarray, "h w"]]:
        """Camera name -> pixels of occluders proposed by `IgnoreOccluders`."""
        return self._problem.proposed if isinstance(self._problem, FrameProblem) else {}

    def cancel(self) -> None:
        """Stop; `best` and `history` are kept."""
        self.stop_reason = self.stop_reason or StopReason.CANCELLED

    def step(self) -> Iterate | None:
        """Compute the next iterate; None once the optimization has stopped. Iterate 0 is the start."""
        if self.stop_reason is not None:
            return None
        began = time.perf_counter()
        point = next(self._points, None)
        if point is None:
            self.stop_reason = self._fit.stop_reason
            return None
        iterate = self._iterate(point, time.perf_counter() - began)
        stage = self.history[-1].stage + (point.objective_key != self._visited[-1][1]) if self.history else 0
        self._visited.append((point.offsets, point.objective_key))
        self.history.append(Progress(iterate.index, iterate.loss, iterate.seconds, stage))
        if point is self._fit.best:
            self.best = iterate
        return iterate

    def __iter__(self) -> Iterator[Iterate]:
        """Step until the optimization stops."""
        return iter(self.step, None)

    def comparable_losses(self) -> list[float]:
        """Losses of all iterates under the last observation.

        `Iterate.loss`, in contrast, refers to the observation of the iterate's stage and is comparable only within it.
        """
        problem = self._problem
        if not isinstance(problem, FrameProblem):
            return [progress.loss for progress in self.history]
        return [problem.evaluate(offsets, FINEST, gradient=False).loss for offsets, _ in self._visited]

    def base_frame_gain(self) -> float | None:
        """Share of the surface residual at the best iterate that free base frames would explain [1].

        The share is computed from the linear model without ignored pixels, which takes as long as one comparison. All
        cameras are combined, which reduces the effect of a single camera with a wrong pose.

        Returns:
            The share; None before the end, after a run that was cancelled or did not optimize, if base frames are free,
            or for losses without a surface factor.
        """
        ended = self.stop_reason not in (None, StopReason.CANCELLED, StopReason.NOT_OPTIMIZED)
        if not ended or self._free.base_frames or not isinstance(self._problem, FrameProblem):
            return None
        assert self._fit.best is not None
        return base_frame_gain(self._problem, self._fit.best.offsets, self._free)

    def _iterate(self, point: Point, seconds: float) -> Iterate:
        evaluation: Evaluation = point.evaluation
        image = (evaluation.image.movedim(-3, -1) * 255.0).to(torch.uint8)
        return Iterate(
            index=len(self.history),
            state=self._variables.state(point.offsets).detached(),
            loss=evaluation.loss,
            gradient_norms=dict(zip(self._variables.names, evaluation.gradient.abs().tolist(), strict=True)),
            seconds=seconds,
            arm_names=self._arm_names,
            joint_names=self._joint_names,
            silhouette=evaluation.silhouette.cpu().numpy().copy(),
            image=image.cpu().numpy().copy(),
            uncertainty=evaluation.uncertainty,
            attention=evaluation.attention.cpu().numpy(),
            similarity=evaluation.similarity.cpu().numpy(),
        )
