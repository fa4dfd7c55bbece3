"""Comparison of a solved pose with the earlier pose of its frame by verdict, loss and Dice."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from carts_core.optimization import FreeParameters, SolverSettings
from carts_core.project import Edits, Figures, FitVerdict, Key, ProjectState, Provenance, Source
from carts_core.project.values import VERDICTS
from carts_core.recording import Frame
from carts_viewer.jobs.optimizers import ActiveRun, FrameTask, OptimizerFactory, SequenceRun
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.session import Session, joint_correction
from carts_viewer.state import Pose, Target, ViewState

if TYPE_CHECKING:
    from carts_core.optimization import Assessment, FrameEstimate

_OUT_OF_VIEW = 5e-4
"""Share of an image that arms must cover to count as in view of the camera [1]."""
_WORSE_LOSS, _WORSE_FAILURE, _WORSE_DICE = 1.1, 0.02, 0.005
"""Thresholds of a worse fit: ratio of losses, difference between probabilities of failure and between Dice [1]."""


@dataclass(frozen=True)
class Fit:
    """Fit of a pose to the images of its frame."""

    verdict: FitVerdict
    loss: float
    """Mean loss of the cameras with an arm in view [1]."""
    dice: float | None = None
    """Dice overlap with the ground-truth mask; None if there is none."""

    def worse_than(self, other: "Fit") -> str | None:
        """Reason why this fit is worse than another fit of the same frame; None if it is not worse."""
        if other.dice is not None and self.dice is not None:
            # If ground truth is known, only Dice counts.
            return f"Dice {self.dice:.3f}, before {other.dice:.3f}" if self.dice < other.dice - _WORSE_DICE else None
        if VERDICTS.index(self.verdict.verdict) > VERDICTS.index(other.verdict.verdict):
            return f"{self.verdict.verdict}, before {other.verdict.verdict}"
        if self.verdict.failure > other.verdict.failure + _WORSE_FAILURE:
            return f"probability of failure {self.verdict.failure:.0%}, before {other.verdict.failure:.0%}"
        if self.loss > _WORSE_LOSS * other.loss:
            return f"loss {self.loss:.3g}, before {other.loss:.3g}"
        return None


class FitCheck:
    """Assesses poses against images without changing them."""

    def __init__(self, session: Session, optimizers: OptimizerFactory) -> None:
        self._session = session
        self._optimizers = optimizers

    def fit(self, index: int, domain: str, pose: Pose, settings: SolverSettings, target: Target) -> Fit:
        """The fit of a pose in all cameras that can be compared with the target.

        Raises:
            CartsError: an image, a mask or the weights are not usable.
        """
        sequence, cameras = self._session.sequence, [camera.name for camera in self._session.scene.cameras]
        found: dict[str, tuple[Assessment, float]] = {}
        for name in target.seen(sequence, index, domain, cameras) or cameras:
            ignore = self._session.ignored(index, [name], target)
            task = FrameTask(sequence, index, domain, (name,), pose, settings, FreeParameters(), target, ignore)
            found[name] = self._optimizers.assess(task)
        # Cameras without an arm in view are ignored, unless no camera has an arm in view.
        seeing = {name: one for name, one in found.items() if one[0].evidence.area >= _OUT_OF_VIEW} or found
        loss = sum(loss for _, loss in seeing.values()) / len(seeing)
        return Fit(frame_verdict({name: assessment for name, (assessment, _) in seeing.items()}), loss)


def frame_verdict(assessed: "dict[str, Assessment]") -> FitVerdict:
    """Verdict on a frame: the worst verdict of its cameras."""
    worst = max(assessed, key=lambda name: (VERDICTS.index(assessed[name].verdict.value), assessed[name].probability))
    found = assessed[worst]
    verdict = FitVerdict(found.verdict.value, found.reason, found.remedy, found.probability)
    if len(assessed) == 1:
        return verdict
    cameras = tuple((name, one.probability) for name, one in assessed.items())
    reason = found.reason if found.verdict.value == VERDICTS[0] else f"Camera {worst}: {found.reason}"
    return replace(verdict, reason=reason, cameras=cameras)


@dataclass(frozen=True)
class Outcome:
    """Result of solving one frame."""

    edits: Edits
    figures: Figures
    remark: str | None = None
    """Reason to inspect the frame, as text for the user."""
    worse: bool = False
    """Whether the result fits worse than the earlier pose, which is kept."""


class Comparison:
    """Compares a solved pose with the earlier pose of the frame."""

    def __init__(self, session: Session, renderer: OverlayRenderer, optimizers: OptimizerFactory) -> None:
        self._session = session
        self._renderer = renderer
        self._optimizers = optimizers
        self._check = FitCheck(session, optimizers)

    def outcome(self, estimate: "FrameEstimate", run: SequenceRun, before: ProjectState, state: ViewState) -> Outcome:
        """The best of the solved pose, the result of an individual run on the frame, and the earlier pose.

        The individual run is made only if the solved pose is worse than the earlier pose, or its verdict is not good.

        Raises:
            CartsError: an image or the weights are not usable.
        """
        frame = self._frame(estimate.index, state)
        was, target = self._session.pose(frame, before), self._session.target(state.observed, before)
        pose = Pose(self._session.with_joints(was.scene, estimate.joint_positions), Source.PROPAGATED)
        earlier, solved = self._fit(frame, was, state, target), self._fit(frame, pose, state, target)
        found = Outcome(solved_edits(estimate, run), Figures(estimate.loss, solved.dice))
        worse = solved.worse_than(earlier)
        if worse is not None or solved.verdict.verdict != "good":
            alone, edits = self._alone(frame, was, state, target, run.provenance)
            if alone.worse_than(earlier) is None and alone.worse_than(solved) is None and solved.worse_than(alone):
                found, solved, worse = Outcome(edits, Figures(alone.loss, alone.dice)), alone, None
        remark = worse
        if remark is None and solved.verdict.verdict != "good":
            remark = f"{solved.verdict.verdict}: {solved.verdict.reason}"
        verdict = {Key.verdict(estimate.index): solved.verdict}
        return replace(found, edits={**found.edits, **verdict}, remark=remark, worse=worse is not None)

    def _frame(self, index: int, state: ViewState) -> Frame:
        sequence, domain = self._session.sequence, state.domain
        cameras = [camera.name for camera in self._session.scene.cameras if sequence.has_masks(camera.name, domain)]
        return sequence.frame(index, domain, cameras)

    def _fit(self, frame: Frame, pose: Pose, state: ViewState, target: Target) -> Fit:
        fit = self._check.fit(frame.index, state.domain, pose, state.settings, target)
        view, dice = self._session.editor.view, []
        for camera in frame.masks or {}:
            correction = view.get(Key.mask_correction(frame.index, camera))
            dice.append(self._renderer.scores(pose.scene, frame, camera, correction).dice)
        known = [value for value in dice if value is not None]
        return replace(fit, dice=min(known, default=None))

    def own_run(self, index: int, state: ViewState) -> Iterator[tuple[Fit, Edits, str | None] | None]:
        """Run on one frame individually; yields None after each step, then the fit, its edits and `worse_than`.

        Raises:
            CartsError: an image, the weights or a setting is not usable.
        """
        frame = self._frame(index, state)
        was, target = self._session.pose(frame), self._session.target(state.observed)
        earlier = self._fit(frame, was, state, target)
        cameras = [camera.name for camera in self._session.scene.cameras]
        provenance = self._optimizers.provenance(cameras, state.settings, _joints_alone(state), target)
        for outcome in self._steps(frame, was, state, target, provenance):
            yield None if outcome is None else (*outcome, outcome[0].worse_than(earlier))

    def _alone(
        self, frame: Frame, start: Pose, state: ViewState, target: Target, of_many: Provenance
    ) -> tuple[Fit, Edits]:
        """The fit of an individual run on this frame, and the edits that apply it."""
        settings = json.dumps({**json.loads(of_many.settings or "{}"), "alone": True})
        steps = self._steps(frame, start, state, target, replace(of_many, settings=settings))
        return next(outcome for outcome in steps if outcome is not None)

    def _steps(
        self, frame: Frame, start: Pose, state: ViewState, target: Target, provenance: Provenance
    ) -> Iterator[tuple[Fit, Edits] | None]:
        session, names = self._session, [camera.name for camera in self._session.scene.cameras]
        cameras = tuple(target.seen(session.sequence, frame.index, state.domain, names) or names)
        ignore = session.ignored(frame.index, cameras, target)
        free, settings = _joints_alone(state), state.settings
        task = FrameTask(session.sequence, frame.index, state.domain, cameras, start, settings, free, target, ignore)
        run = ActiveRun(self._optimizers.make(task), task, provenance)
        while run.optimizer.step() is not None:
            yield None
        best = run.optimizer.best
        assert best is not None
        pose = run.pose(best)
        yield self._fit(frame, pose, state, target), session.edits(frame, pose.scene, provenance, best.joint_std())


def _joints_alone(state: ViewState) -> FreeParameters:
    """Free parameters of a run on one of many frames, which share the calibration."""
    return replace(state.free, base_frames=False, extrinsics=False, intrinsics=False)


def solved_edits(estimate: "FrameEstimate", run: SequenceRun) -> Edits:
    """Edits that apply the solved pose of a frame."""
    edits: dict[Key[Any], Any] = {}
    for arm, std in estimate.joint_std.items():
        # Arms that were not free are unchanged.
        if np.isfinite(std).any():
            edits[Key.joints(estimate.index, arm)] = joint_correction(
                estimate.joint_positions[arm], run.provenance, std
            )
    return edits


def unchecked(estimate: "FrameEstimate", run: SequenceRun) -> Outcome:
    """The outcome of a frame that was not compared, because solving was stopped."""
    edits = {**solved_edits(estimate, run), Key.verdict(estimate.index): None}
    return Outcome(edits, Figures(estimate.loss), "not compared with the previous pose, because solving was stopped")
