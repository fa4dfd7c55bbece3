"""Dispatches intents to handlers and advances long work: a controller per tab, one job runner for all tabs.

Used on the worker's thread only; does not depend on widgets.
"""

import time
from contextlib import suppress

from carts_core.errors import CartsError
from carts_viewer.actions import intents
from carts_viewer.actions.browsing import BrowsingHandler
from carts_viewer.actions.context import Context, Handler
from carts_viewer.actions.import_export import Deliver, ExportingHandler, TransferHandler, shown_mask
from carts_viewer.actions.jobs import JobRequester, JobsHandler
from carts_viewer.actions.live import LiveHandler
from carts_viewer.actions.optimizing import OptimizingHandler
from carts_viewer.actions.painting import PaintingHandler
from carts_viewer.actions.posing import DraggingHandler, PosingHandler
from carts_viewer.actions.reviewing import AnnotatingHandler, FilterHandler
from carts_viewer.actions.sequence import KeyframeHandler, PropagatingHandler
from carts_viewer.actions.shortcuts import checked_keys
from carts_viewer.editing import MAX_NAME_LENGTH, Person
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.session import Session
from carts_viewer.state import ViewState


class JobRunner:
    """Works on jobs step by step, independently of the tabs that requested them."""

    def __init__(
        self,
        state: ViewState,
        session: Session,
        renderer: OverlayRenderer,
        optimizers: OptimizerFactory,
    ) -> None:
        self._context = context = Context(state, session, renderer)
        self._propagating = PropagatingHandler(context, optimizers)
        self._exporting = ExportingHandler(context, optimizers)
        self._jobs = JobsHandler(context, optimizers, self._propagating, self._exporting)

    @property
    def state(self) -> ViewState:
        """State of the jobs; tabs share the fields in `_COMMON`."""
        return self._context.state

    def takes(self, intent: intents.Intent) -> bool:
        """Whether the job runner handles an intent."""
        return any(handler.takes(intent) for handler in (self._jobs, self._propagating, self._exporting))

    def handle(self, intent: intents.Intent, person: Person, state: ViewState) -> None:
        """Carry out an intent of a user, with the state of their tab.

        Raises:
            CartsError: the intent cannot be carried out.
        """
        self._context.refresh()
        # Long work is queued; other work is done immediately.
        if self._jobs.takes(intent):
            self._jobs.ask(intent, JobRequester(person, state))
        else:
            self._propagating.person = person
            (self._exporting if self._exporting.takes(intent) else self._propagating).handle(intent)
        self._jobs.settle()

    def wait_time(self) -> float | None:
        """Time until work is due without a request [s]; None if no work is due."""
        handlers = (self._propagating, self._exporting, self._jobs)
        return min((wait for handler in handlers if (wait := handler.wait_time()) is not None), default=None)

    def advance(self) -> None:
        """Do one step of the running work: a frame to solve or export, a step of a job.

        Raises:
            CartsError: the step failed; its job is marked as failed.
        """
        try:
            self._propagating.advance()
            self._exporting.advance()
        except Exception as error:
            self._jobs.fail(str(error))
            raise
        self._jobs.advance()

    def fail(self, text: str) -> None:
        """Stop the running work after an error."""
        # Solved frames are saved after an error of other work; after its own errors, the solver has saved them.
        with suppress(CartsError):
            self._propagating.finish()
        self._exporting.cancel()
        self._jobs.fail(text)

    def close(self) -> None:
        """Finish and save the running work; exports are cancelled.

        Raises:
            CartsError: the work could not be saved.
        """
        self._exporting.cancel()
        self._propagating.finish()
        self._jobs.close()
        self._context.save()


_ENDS_RUN = (
    intents.Solve,
    intents.TakeSolved,
    intents.Export,
    intents.OptimizeFrames,
    intents.Calibrate,
    intents.RepeatJob,
)
"""Intents that first end the run of their tab."""
_COMMON = ("jobs", "solve", "export", "networks", "network", "asked_network", "problems")
"""Fields of the job runner's state that all tabs share."""
WATCH_INTERVAL = 1.0
"""Interval between checks of the project file [s]."""


class Controller(Handler):
    """Holds the state and changes it: immediately in `handle`, step by step in `advance`."""

    def __init__(
        self,
        state: ViewState,
        session: Session,
        renderer: OverlayRenderer,
        optimizers: OptimizerFactory,
        job_runner: JobRunner,
        deliver: Deliver,
    ) -> None:
        context = Context(state, session, renderer)
        self._optimizing = OptimizingHandler(context, optimizers)
        super().__init__(context)
        self._job_runner = job_runner
        self._editor = session.editor
        self._watch_at = 0.0
        self._storage_failure: str | None = None
        self._browsing = BrowsingHandler(context)
        self._live = LiveHandler(context, optimizers, self._browsing.show)
        self._painting = PaintingHandler(context, optimizers.segment)
        self._transfers = TransferHandler(context, deliver)
        self._annotating = AnnotatingHandler(context, self._browsing.show)
        self._handlers = (
            self._browsing,
            self._optimizing,
            self._annotating,
            self._live,
            DraggingHandler(context),
            PosingHandler(context),
            KeyframeHandler(context),
            self._painting,
            self._transfers,
            FilterHandler(context, self._browsing.show),
        )
        self._deliver = deliver
        self._share()

    @property
    def state(self) -> ViewState:
        """State of the tab."""
        return self._context.state

    def handle(self, intent: intents.Intent) -> None:
        """Carry out an intent.

        Raises:
            CartsError: the intent cannot be carried out; the state stays valid.
        """
        try:
            if self._live.replaces(intent):
                return
        except CartsError:
            if isinstance(intent, intents.Paint):
                self._painting.answer(intent)
            raise
        if self._job_runner.takes(intent):
            self._forward(intent)
            return
        next((handler for handler in self._handlers if handler.takes(intent)), super()).handle(intent)

    def _forward(self, intent: intents.Intent) -> None:
        """Pass an intent to the job runner, after saving the edits of this tab."""
        if isinstance(intent, _ENDS_RUN):
            self._optimizing.end("Stopped: a job was started")
            self._context.save()
            self._context.change(playing=False, error=None)
        try:
            self._job_runner.handle(intent, self._editor.person, self.state)
        finally:
            self.follow()

    def follow(self) -> None:
        """Update the state from the job runner and from edits of other users."""
        state, shared = self.state, self._job_runner.state
        if any(getattr(shared, name) != getattr(state, name) for name in _COMMON):
            self._share()
        people, person = self._editor.people, self._editor.person
        others = tuple((one.name, one.index) for one in people.persons if one is not person and one.present)
        if others != state.others:
            self._context.change(others=others)
        person.index = state.index
        possible = self._editor.can_undo, self._editor.can_redo
        changed = self._editor.view is not state.project or possible != (state.can_undo, state.can_redo)
        if changed and not self._live.active:
            self._context.refresh()

    def _share(self) -> None:
        """Copy the shared fields of the job runner's state."""
        self._context.change(**{name: getattr(self._job_runner.state, name) for name in _COMMON})

    def _on_SetName(self, intent: intents.SetName) -> None:
        chosen = " ".join(intent.name.split())[:MAX_NAME_LENGTH]
        self._editor.person.chosen = chosen
        self._context.change(name=chosen)

    def _on_SetKeys(self, intent: intents.SetKeys) -> None:
        self._context.change(keys=checked_keys(intent.keys))

    def _on_Refresh(self, intent: intents.Refresh) -> None:
        self._context.change()

    def _on_Drawn(self, intent: intents.Drawn) -> None:
        """No change: the intent wakes the worker, which may send the next overlay."""

    def _on_DismissError(self, intent: intents.DismissError) -> None:
        self._context.change(error=None)

    def _on_ExportMask(self, intent: intents.ExportMask) -> None:
        self._deliver(intent.client_id, *shown_mask(self._context))

    def wait_time(self) -> float | None:
        """Time until work is due without a request [s]; None if no work is due."""
        # Imports are applied after the end of a stream.
        last = self._live if self._live.active else self._transfers
        handlers = (self._optimizing, self._painting, self._browsing, last)
        return min((wait for handler in handlers if (wait := handler.wait_time()) is not None), default=None)

    def overdue_in(self) -> float | None:
        """Time until `advance` has to save an unfinished gesture or check the project file [s]; None if read-only."""
        if not self._editor.project.writable:
            return None
        watch = max(0.0, self._watch_at - time.monotonic())
        draft = None if self._optimizing.computing else self._editor.overdue_in()
        return watch if draft is None else min(draft, watch)

    def advance(self) -> None:
        """Do one step of the running work: an iteration, or the next frame of playback."""
        self._optimizing.advance()
        self._painting.advance()
        self._browsing.advance()
        self._live.advance()
        if not self._live.active:
            self._transfers.advance()
        if not self._optimizing.computing and self._editor.overdue_in() == 0.0:
            self._context.save()
        self._watch()

    def _watch(self) -> None:
        """Check regularly that the project file still exists, since it may be deleted between edits."""
        project = self._editor.project
        if project.writable and time.monotonic() >= self._watch_at:
            self._watch_at = time.monotonic() + WATCH_INTERVAL
            with suppress(CartsError):
                project.check()
        if project.storage_failure != self._storage_failure:
            self._storage_failure = project.storage_failure
            self._context.change(error=self._storage_failure)

    def fail(self, error: Exception, *, stop: bool) -> None:
        """Show an error to the user; with `stop`, also stop the work that caused it."""
        text = str(error) if isinstance(error, CartsError) else f"{type(error).__name__}: {error}"
        self._context.change(error=text, busy=None)
        if stop:
            self._optimizing.end("Stopped by an error", save=False)
            self._context.change(playing=False)

    def leave(self) -> None:
        """End the run and the stream of a closed tab, and save the pose of the run. Errors as in `close`."""
        if self._optimizing.active:
            self._optimizing.end("Stopped: its tab was closed; Run starts from the current pose")
        self._live.end_soon()

    def close(self) -> None:
        """End the stream and save the unfinished gesture.

        Raises:
            CartsError: the stream or the gesture could not be saved.
        """
        self._transfers.cancel()
        self._live.stop("Stopped.")
        self._context.save()

    def say(self, text: str | None) -> None:
        """Show a text about the current preparation; None removes it."""
        self._share()
        self._context.change(busy=text)

    def score(self) -> None:
        """Compare the pose with ground truth, unless already done; errors are those of `handle`."""
        self._context.score()

    def map(self) -> None:
        """Request maps or refined masks of the chosen layer, except during a stream; errors are those of `handle`."""
        if not self._live.active:
            self._optimizing.map()

    def _on_Released(self, intent: intents.Released) -> None:
        self._annotating.released()
        if self._context.state.time_error is not None:
            # The value is final once the field is left.
            self._context.change(error=self._context.state.time_error, time_error=None)
        # A run is not a gesture, so releasing a control does not end it.
        if not self._optimizing.active:
            self._context.save()
