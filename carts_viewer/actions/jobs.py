"""Handler of the job queue; jobs run one at a time."""

import time
from collections.abc import Generator
from dataclasses import asdict, dataclass, replace
from typing import Any

import msgspec

from carts_core.errors import CartsError
from carts_core.project import frames_in
from carts_core.project.state import UNREVIEWED
from carts_viewer.actions import intents
from carts_viewer.actions.context import Context, Handler, one_of
from carts_viewer.actions.frame_filter import matching_frames
from carts_viewer.actions.import_export import ExportingHandler
from carts_viewer.actions.sequence import PropagatingHandler
from carts_viewer.editing import Person
from carts_viewer.jobs.choices import Choices
from carts_viewer.jobs.companions import Decisions
from carts_viewer.jobs.comparison import Comparison, Waiting
from carts_viewer.jobs.job_list import (
    AdaptOptions,
    CalibrateOptions,
    ExportOptions,
    Job,
    JobList,
    JobState,
    OptimizeOptions,
    Options,
    SolveOptions,
)
from carts_viewer.jobs.networks import Networks
from carts_viewer.jobs.optimizers import REPLY_WAIT, OptimizerFactory, wait_for
from carts_viewer.jobs.work import Progress, adapt, calibrate, optimize_frames
from carts_viewer.state import ViewState

_END = Progress(0, 0, "")
"""End of a job's steps."""
_SAVE_INTERVAL = 5.0
"""Interval between saves of a job's progress [s]."""


@dataclass(frozen=True, eq=False)
class JobRequester:
    """User who requested a job, and the state of their tab at that time."""

    person: Person
    state: ViewState

    def choose(self, context: Context) -> None:
        """Set the user and the shown frame of a job in its context."""
        context.session.editor.person = self.person
        context.change(index=self.state.index, frame=self.state.frame, pose=self.state.pose)


class JobsHandler(Handler):
    """Queues, starts, monitors and stops jobs."""

    def __init__(
        self,
        context: Context,
        optimizers: OptimizerFactory,
        propagating: PropagatingHandler,
        exporting: ExportingHandler,
    ) -> None:
        super().__init__(context)
        self._optimizers = optimizers
        self._propagating, self._exporting = propagating, exporting
        self._comparison = Comparison(context.session, context.renderer, optimizers)
        project = context.session.editor.project
        decisions, identity = Decisions(), project.state.identity
        self._list = JobList(
            project.path,
            kept=project.writable,
            frame_ids=identity.frame_ids,
            recording=identity.kinematics_sha256,
            decisions=decisions,
        )
        self._defaults = context.state.choices
        """Choices of jobs without any, which an earlier version has stored."""
        self._requester: JobRequester | None = None
        """User whose request is being carried out."""
        self._asked: dict[int, JobRequester] = {}
        """Requesters by job number; jobs from before the viewer started have none."""
        self._work: Generator[Progress | Waiting] | None = None
        self._reply: Waiting = None
        """Reply that the job waits for."""
        self._wait = 0.0
        self._saved_at = 0.0
        self._networks = Networks(project.path, kept=project.writable, optimizers=optimizers, decisions=decisions)
        self._publish()

    def ask(self, intent: intents.Intent, requester: JobRequester) -> None:
        """Carry out an intent with the state of the requester's tab; errors are those of `handle`."""
        self._requester = requester
        self.handle(intent)

    def wait_time(self) -> float | None:
        """Time until the next step is due [s]; None if no job is active."""
        running = self._running()
        if running is not None and running.kind in ("solve", "export"):
            return REPLY_WAIT  # Their own handlers say when work is due.
        active = running is not None or any(job.state is JobState.WAITING for job in self._list.jobs)
        return max(self._wait, wait_for(self._reply)) if active else None

    # ---- Intents ---------------------------------------------------------------------------------------------------

    def _on_Solve(self, intent: intents.Solve) -> None:
        state = self._tab
        self._queue("solve", {**msgspec.structs.asdict(intent), "at": state.index, "range": state.range})

    def _on_Export(self, intent: intents.Export) -> None:
        self._queue("export", msgspec.structs.asdict(intent))

    def _on_OptimizeFrames(self, intent: intents.OptimizeFrames) -> None:
        self._queue("optimize", {"frames": self._frames(intent.frames)})

    def _on_Calibrate(self, intent: intents.Calibrate) -> None:
        self._queue("calibrate", msgspec.structs.asdict(intent))

    def _on_Adapt(self, intent: intents.Adapt) -> None:
        if not self._context.session.editor.project.writable:
            raise CartsError("The project is read-only, so adapted networks cannot be stored beside it.")
        self._queue("adapt", {**msgspec.structs.asdict(intent), "folder": self._networks.next_number()})

    def _on_UseNetwork(self, intent: intents.UseNetwork) -> None:
        self._networks.use(intent.name)
        self._publish()

    def _on_AnswerNetwork(self, intent: intents.AnswerNetwork) -> None:
        try:
            self._networks.answer(intent.accepted)
        finally:
            self._publish()

    def _on_AnswerJobs(self, intent: intents.AnswerJobs) -> None:
        for job in self._list.jobs:
            if job.state is JobState.ASKED and intent.accepted:
                self._list.accept(job.number, self._safe_options(job))
                if self._requester is not None:
                    self._asked[job.number] = self._requester
            elif job.state is JobState.ASKED:
                self._end(job, JobState.CANCELLED, "Discarded before the start.")
        self._publish()

    def _on_CancelJob(self, intent: intents.CancelJob) -> None:
        job = self._list.find(intent.number)
        if job.state is JobState.RUNNING:
            self._stop(job)
        if not job.over:
            self._end(job, JobState.CANCELLED, "Cancelled; saved results are kept.")

    def _on_RepeatJob(self, intent: intents.RepeatJob) -> None:
        job = self._list.find(intent.number)
        if not job.over:
            raise CartsError("This job has not ended yet.")
        options = self._safe_options(job)
        if isinstance(options, OptimizeOptions):
            options = replace(options, first=job.done if job.state is not JobState.DONE else 0)
        self._queue(job.kind, asdict(options), job.choices)

    def _on_RemoveEndedJobs(self, intent: intents.RemoveEndedJobs) -> None:
        self._list.forget()
        self._publish()

    # ---- The queue -------------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Start the next job or continue the running one.

        Raises:
            CartsError: the job failed and is marked as failed; the next job is started by a later call.
        """
        job = self._running()
        if job is None:
            job = next((job for job in self._list.jobs if job.state is JobState.WAITING), None)
            if job is None:
                return
            self._begin(job)
        else:
            self._follow(job)

    def settle(self) -> None:
        """End a running job whose work was stopped by an intent, such as `StopSolving`."""
        job = self._running()
        if job is not None and job.kind in ("solve", "export"):
            self._follow(job)

    def fail(self, text: str) -> None:
        """Mark the running job, if any, as failed."""
        job = self._running()
        if job is not None:
            self._end(job, JobState.FAILED, text)

    def close(self) -> None:
        """Save the progress of all jobs and end the training process."""
        if self._work is not None:
            self._work.close()
        self._list.save()

    def _queue(self, kind: str, values: dict[str, Any], choices: Choices | None = None) -> None:
        """Queue a job, by default with the choices of the requester's tab."""
        job = self._list.add(kind, values, choices or self._tab.choices)
        if self._requester is not None:
            self._asked[job.number] = self._requester
        if self._running() is None and not any(j.state is JobState.WAITING and j is not job for j in self._list.jobs):
            # The job is started immediately, so that errors of the request are shown to the user.
            self._begin(job)
        self._publish()

    def _safe_options(self, job: Job) -> Options:
        """Options to repeat a job; training is resumed only in an unfinished folder of this user."""
        own = self._list.is_own(job) and job.state is not JobState.DONE
        if isinstance(job.options, AdaptOptions) and not own:
            return replace(job.options, folder=self._networks.next_number())
        return job.options

    def _begin(self, job: Job) -> None:
        self._list.change(job.number, "begun", state=JobState.RUNNING, began=time.time())
        requester = self._asked.pop(job.number, None)
        if requester is not None:
            requester.choose(self._context)
        try:
            self._choose(job.choices or self._defaults)
            # The project, such as its calibration, may have changed since the job was queued.
            self._context.refresh()
            match job.options:
                case SolveOptions() as options:
                    self._propagating.solve(options.whole, options.at, job.frames)
                case ExportOptions() as options:
                    self._exporting.handle(intents.Export(**asdict(options)))
                case _:
                    self._context.end_run("Stopped: a job was started")
                    self._work = self._own(job.options)
        except Exception as error:
            self._end(job, JobState.FAILED, str(error))
            raise
        self._publish()

    def _choose(self, choices: Choices) -> None:
        """Set the choices of a job in its context.

        Raises:
            CartsError: the recording does not have the domain or the camera.
        """
        sequence = self._context.session.sequence
        one_of(choices.domain, "", sequence.domains, "domain")
        one_of(choices.camera, "", [camera.name for camera in sequence.scene.cameras], "camera")
        self._context.change(**vars(choices))

    def _own(self, options: OptimizeOptions | CalibrateOptions | AdaptOptions) -> Generator[Progress | Waiting]:
        match options:
            case OptimizeOptions():
                return optimize_frames(self._context, self._comparison, options.frames, options.first)
            case CalibrateOptions():
                return calibrate(self._context, self._optimizers, options.frames)
            case AdaptOptions():
                folder = self._networks.folder(options.folder)
                return adapt(self._context.session.sequence.path, folder, options.minutes)

    def _follow(self, job: Job) -> None:
        state = self._context.state
        if job.kind == "solve":
            solve = state.solve
            if solve is None or not solve.running:
                self._end(job, JobState.DONE, solve.text if solve else "")
            else:
                self._report(job, Progress(solve.progress[0] // 2, len(solve.frames), solve.text))
        elif job.kind == "export":
            export = state.export
            if export is None:
                self._end(job, JobState.CANCELLED, "Cancelled; its files were removed.")
            elif export.path is not None:
                self._end(job, JobState.DONE, f"{export.frames} frames in {export.path}")
            else:
                self._report(job, Progress(export.done, export.total, export.format))
        else:
            self._step(job)

    def _step(self, job: Job) -> None:
        if wait_for(self._reply) > 0.0:
            return
        self._reply = None
        try:
            step = _END if self._work is None else next(self._work, _END)
        except Exception as error:
            self._work = None
            self._end(job, JobState.FAILED, str(error))
            raise
        if step is _END:
            self._work = None
            self._end(job, JobState.DONE, self._list.find(job.number).text)
        elif isinstance(step, Progress):
            self._report(job, step)
        else:
            self._reply = step

    def _report(self, job: Job, progress: Progress) -> None:
        now, self._wait = self._list.find(job.number), progress.wait
        if (now.done, now.total, now.text) == (progress.done, progress.total, progress.text) and progress.line is None:
            return
        self._list.change(job.number, progress.line, done=progress.done, total=progress.total, text=progress.text)
        if time.monotonic() - self._saved_at > _SAVE_INTERVAL:
            self._saved_at = time.monotonic()
            self._list.save()
        self._publish()

    def _stop(self, job: Job) -> None:
        if job.kind == "solve":
            self._propagating.finish()
        elif job.kind == "export":
            self._exporting.cancel()
        if self._work is not None:
            self._work.close()
        self._work = self._reply = None

    def _end(self, job: Job, state: JobState, text: str) -> None:
        self._wait = 0.0
        self._asked.pop(job.number, None)
        self._networks.update_names()
        if isinstance(job.options, AdaptOptions) and job.state is JobState.RUNNING:
            self._networks.trained(job.options.folder)
        done = {"done": job.total} if state is JobState.DONE and job.total else {}
        self._list.change(job.number, f"{state}: {text}", state=state, text=text, ended=time.time(), **done)
        self._context.change(busy=None)
        self._publish()

    def _running(self) -> Job | None:
        return next((job for job in self._list.jobs if job.state is JobState.RUNNING), None)

    def _frames(self, which: str) -> list[int]:
        view = self._context.session.editor.view
        if which == "found":
            frames = matching_frames(view, self._tab.filter)
        elif which == "range":
            first, last = self._tab.range or (0, len(self._context.session.sequence) - 1)
            frames = list(range(first, last + 1))
        elif which == "all":
            frames = list(range(len(self._context.session.sequence)))
        else:
            frames = frames_in(view, UNREVIEWED)
        if not frames:
            raise CartsError("No frame matches this choice. Choose other frames.")
        return frames

    @property
    def _tab(self) -> ViewState:
        return self._context.state if self._requester is None else self._requester.state

    def _publish(self) -> None:
        networks = self._networks
        self._context.change(
            jobs=self._list.jobs,
            networks=networks.names,
            network=networks.used,
            asked_network=networks.asked,
            problems=tuple(filter(None, (self._list.problem, self._list.unsaved, networks.problem))),
        )
