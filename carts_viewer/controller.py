"""Dispatches intents to handlers and advances what takes long: one controller a tab, one background for all tabs.

Runs on the worker's thread alone; independent of threads and widgets.
"""

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from carts_core.errors import CartsError
from carts_viewer.actions import intents
from carts_viewer.actions.browsing import BrowsingHandler
from carts_viewer.actions.context import Context, unknown
from carts_viewer.actions.exchange import Deliver, ExportingHandler, ImportingHandler, shown_mask
from carts_viewer.actions.jobs import Asker, JobsHandler
from carts_viewer.actions.live import LiveHandler
from carts_viewer.actions.optimizing import OptimizingHandler
from carts_viewer.actions.painting import PaintingHandler
from carts_viewer.actions.posing import DraggingHandler, PosingHandler
from carts_viewer.actions.reviewing import AnnotatingHandler, FindingHandler
from carts_viewer.actions.sequence import MarkingHandler, PropagatingHandler
from carts_viewer.editing import LONGEST_NAME, Person
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.session import Session
from carts_viewer.state import ViewState


class NoRun:
    """In the background, no run of a shown frame is open."""

    def end(self, reason: str | None) -> None:
        """There is none."""

    def forget(self) -> None:
        """There is none."""


class Background:
    """Works on jobs bit by bit, whoever has asked for them and whether or not they are still there."""

    def __init__(
        self,
        state: ViewState,
        session: Session,
        renderer: OverlayRenderer,
        optimizers: OptimizerFactory,
        deliver: Deliver,
    ) -> None:
        """
        Args:
            state: with what jobs of an earlier viewer are done.
            session: the recording and its project, for nobody else.
            renderer: renders poses.
            optimizers: makes optimizers.
            deliver: sends a file to a tab.
        """
        self._context = context = Context(state, session, renderer)
        self._propagating = PropagatingHandler(context, NoRun(), optimizers)
        self._exporting = ExportingHandler(context, NoRun(), deliver)
        self._jobs = JobsHandler(context, NoRun(), optimizers, self._propagating, self._exporting)
        # What takes long is queued; the rest of its kind is done at once.
        self._kinds: dict[type[intents.Intent], Callable[[Any, Asker], None]] = {
            intents.Solve: self._jobs.ask,
            intents.Export: self._jobs.ask,
            intents.Jobs: self._jobs.ask,
            intents.Propagating: lambda intent, _: self._propagating.handle(intent),
            intents.Exporting: lambda intent, _: self._exporting.handle(intent),
        }

    @property
    def state(self) -> ViewState:
        """Of which `jobs`, `solve` and `export` are for everybody."""
        return self._context.state

    def takes(self, intent: intents.Intent) -> bool:
        """Whether an intent is one for the background."""
        return isinstance(intent, tuple(self._kinds))

    def handle(self, intent: intents.Intent, person: Person, state: ViewState) -> None:
        """Do what somebody's intent asks for.

        Args:
            intent: what.
            person: who.
            state: what they see and have chosen.

        Raises:
            CartsError: with a text for people.
        """
        self._context.refresh()
        handle = next((handle for kind, handle in self._kinds.items() if isinstance(intent, kind)), None)
        if handle is None:
            raise unknown(intent)
        handle(intent, Asker(person, state))
        self._jobs.settle()

    def wait_time(self) -> float | None:
        """How long nothing needs to be done unless somebody asks [s]; None for ever."""
        handlers = (self._propagating, self._exporting, self._jobs)
        return min((wait for handler in handlers if (wait := handler.wait_time()) is not None), default=None)

    def advance(self) -> None:
        """Do one bit of what is going on: a frame to be solved or exported, a step of a job.

        Raises:
            CartsError: it failed, and so did its job.
        """
        try:
            self._propagating.advance()
            self._exporting.advance()
        except Exception as error:
            self._jobs.fail(str(error))
            raise
        self._jobs.advance()

    def fail(self, text: str) -> None:
        """Stop whatever is going on, because of an error of it."""
        # What is solved is not lost to an error of something else; its own errors have saved it already.
        with suppress(CartsError):
            self._propagating.finish()
        self._exporting.cancel()
        self._jobs.fail(text)

    def close(self) -> None:
        """Save what is under way; exports are abandoned.

        Raises:
            CartsError: it could not be saved.
        """
        self._exporting.cancel()
        self._propagating.finish()
        self._jobs.close()
        self._context.save()


_BEGINNING = (
    intents.Solve,
    intents.TakeSolved,
    intents.Export,
    intents.OptimizeFrames,
    intents.Calibrate,
    intents.RepeatJob,
)
"""What ends a run here before it begins."""
_COMMON = ("jobs", "solve", "export", "networks", "network", "asked_network", "problems")
"""What of the background's state is for everybody."""
WATCH_EVERY = 1.0
"""How often the project's file is checked while nothing is edited [s]."""


class Controller:
    """Holds the state and changes it: at once in `handle`, bit by bit in `advance`."""

    def __init__(
        self,
        state: ViewState,
        session: Session,
        renderer: OverlayRenderer,
        optimizers: OptimizerFactory,
        background: Background,
        deliver: Deliver,
    ) -> None:
        """
        Args:
            state: what the page shows first.
            session: the recording and its project.
            renderer: renders poses.
            optimizers: makes optimizers.
            background: takes what takes long.
            deliver: sends a file to a tab.
        """
        self._context = context = Context(state, session, renderer)
        self._background = background
        self._editor = session.editor
        self._watch_at = 0.0
        self._incident: str | None = None
        self._optimizing = run = OptimizingHandler(context, optimizers)
        self._browsing = BrowsingHandler(context, run)
        self._live = LiveHandler(context, run, optimizers, self._browsing.show)
        self._annotating = AnnotatingHandler(context, run, self._browsing.show)
        self._handlers: dict[type[intents.Intent], Callable[[Any], None]] = {
            intents.Browsing: self._browsing.handle,
            intents.DragLink: DraggingHandler(context, run).handle,
            intents.Posing: PosingHandler(context, run).handle,
            intents.Optimizing: self._optimizing.handle,
            intents.Annotation: self._annotating.handle,
            intents.Marking: MarkingHandler(context, run).handle,
            intents.ExportMask: lambda intent: deliver(intent.client_id, *shown_mask(context)),
            intents.Painting: PaintingHandler(context, run, optimizers.segmenter).handle,
            intents.ImportMasks: ImportingHandler(context, run).handle,
            intents.Live: self._live.handle,
            intents.Finding: FindingHandler(context, run, self._browsing.show).handle,
            intents.Refresh: lambda _: context.change(),
            # Nothing to do: it has woken the worker, which now may send the next overlay.
            intents.Drawn: lambda _: None,
            intents.Released: lambda _: self._released(),
            intents.SetName: lambda intent: self._name(intent.name),
            intents.DismissError: lambda _: context.change(error=None),
        }
        self._share()

    @property
    def state(self) -> ViewState:
        """What the page shows."""
        return self._context.state

    def handle(self, intent: intents.Intent) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        if self._live.takes(intent):
            return
        if self._background.takes(intent):
            self._hand_on(intent)
            return
        handle = next((handle for kind, handle in self._handlers.items() if isinstance(intent, kind)), None)
        if handle is None:
            raise unknown(intent)
        handle(intent)

    def _hand_on(self, intent: intents.Intent) -> None:
        """Have the background do something, with what is saved here and chosen here."""
        if isinstance(intent, _BEGINNING):
            self._optimizing.end("Stopped: a job was started")
            self._context.save()
            self._context.change(playing=False, error=None)
        try:
            self._background.handle(intent, self._editor.person, self.state)
        finally:
            self.follow()

    def follow(self) -> None:
        """Bring the state up to date with what others, and the background, have done."""
        state, shared = self.state, self._background.state
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
        """Take over what the background's state has for everybody."""
        self._context.change(**{name: getattr(self._background.state, name) for name in _COMMON})

    def _name(self, name: str) -> None:
        chosen = " ".join(name.split())[:LONGEST_NAME]
        self._editor.person.chosen = chosen
        self._context.change(name=chosen)

    def wait_time(self) -> float | None:
        """How long nothing needs to be done unless somebody asks [s]; None for ever."""
        handlers = (self._optimizing, self._browsing, self._live)
        return min((wait for handler in handlers if (wait := handler.wait_time()) is not None), default=None)

    def overdue_in(self) -> float | None:
        """How long until `advance` has to save a gesture that nobody has ended, or check the file [s].

        None: for ever.
        """
        if not self._editor.project.writable:
            return None
        watch = max(0.0, self._watch_at - time.monotonic())
        draft = self._editor.overdue_in()
        return watch if draft is None else min(draft, watch)

    def advance(self) -> None:
        """Do one bit of what is going on: an iteration, the next frame of playing."""
        self._optimizing.advance()
        self._browsing.advance()
        self._live.advance()
        if self._editor.overdue_in() == 0.0:
            self._context.save()
        self._watch()

    def _watch(self) -> None:
        """Check now and then that the project's file still exists: it may be deleted while nobody edits."""
        project = self._editor.project
        if project.writable and time.monotonic() >= self._watch_at:
            self._watch_at = time.monotonic() + WATCH_EVERY
            with suppress(CartsError):
                project.check()
        if project.incident != self._incident:
            self._incident = project.incident
            self._context.change(error=self._incident)

    def fail(self, error: Exception, *, stop: bool) -> None:
        """Show an error to the user.

        Args:
            error: What happened.
            stop: Stop whatever is going on; for errors of what is going on itself.
        """
        text = str(error) if isinstance(error, CartsError) else f"{type(error).__name__}: {error}"
        self._context.change(error=text, busy=None)
        if stop:
            self._optimizing.end("Stopped by an error", save=False)
            self._context.change(playing=False)

    def leave(self) -> None:
        """End the run, as nobody sees it any more; where it is, is saved. Errors as `close`."""
        if self._optimizing.active:
            self._optimizing.end("Stopped: its tab was closed; Run starts anew from here")

    def close(self) -> None:
        """Save what is under way.

        Raises:
            CartsError: it could not be saved.
        """
        self._live.stop("Stopped.")
        self._context.save()

    def say(self, text: str | None) -> None:
        """Show the user what is being prepared, and what the background has begun; None when nothing is."""
        self._share()
        self._context.change(busy=text)

    def score(self) -> None:
        """Compare the pose with the truth, if that was not done yet; errors as `handle`."""
        self._context.score()

    def map(self) -> None:
        """Compute what the chosen layer shows beyond the pose; errors as `handle`."""
        if not self._live.active:
            self._optimizing.map()

    def _released(self) -> None:
        self._annotating.released()
        if self._context.state.time_error is not None:
            # Whoever leaves the field means what is in it.
            self._context.change(error=self._context.state.time_error, time_error=None)
        # A run is no gesture of a hand, so nobody's letting go of something ends it.
        if not self._optimizing.active:
            self._context.save()
