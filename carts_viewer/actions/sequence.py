"""Sequence mode: keyframes, and solving many frames together."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from carts_core.errors import CartsError, ProjectError
from carts_core.project import Figures, Key, Keyframe, ProjectState, Source, between_kept
from carts_core.project.values import WHOLE_PROJECT
from carts_core.settings import SequenceSettings
from carts_core.settings.serialization import to_plain
from carts_core.wording import counted
from carts_viewer.actions import intents
from carts_viewer.actions.context import Context, Handler
from carts_viewer.jobs.comparison import Comparison, Outcome, Waiting, unchecked
from carts_viewer.jobs.optimizers import OptimizerFactory, SequenceRun, provenance, wait_for
from carts_viewer.jobs.solver import Estimate, SequenceStep, SequenceTask, Smoothed, Started
from carts_viewer.state import ListedFrame, SolveState


class PropagatingHandler(Handler):
    """Handler of sequence mode: solves many frames, one at a time."""

    def __init__(self, context: Context, optimizers: OptimizerFactory) -> None:
        super().__init__(context)
        self._optimizers = optimizers
        self._comparison = Comparison(context.session, context.renderer, optimizers)
        self._held: dict[int, Outcome] = {}
        """Frame -> result that fits worse than the previous pose and is not applied."""
        self.person = context.session.editor.person
        """User of the current intent; the user of the session's editor is that of the running job."""
        self._run: SequenceRun | None = None
        self._work: Iterator[Waiting] = iter(())
        self._reply: Waiting = None
        """Reply that the run waits for."""
        self._before: ProjectState = context.session.editor.view
        """The project at the start of the run."""

    def wait_time(self) -> float | None:
        """Time until the next step or reply is due [s]; None if no frames are being solved."""
        return None if self._run is None else wait_for(self._reply)

    def advance(self) -> None:
        """Continue with a reply of the solver, if frames are being solved and it has arrived.

        Raises:
            CartsError: a frame is not usable, or the frames could not be saved. Solved frames are saved if possible.
        """
        if self.wait_time() == 0.0:
            self._reply = next(self._work, None)

    def drop(self, reason: str) -> None:
        """Abort the run without saving."""
        if self._run is not None:
            self._run.steps.close()
            self._run = None
            self._report(running=False, text=reason)

    def finish(self) -> None:
        """Stop, and save the solved frames. Errors as in `advance`."""
        if self._run is not None:
            self._run.cancelled = True
            for reply in self._work:
                if reply is not None:
                    reply.wait()

    # ---- Intents ---------------------------------------------------------------------------------------------------

    def solve(self, whole: bool, at: int, part: range | None = None) -> None:
        """Start solving all frames, or those between the kept frames around the frame `at`, within `part` if given.

        Raises:
            CartsError: there is nothing to solve, or edits could not be saved.
        """
        if self._run is not None:
            raise CartsError("Frames are already being solved. Wait, or stop solving first.")
        project = self._session.editor.project
        if not project.writable:
            reason = project.read_only_reason
            raise ProjectError(f"The project cannot be changed, so solved frames could not be saved. {reason}")
        self._context.end_run("Stopped: solving was started")
        self._context.save()
        view = self._session.editor.view
        everything = range(len(self._session.sequence))
        if part is not None and (part.start not in everything or part.stop - 1 not in everything or not part):
            raise CartsError("The range lies outside of the sequence. Select another range in the timeline.")
        if part is not None and not whole and at not in part:
            raise CartsError(
                "Solving between keyframes is limited to the timeline's range, but the shown frame lies outside of it. "
                "Show a frame of the range, or remove the range (× in the timeline)."
            )
        frames = (part or everything) if whole else between_kept(view, at, part)
        kept = [frame for frame in view.kept_frames if frame in frames]
        if not (whole or kept):
            raise CartsError("There is no keyframe yet. Correct a frame by hand, accept a frame, or solve all frames.")
        if len(kept) == len(frames):
            raise CartsError("All of these frames are keyframes or accepted, so there is nothing to solve.")
        former, before, held = self._context.state.solve, self._before, self._held
        self._before = view
        self._context.change(playing=False, error=None, solve=SolveState(frames, text="Preparing"))
        self._optimizers.report("Preparing to solve")
        try:
            self._run = self._make(frames, kept)
            self._work, self._reply = self._steps(self._run), None
            self.advance()
        except Exception:
            # The list of the former run remains, so its poses can still be taken.
            self._before, self._held = before, held
            self._context.change(solve=former)
            raise

    def _on_StopSolving(self, intent: intents.StopSolving) -> None:
        self.finish()

    # ---- The run ---------------------------------------------------------------------------------------------------

    def _make(self, frames: range, kept: list[int]) -> SequenceRun:
        """A run on these frames. The free joints are those of a run on one frame; the calibration is fixed."""
        state, session, cameras = self._context.state, self._session, self._context.cameras
        sequence, before = session.sequence, self._before
        poses = {index: session.pose(sequence.frame(index, cameras=[]), before) for index in kept}
        regions = {index: session.ignore_regions(index, cameras) for index in frames}
        self._task = SequenceTask(
            sequence,
            frames,
            state.domain,
            cameras,
            state.pose.scene,
            state.settings,
            SequenceSettings(direction=state.direction),
            replace(state.free, base_frames=False, extrinsics=False, intrinsics=False),
            session.target(state.observed, before),
            {index: session.joints(pose.scene) for index, pose in poses.items()},
            {index: _standard_deviations(before, index) for index in kept},
            {index: found for index, found in regions.items() if found},
        )
        return self._optimizers.sequence(self._task)

    def _steps(self, run: SequenceRun) -> Iterator[Waiting]:
        outcomes: dict[int, Outcome] = {}
        try:
            while not isinstance(found := (yield from run.steps.next(run.cancelled or None)), Smoothed):
                self._take(run, found)
                yield None
            run.estimates = dict(found.estimates)
            for number, (index, estimate) in enumerate(run.estimates.items(), start=1):
                if run.cancelled:
                    break
                if self._solved(estimate):
                    before, state = self._before, self._context.state
                    outcomes[index] = yield from self._comparison.outcome(estimate, run, before, state)
                    self._context.change(busy=None)
                    self._check_calibration()
                self._report(compared=number, text=f"Comparing with the previous pose, frame {number} of {run.done}")
                yield None
            if outcomes and not run.cancelled:
                self._report(text="Checking the calibration")
                gain = yield from run.steps.next()
                self._report(base_frame_gain=gain, calibration=self._before.records.get(WHOLE_PROJECT))
        finally:
            run.steps.close()
            # Frames that were solved before an error, such as a missing image, are saved.
            if self._run is run:
                self._run = None
                self._report(running=False, text="")
                self._report(text=self._save(run, outcomes))

    def _take(self, run: SequenceRun, found: object) -> None:
        """Use the start or a step of the run."""
        if isinstance(found, Started):
            task = self._task
            more = {
                "model": to_plain(task.model),
                "frames": [task.frames[0], task.frames[-1]],
                "keyframes": sorted(task.keyframes),
            }
            chosen = task.cameras, task.settings, task.free, task.target
            run.provenance = provenance(found, *chosen, Source.PROPAGATED, **more)
            self._context.change(busy=None)
            self._report(text="Estimating the first frame")
        elif isinstance(found, SequenceStep):
            self._check_calibration()
            run.done = found.done
            if found.estimate is not None:
                run.estimates[found.estimate.index] = found.estimate
            self._report(done=found.done, text=found.text)

    def _solved(self, estimate: Estimate) -> bool:
        """Whether an estimate may be saved; edits of the frame since the start of the run take precedence."""
        now, index = self._session.editor.view, estimate.index
        kept = estimate.keyframe or index in now.kept_frames
        return not kept and now.joints(index) == self._before.joints(index)

    def _check_calibration(self) -> None:
        if not self._session.editor.view.same_calibration(self._before):
            self.drop("Stopped: the calibration was changed")
            raise CartsError(
                "The calibration was changed in the meantime, so the solved frames are outdated. Solve them again."
            )

    def _save(self, run: SequenceRun, outcomes: Mapping[int, Outcome]) -> str:
        """Save the frames that fit no worse than before as one step; returns a summary for the user."""
        self._context.save()
        edits: dict[Key[Any], Any] = {}
        figures: dict[int, Figures] = {}
        listed: list[ListedFrame] = []
        self._held = {}
        for index, estimate in run.estimates.items():
            if not self._solved(estimate):
                continue
            outcome = outcomes.get(index) or unchecked(estimate, run)
            if outcome.worse:
                self._held[index] = outcome
            else:
                edits.update(outcome.edits)
                figures[index] = outcome.figures
            if outcome.remark is not None:
                listed.append(ListedFrame(index, outcome.remark, not outcome.worse))
        self._report(listed=tuple(sorted(listed, key=lambda frame: frame.index)))
        count = len(figures) + len(self._held)
        if not count:
            return "Stopped before the first frame was solved"
        if figures:
            first, last = (self._session.sequence.frame_ids[index] for index in (min(figures), max(figures)))
            self._session.editor.apply(f"Solve {counted(len(figures), 'frame')}, {first} to {last}", edits, figures)
            self._context.refresh()
        solved = f"{counted(len(figures), 'frame')} solved, one undo step"
        text = f"{'Stopped: ' if run.cancelled else ''}{solved}"
        return f"{text}; {len(self._held)} unchanged, because they would fit worse" if self._held else text

    def _on_TakeSolved(self, intent: intents.TakeSolved) -> None:
        now = self._session.editor.view
        taken = {i: outcome for i, outcome in self._held.items() if intent.index is None or i == intent.index}
        taken = {i: outcome for i, outcome in taken.items() if now.joints(i) == self._before.joints(i)}
        if not taken:
            raise CartsError("There is no solved pose to take: the frame was changed since, or the list was closed.")
        self._context.end_run("Stopped: solved poses were taken")
        self._context.save()
        edits: dict[Key[Any], Any] = {}
        for outcome in taken.values():
            edits.update(outcome.edits)
        figures = {index: outcome.figures for index, outcome in taken.items()}
        if not now.same_calibration(self._before):
            # Verdicts and figures refer to the earlier calibration.
            edits, figures = {**edits, **{Key.verdict(index): None for index in taken}}, {}
        people, name = self._session.editor.people, f"Take {counted(len(taken), 'solved pose')}"
        people.apply(self.person, name, edits, figures)
        self._held = {index: outcome for index, outcome in self._held.items() if index not in taken}
        listed = self._context.state.solve.listed if self._context.state.solve else ()
        self._report(listed=tuple(replace(f, taken=f.taken or f.index in taken) for f in listed))
        self._context.refresh()

    def _on_DiscardSolved(self, intent: intents.DiscardSolved) -> None:
        self._held = {}
        self._report(listed=())

    def _report(self, **changes: Any) -> None:
        if self._context.state.solve is not None:
            self._context.change(solve=replace(self._context.state.solve, **changes))


def _standard_deviations(project: ProjectState, index: int) -> dict[str, np.ndarray]:
    """Arm -> standard deviations of a kept frame's joint positions [rad, m], for arms whose correction has them."""
    known = {arm: value.standard_deviations for arm, value in project.joints(index).items()}
    return {arm: np.array(values, np.float64) for arm, values in known.items() if values is not None}


class KeyframeHandler(Handler):
    """Handler of keyframes and of the direction of solving."""

    def _on_SetKeyframe(self, intent: intents.SetKeyframe) -> None:
        state = self._context.state
        on = not state.project.is_keyframe(state.index) if intent.on is None else bool(intent.on)
        self._context.end_run("Stopped: the frame was marked")
        name = "Make a keyframe" if on else "Unmark the keyframe"
        self._context.edit(name, {Key.keyframe(state.index): Keyframe(on)})

    def _on_SetDirection(self, intent: intents.SetDirection) -> None:
        if intent.direction not in ("forward", "backward"):
            raise CartsError(f"Unknown direction {intent.direction!r}.")
        self._context.change(direction=intent.direction)
