"""One frame, optimized step by step. Command line, viewer, batch runs and tests all drive this object."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy.typing import ArrayLike

from ..data import Frame
from ..features.extractor import FeatureExtractor
from ..scene import Scene, SceneState
from ..settings import FreeParameters, OptimizerSettings
from .counterfactual import Backgrounds
from .edges import EdgeRefinement
from .evaluation import Evaluation, Objective
from .feature_objective import FeatureObjective
from .ignore import propose_ignore
from .observability import Uncertainty
from .parameters import ParameterVector
from .restart import Restart
from .solvers import make_solver
from .surface_objective import SurfaceObjective


@dataclass(frozen=True)
class Iterate:
    """A point of an optimization and what it looks like. A copy: nothing later changes it."""

    index: int
    """Number of steps before it; 0 is the start."""
    state: SceneState
    loss: float
    """Without the prior. Comparable through the present look at the image, or its stage if nobody watches."""
    terms: dict[str, float]
    """Parts of the objective that was descended."""
    gradient_norms: dict[str, float]
    """Per unknown, in radian-like units."""
    seconds: float
    """Duration of this iteration [s]."""
    arm_names: tuple[str, ...]
    joint_names: tuple[tuple[str, ...], ...]
    """Per arm."""
    silhouette: Float[np.ndarray, "cameras h w"]
    """At the resolution at which it was compared, as are the other maps."""
    image: UInt8[np.ndarray, "cameras h w 3"]
    """Rendered arms, RGB."""
    uncertainty: Uncertainty | None
    """What the images determine; None for losses that cannot say."""
    attention: Float[np.ndarray, "cameras h w"]
    similarity: Float[np.ndarray, "cameras h w"]
    """Of what is compared: cosine of features, or 1 minus the squared difference of surface maps; at most 1."""

    def joint_positions(self) -> dict[str, np.ndarray]:
        """Arm name -> joint positions [dofs], [rad, m]."""
        values = (value.cpu().double().numpy() for value in self.state.joint_positions)
        return dict(zip(self.arm_names, values, strict=True))

    def joint_std(self) -> dict[str, np.ndarray]:
        """Arm name -> standard deviation of the joint positions [dofs], [rad, m]; NaN where it is not known."""
        known = self.uncertainty or Uncertainty((), (), ())
        return {arm: known.joint_std(arm, joints) for arm, joints in zip(self.arm_names, self.joint_names, strict=True)}


BASE_FRAME_GAIN = 0.12
"""Base frames are suspected if, free, they would explain at least this share of the remaining difference [1]; see
`FrameOptimizer.base_frame_gain`."""


@dataclass(frozen=True)
class Progress:
    """What is kept of every iterate, in a few bytes."""

    index: int
    loss: float
    seconds: float


class FrameOptimizer:
    """Optimization of one frame (paper, section 3), one iterate at a time.

    Args:
        scene: arms and cameras.
        frame: observed images and measured joint positions.
        backgrounds: camera name -> mean background BG_m. The loss `surface` takes what looks like an arm in them for
            none, and goes without where one is missing; `Backgrounds` that serve several frames save it time.
        extractor: the feature network.
        ignore: camera name -> pixels that show an occluder; the loss `surface` leaves them out.
        start: arm name -> joint positions to start from, the measured ones by default.
        settings: solver, loss, steps.
        free: what is unknown.
        cameras: names of the cameras that take part, all by default.
        live: whether someone watches. If nobody does, the loss `surface` saves a third of its time: iterates of coarse
            stages are seen and rated as coarsely as they are compared. The end is the same.

    Raises:
        SettingsError: an image or background is missing or of the wrong size, or nothing is free.
        RobotError: `start` lacks an arm or has the wrong number of joint positions.
    """

    def __init__(
        self,
        scene: Scene,
        frame: Frame,
        backgrounds: Mapping[str, UInt8[np.ndarray, "h w 3"]] | Backgrounds,
        extractor: FeatureExtractor,
        *,
        ignore: Mapping[str, Bool[np.ndarray, "h w"]] | None = None,
        start: Mapping[str, ArrayLike] | None = None,
        settings: OptimizerSettings | None = None,
        free: FreeParameters | None = None,
        cameras: Sequence[str] | None = None,
        live: bool = True,
    ) -> None:
        self.settings = settings or OptimizerSettings()
        scene = scene.with_cameras(cameras)
        self._arm_names = tuple(arm.name for arm in scene.arms)
        self._joint_names = tuple(arm.robot.joint_names for arm in scene.arms)
        state = scene.state(frame.measured if start is None else start, extractor.device)
        self._free = free or FreeParameters()
        self._parameters = ParameterVector(scene, state, self._free, self.settings.lever)
        self._scene, self._images, self._extractor, self._given = scene, frame.images, extractor, ignore or {}
        self._live = live
        self._backgrounds = backgrounds if isinstance(backgrounds, Backgrounds) else Backgrounds(backgrounds)
        self._first: Objective
        if self.settings.loss == "surface":
            self._first = self._surface(self._given)
        else:
            self._first = FeatureObjective(
                scene, frame.images, self._backgrounds.images, extractor, self._parameters, self.settings
            )
        self.reset()

    def _surface(self, ignore: Mapping[str, Bool[np.ndarray, "h w"]]) -> SurfaceObjective:
        return SurfaceObjective(
            self._scene,
            self._images,
            self._extractor,
            self._parameters,
            self.settings,
            ignore,
            backgrounds=self._backgrounds,
            live=self._live,
        )

    def reset(self) -> None:
        """Go back to the start; the history is emptied."""
        self.history: list[Progress] = []
        self.best: Iterate | None = None
        self.proposed: dict[str, Bool[np.ndarray, "h w"]] = {}
        """Camera name -> pixels that were left out on a proposal; see `OptimizerSettings.propose_ignore`."""
        self._round = 0
        self._epoch: tuple[int, int, int] | None = None
        self._begin(self._first)

    def _begin(self, objective: Objective) -> None:
        self._objective = objective
        if isinstance(objective, SurfaceObjective):
            objective.forget()
        self._offsets = torch.zeros(len(self._parameters), device=self._parameters.lower.device)
        self._solver = make_solver(self.settings, self._parameters, objective.stages)
        self._restart = Restart(self.settings, objective, self._solver)
        self._reached: tuple[tuple[int, int], torch.Tensor, Evaluation] | None = None
        self._edges: EdgeRefinement | None = None
        self._begun_at = len(self.history)
        self._ended: str | None = None
        self.stop_reason: str | None = None

    def cancel(self) -> None:
        """Stop; what was reached stays in `best` and `history`."""
        self.stop_reason = self.stop_reason or "cancelled"

    def step(self) -> Iterate | None:
        """Evaluate the present point and move on; None once the optimization has stopped.

        The first call gives iterate 0, the start.
        """
        if self.stop_reason is not None:
            return None
        began = time.perf_counter()
        if self._ended is not None:
            return self._last_iterate(began)
        index, offsets, solver = len(self.history), self._offsets, self._solver
        stage = solver.stage
        epoch = self._round, self._restart.number, self._objective.epoch(stage)
        moves = self.settings.solver != "none"
        evaluation = self._objective(offsets, stage, gradient=moves)
        era = self._restart.number, stage
        if self._reached is None or era != self._reached[0] or evaluation.value < self._reached[2].value:
            self._reached = era, offsets, evaluation
        self._offsets = solver(offsets, evaluation)
        iterate = self._iterate(index, offsets, evaluation, time.perf_counter() - began)
        self.history.append(Progress(iterate.index, iterate.loss, iterate.seconds))
        if self.best is None or epoch != self._epoch or iterate.loss < self.best.loss:
            self.best, self._best_offsets, self._epoch = iterate, offsets, epoch
        self._offsets = self._restart(stage, self._offsets, self._reached[2].loss)
        if self.settings.draws_to_edges and solver.finished is None and self._last_look_after(stage):
            # The last look is told where the edges are.
            self._offsets = self._drawn_to_edges()
        self.stop_reason = solver.finished
        if self.stop_reason is not None and moves and self.settings.propose_ignore and self._round == 0:
            self._look_past_occluders()
        if self.settings.draws_to_edges and len(self.history) - self._begun_at < self.settings.iterations:
            self._ended, self.stop_reason = self.stop_reason, None
        return iterate

    def _last_look_after(self, stage: int) -> bool:
        """Whether the solver has moved on from this stage to the last one, and that has a look of its own."""
        objective, ahead = self._objective, self._solver.stage
        if not isinstance(objective, SurfaceObjective) or not stage < ahead == objective.stages - 1:
            return False
        return objective.look(stage) != objective.look(ahead)

    def _last_iterate(self, began: float) -> Iterate:
        """What was reached, with its outlines on edges, or the start if that explains the image as well."""
        assert isinstance(self._objective, SurfaceObjective) and self._reached is not None
        offsets, last = self._drawn_to_edges(), self._objective.stages - 1
        if self._may_keep_start() and self._objective.back_at_start(offsets):
            offsets, self._ended = torch.zeros_like(offsets), "start kept"
            evaluation = self._objective(offsets, last, gradient=True)
        else:
            known = self._reached[2]
            evaluation = self._objective(offsets, last, gradient=False)
            # What edges say has no deviation of its own.
            evaluation = replace(evaluation, gradient=known.gradient, uncertainty=known.uncertainty)
        self._best_offsets = offsets
        iterate = self._iterate(len(self.history), offsets, evaluation, time.perf_counter() - began)
        self.history.append(Progress(iterate.index, iterate.loss, iterate.seconds))
        self.best, self.stop_reason = iterate, self._ended
        return iterate

    def _may_keep_start(self) -> bool:
        """A calibration that is free is thought to be wrong, so its start has nothing to say."""
        free = self._free
        return self.settings.keep_start > 0 and not (free.base_frames or free.extrinsics or free.intrinsics)

    def _drawn_to_edges(self) -> torch.Tensor:
        """What was reached in the present stage, with outlines on edges of the image."""
        assert isinstance(self._objective, SurfaceObjective) and self._reached is not None
        _, offsets, known = self._reached
        assert known.curvature is not None
        if self._edges is None:
            self._edges = EdgeRefinement(
                self._scene,
                self._images,
                self._parameters,
                self.settings,
                self._ignored(),
                self._extractor.device,
            )
        return self._edges(offsets, known.gradient, known.curvature, self._objective.seen()).offsets

    def base_frame_gain(self) -> float | None:
        """Share of what the images still hold against the best iterate that free base frames would explain [1].

        By the linear model, so it costs one more comparison and no run; see docs/experiments for what it is where
        base frames are right and where they are wrong. Pixels that are ignored, on a proposal too, do not count.
        Several cameras count together, so a single one with a wrong pose shows less.

        Returns:
            None before the end, where base frames are free already, or for losses that cannot say.
        """
        objective = self._objective
        if self.stop_reason in (None, "cancelled", "not optimized") or self._free.base_frames:
            return None
        if not isinstance(objective, SurfaceObjective):
            return None
        free = replace(self._free, base_frames=True)
        wider = ParameterVector(self._scene, self._parameters.start, free, self.settings.lever)
        return objective.promised(self._best_offsets, wider)

    def _look_past_occluders(self) -> None:
        """Begin again without what contradicts the best iterate, if there is such."""
        assert self.best is not None
        self.proposed = propose_ignore(self._scene, self.best.silhouette, self.best.similarity)
        if self.proposed:
            self._round = 1
            self._begin(self._surface(self._ignored()))

    def _ignored(self) -> dict[str, Bool[np.ndarray, "h w"]]:
        """Camera name -> pixels that are left out, given and proposed ones."""
        masks = {name: mask | self._given.get(name, False) for name, mask in self.proposed.items()}
        return {**self._given, **masks}

    def __iter__(self) -> Iterator[Iterate]:
        """Step until the optimization stops."""
        while (iterate := self.step()) is not None:
            yield iterate

    def _iterate(self, index: int, offsets: torch.Tensor, evaluation: Evaluation, seconds: float) -> Iterate:
        image = (evaluation.image.movedim(-3, -1) * 255.0).to(torch.uint8)
        return Iterate(
            index=index,
            state=self._parameters.state(offsets).detached(),
            loss=evaluation.loss,
            terms={"similarity": evaluation.value - evaluation.prior, "prior": evaluation.prior},
            gradient_norms=dict(zip(self._parameters.names, evaluation.gradient.abs().tolist(), strict=True)),
            seconds=seconds,
            arm_names=self._arm_names,
            joint_names=self._joint_names,
            silhouette=evaluation.silhouette.cpu().numpy().copy(),
            image=image.cpu().numpy().copy(),
            uncertainty=evaluation.uncertainty,
            attention=evaluation.attention.cpu().numpy(),
            similarity=evaluation.similarity.cpu().numpy(),
        )
