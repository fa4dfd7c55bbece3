"""What intents about keyframes do: marking them, and solving the frames between them together."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import singledispatchmethod
from typing import Any

import numpy as np

from carts_core.errors import CartsError, ProjectError
from carts_core.optimization import FrameEstimate
from carts_core.project import Edits, Figures, Key, Keyframe, ProjectState, Review, ReviewState, between_kept
from carts_core.project.keys import WHOLE_PROJECT
from carts_viewer import intents
from carts_viewer.checks import unknown
from carts_viewer.context import Context, OpenRun
from carts_viewer.running import OptimizerFactory, SequenceRun
from carts_viewer.session import joint_correction
from carts_viewer.state import SolveState


class PropagatingHandler:
    """The handler that solves many frames, one at a time."""

    def __init__(self, context: Context, run: OpenRun, optimizers: OptimizerFactory) -> None:
        self._context = context
        self._open_run = run
        self._session = context.session
        self._optimizers = optimizers
        self._run: SequenceRun | None = None
        self._work: Iterator[None] = iter(())
        self._before: ProjectState = context.session.editor.view
        """What the project said when the run began."""

    @singledispatchmethod
    def handle(self, intent: intents.Propagating) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        raise unknown(intent)

    def wait_time(self) -> float | None:
        """0 while frames are being solved; None when they are not."""
        return None if self._run is None else 0.0

    def advance(self) -> None:
        """Solve the next frame, if there is one.

        Raises:
            CartsError: a frame is not usable, or the frames could not be saved. What was solved is saved if it can be.
        """
        if self._run is not None:
            next(self._work, None)

    def drop(self, reason: str) -> None:
        """Forget what is being solved, if anything is."""
        if self._run is not None:
            self._run = None
            self._report(running=False, text=reason)

    def finish(self) -> None:
        """Stop, and save the frames that are solved. Errors as `advance`."""
        if self._run is not None:
            self._run.cancel()
            for _ in self._work:
                pass

    # ---- Intents ---------------------------------------------------------------------------------------------------

    @handle.register
    def _(self, intent: intents.HoldKeyframe) -> None:
        state = self._context.state
        on = not state.project.is_keyframe(state.index) if intent.on is None else bool(intent.on)
        self._open_run.end("Stopped: the frame was marked")
        name = "Make a keyframe" if on else "Make no keyframe"
        self._context.edit(name, {Key.keyframe(state.index): Keyframe(on)})

    @handle.register
    def _(self, intent: intents.SetDirection) -> None:
        if intent.direction not in ("forward", "backward"):
            raise CartsError(f"There is no direction {intent.direction!r}.")
        self._context.change(direction=intent.direction)

    @handle.register
    def _(self, intent: intents.Solve) -> None:
        if self._run is not None:
            raise CartsError("Frames are being solved already. Wait, or stop that first.")
        project = self._session.editor.project
        if not project.writable:
            raise ProjectError(f"Solved frames could not be saved: {project.read_only_reason}")
        self._open_run.end("Stopped: many frames are solved together")
        self._context.save()
        view, index = self._session.editor.view, self._context.state.index
        if not (intent.whole or view.kept_frames):
            raise CartsError(
                "There is no keyframe yet. Correct a frame by hand, accept one, or solve all frames without any."
            )
        frames = range(len(self._session.sequence)) if intent.whole else between_kept(view, index)
        kept = [frame for frame in view.kept_frames if frame in frames]
        if len(kept) == len(frames):
            raise CartsError("Every frame there is a keyframe or accepted, so there is nothing to solve.")
        self._before = view
        self._context.change(playing=False, error=None)
        self._run = self._make(frames, kept)
        self._work = self._bits(self._run)
        self._context.change(busy=None, solve=SolveState(frames, text="Estimating the first frame"))

    @handle.register
    def _(self, intent: intents.StopSolving) -> None:
        self.finish()

    # ---- The run ---------------------------------------------------------------------------------------------------

    def _make(self, frames: range, kept: list[int]) -> SequenceRun:
        state, sequence, cameras = self._context.state, self._session.sequence, self._context.cameras
        poses = {index: self._session.pose(sequence.frame(index, cameras=[]), self._before) for index in kept}
        return self._optimizers.make_sequence(
            sequence,
            state.pose.scene,
            frames,
            state.domain,
            cameras,
            state.settings,
            state.direction,
            state.free,
            keyframes={index: self._session.joints(pose.scene) for index, pose in poses.items()},
            ignore=lambda index: self._session.ignored(index, cameras),
        )

    def _bits(self, run: SequenceRun) -> Iterator[None]:
        dice: dict[int, float | None] = {}
        try:
            while run.step():
                self._check_calibration()
                self._report(done=run.done, text=run.status())
                yield
            for index, estimate in run.estimates().items():
                if run.cancelled:
                    break
                dice[index] = self._dice(estimate)
                self._report(text=f"Comparing with the truth, frame {len(dice)} of {run.done}")
                yield
        finally:
            # An image that is missing in the end does not cost what was solved before it.
            if self._run is run:
                self._run = None
                self._report(running=False, text="")
                self._report(text=self._save(run, dice))

    def _dice(self, estimate: FrameEstimate) -> float | None:
        state, sequence = self._context.state, self._session.sequence
        if not sequence.has_masks(state.camera, state.domain):
            return None
        frame = sequence.frame(estimate.index, state.domain, [state.camera])
        scene = self._session.with_joints(state.pose.scene, estimate.joint_positions)
        correction = self._session.editor.view.get(Key.mask_correction(estimate.index, state.camera))
        return self._context.renderer.scores(scene, frame, state.camera, correction).dice

    def _check_calibration(self) -> None:
        now = self._session.editor.view
        if now.records.get(WHOLE_PROJECT) is not self._before.records.get(WHOLE_PROJECT):
            self.drop("Stopped: the calibration was changed")
            raise CartsError(
                "The calibration was changed meanwhile, so the solved frames do not fit. Solve them again."
            )

    def _save(self, run: SequenceRun, dice: Mapping[int, float | None]) -> str:
        """Save all frames that were solved as one step, and say so."""
        self._context.save()
        edits: dict[Key[Any], Any] = {}
        figures: dict[int, Figures] = {}
        now, kept = self._session.editor.view, set(self._session.editor.view.kept_frames)
        for index, estimate in run.estimates().items():
            # What somebody has done to a frame meanwhile counts more.
            if estimate.start != "keyframe" and index not in kept and now.joints(index) == self._before.joints(index):
                edits.update(_edits(estimate, run, now.review(index)))
                figures[index] = Figures(estimate.loss, dice.get(index))
        if not figures:
            return "Stopped before a frame was solved"
        first, last = (self._session.sequence.frame_ids[index] for index in (min(figures), max(figures)))
        self._session.editor.project.apply(f"Solve {len(figures)} frames, {first} to {last}", edits, figures)
        self._context.refresh()
        return f"{'Stopped: ' if run.cancelled else ''}{len(figures)} frames solved, one step of undo"

    def _report(self, **changes: Any) -> None:
        if self._context.state.solve is not None:
            self._context.change(solve=replace(self._context.state.solve, **changes))


def _edits(estimate: FrameEstimate, run: SequenceRun, review: Review) -> Edits:
    edits: dict[Key[Any], Any] = {}
    for arm, std in estimate.joint_std.items():
        # An arm that was not free stays as it is.
        if np.isfinite(std).any():
            correction = joint_correction(estimate.joint_positions[arm], run.provenance, std)
            edits[Key.joints(estimate.index, arm)] = correction
    if review.state is ReviewState.UNTOUCHED:
        edits[Key.review(estimate.index)] = Review(ReviewState.OPTIMIZED, review.note)
    return edits
