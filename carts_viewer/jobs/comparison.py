"""Comparison of a solved pose with the earlier pose of its frame by verdict, loss and Dice."""

import json
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from carts_core.optimization import FreeParameters
from carts_core.project import Edits, Figures, Key, ProjectState, Provenance, Source
from carts_core.project.values import VERDICTS
from carts_core.recording import Frame
from carts_viewer.jobs.optimizers import OptimizerFactory, SequenceRun, provenance
from carts_viewer.jobs.solver import Ended, Estimate, Fit, FrameTask, Started
from carts_viewer.jobs.solver_process import Reply
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.session import Session, joint_correction
from carts_viewer.state import Pose, Target, ViewState

_WORSE_LOSS, _WORSE_FAILURE, _WORSE_DICE = 1.1, 0.02, 0.005
"""Thresholds of a worse fit: ratio of losses, difference between probabilities of failure and between Dice [1]."""


def worse_than(fit: Fit, other: Fit) -> str | None:
    """Reason why a fit is worse than another fit of the same frame; None if it is not worse."""
    if other.dice is not None and fit.dice is not None:
        # If ground truth is known, only Dice counts.
        return f"Dice {fit.dice:.3f}, before {other.dice:.3f}" if fit.dice < other.dice - _WORSE_DICE else None
    if VERDICTS.index(fit.verdict.verdict) > VERDICTS.index(other.verdict.verdict):
        return f"{fit.verdict.verdict}, before {other.verdict.verdict}"
    if fit.verdict.failure > other.verdict.failure + _WORSE_FAILURE:
        return f"probability of failure {fit.verdict.failure:.0%}, before {other.verdict.failure:.0%}"
    if fit.loss > _WORSE_LOSS * other.loss:
        return f"loss {fit.loss:.3g}, before {other.loss:.3g}"
    return None


Waiting = Reply[Any] | None
"""Item yielded by the generators of this module: a pending reply, or None after a step."""


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

    def outcome(
        self, estimate: Estimate, run: SequenceRun, before: ProjectState, state: ViewState
    ) -> Generator[Waiting, None, Outcome]:
        """Return the best of the solved pose, the result of an individual run on the frame, and the earlier pose.

        The individual run is made only if the solved pose is worse than the earlier pose, or its verdict is not good.

        Raises:
            CartsError: an image or the weights are not usable.
        """
        frame = self._frame(estimate.index, state)
        was, target = self._session.pose(frame, before), self._session.target(state.observed, before)
        pose = Pose(self._session.with_joints(was.scene, dict(estimate.joint_positions)), Source.PROPAGATED)
        earlier = yield from self._fit(frame, was, state, target)
        solved = yield from self._fit(frame, pose, state, target)
        found = Outcome(solved_edits(estimate, run), Figures(estimate.loss, solved.dice))
        worse = worse_than(solved, earlier)
        if worse is not None or solved.verdict.verdict != "good":
            settings = json.dumps({**json.loads(run.provenance.settings or "{}"), "alone": True})
            alone, edits = yield from self._run(frame, was, state, target, replace(run.provenance, settings=settings))
            if worse_than(alone, earlier) is None and worse_than(alone, solved) is None and worse_than(solved, alone):
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

    def _fit(self, frame: Frame, pose: Pose, state: ViewState, target: Target) -> Generator[Waiting, None, Fit]:
        fit = yield from self._optimizers.fit(self._task(frame, pose, state, target))
        view, dice = self._session.editor.view, []
        for camera in frame.masks or {}:
            correction = view.get(Key.mask_correction(frame.index, camera))
            dice.append(self._renderer.scores(pose.scene, frame, camera, correction).dice)
        known = [value for value in dice if value is not None]
        return replace(fit, dice=min(known, default=None))

    def own_run(self, index: int, state: ViewState) -> Generator[Waiting, None, tuple[Fit, Edits, str | None]]:
        """Run on one frame individually; returns the fit, its edits and `worse_than`.

        Raises:
            CartsError: an image, the weights or a setting is not usable.
        """
        frame = self._frame(index, state)
        was, target = self._session.pose(frame), self._session.target(state.observed)
        earlier = yield from self._fit(frame, was, state, target)
        fit, edits = yield from self._run(frame, was, state, target)
        return fit, edits, worse_than(fit, earlier)

    def _run(
        self, frame: Frame, start: Pose, state: ViewState, target: Target, given: Provenance | None = None
    ) -> Generator[Waiting, None, tuple[Fit, Edits]]:
        """Run on a frame; returns the fit and its edits, with the given provenance or that of the run."""
        task = self._task(frame, start, state, target)
        seen = tuple(target.seen(task.sequence, task.index, task.domain, task.cameras) or task.cameras)
        run, best = self._optimizers.run(replace(task, cameras=seen)), None
        with closing(run.steps):
            while (found := (yield from run.steps.next())) is not None:
                if isinstance(found, Started):
                    run.provenance = given or provenance(found, task.cameras, task.settings, task.free, target)
                best = found.best if isinstance(found, Ended) else None
                yield None
        assert best is not None and run.provenance is not None
        pose = run.pose(best)
        fit = yield from self._fit(frame, pose, state, target)
        return fit, self._session.edits(frame, pose.scene, run.provenance, best.joint_std())

    def _task(self, frame: Frame, pose: Pose, state: ViewState, target: Target) -> FrameTask:
        session, cameras = self._session, tuple(camera.name for camera in self._session.scene.cameras)
        return FrameTask(
            session.sequence,
            frame.index,
            state.domain,
            cameras,
            pose,
            state.settings,
            _joints_alone(state),
            target.of_frame(frame.index),
            session.ignored(frame.index, cameras, target),
        )


def _joints_alone(state: ViewState) -> FreeParameters:
    """Free parameters of a run on one of many frames, which share the calibration."""
    return replace(state.free, base_frames=False, extrinsics=False, intrinsics=False)


def solved_edits(estimate: Estimate, run: SequenceRun) -> Edits:
    """Edits that apply the solved pose of a frame."""
    edits: dict[Key[Any], Any] = {}
    for arm, std in estimate.joint_std.items():
        # Arms that were not free are unchanged.
        if np.isfinite(std).any():
            edits[Key.joints(estimate.index, arm)] = joint_correction(
                estimate.joint_positions[arm], run.provenance, std
            )
    return edits


def unchecked(estimate: Estimate, run: SequenceRun) -> Outcome:
    """The outcome of a frame that was not compared, because solving was stopped."""
    edits = {**solved_edits(estimate, run), Key.verdict(estimate.index): None}
    return Outcome(edits, Figures(estimate.loss), "not compared with the previous pose, because solving was stopped")
