"""Hands every intent to its handler, and goes on with what takes long.

Runs on the worker's thread alone, knows neither threads nor widgets.
"""

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from carts_core.errors import CartsError
from carts_viewer import intents
from carts_viewer.checks import unknown
from carts_viewer.context import Context
from carts_viewer.handlers.annotating import AnnotatingHandler
from carts_viewer.handlers.browsing import BrowsingHandler
from carts_viewer.handlers.exporting import Deliver, ExportingHandler
from carts_viewer.handlers.finding import FindingHandler
from carts_viewer.handlers.importing import ImportingHandler
from carts_viewer.handlers.jobs import JobsHandler
from carts_viewer.handlers.optimizing import OptimizingHandler
from carts_viewer.handlers.painting import PaintingHandler
from carts_viewer.handlers.posing import PosingHandler
from carts_viewer.handlers.propagating import PropagatingHandler
from carts_viewer.overlay import OverlayRenderer
from carts_viewer.running import OptimizerFactory
from carts_viewer.session import Session
from carts_viewer.state import ViewState

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
        deliver: Deliver,
    ) -> None:
        """
        Args:
            state: what the page shows first.
            session: the recording and its project.
            renderer: renders poses.
            optimizers: makes optimizers.
            deliver: sends a file to a tab.
        """
        self._context = context = Context(state, session, renderer)
        self._editor = session.editor
        self._watch_at = 0.0
        self._incident: str | None = None
        self._optimizing = run = OptimizingHandler(context, optimizers)
        self._browsing = BrowsingHandler(context, run)
        self._annotating = AnnotatingHandler(context, run, self._browsing.show)
        self._propagating = PropagatingHandler(context, run, optimizers)
        self._exporting = ExportingHandler(context, run, deliver)
        self._jobs = JobsHandler(context, run, optimizers, self._propagating, self._exporting)
        self._handlers: dict[type[intents.Intent], Callable[[Any], None]] = {
            intents.Browsing: self._browsing.handle,
            intents.Posing: PosingHandler(context, run).handle,
            intents.Optimizing: self._optimizing.handle,
            intents.Annotation: self._annotating.handle,
            # What takes long is queued; the rest of its kind is done at once.
            intents.Solve: self._jobs.handle,
            intents.Export: self._jobs.handle,
            intents.Jobs: self._jobs.handle,
            intents.Propagating: self._propagating.handle,
            intents.Exporting: self._exporting.handle,
            intents.Painting: PaintingHandler(context, run).handle,
            intents.ImportMasks: ImportingHandler(context, run).handle,
            intents.Finding: FindingHandler(context, run, self._browsing.show).handle,
            intents.Refresh: lambda _: context.change(),
            # Nothing to do: it has woken the worker, which now may send the next overlay.
            intents.Drawn: lambda _: None,
            intents.Released: lambda _: self._released(),
            intents.DismissError: lambda _: context.change(error=None),
        }

    @property
    def state(self) -> ViewState:
        """What the page shows."""
        return self._context.state

    def handle(self, intent: intents.Intent) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        handle = next((handle for kind, handle in self._handlers.items() if isinstance(intent, kind)), None)
        if handle is None:
            raise unknown(intent)
        handle(intent)
        self._jobs.settle()

    def wait_time(self) -> float | None:
        """How long nothing needs to be done unless somebody asks [s]; None for ever."""
        handlers = (self._optimizing, self._propagating, self._exporting, self._jobs, self._browsing)
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
        """Do one bit of what is going on: an iteration, a frame to be solved or exported, the next frame of playing."""
        self._optimizing.advance()
        try:
            self._propagating.advance()
            self._exporting.advance()
        except Exception as error:
            self._jobs.fail(str(error))
            raise
        self._jobs.advance()
        self._browsing.advance()
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
            # What is solved is not lost to an error of something else; its own errors have saved it already.
            with suppress(CartsError):
                self._propagating.finish()
            self._exporting.cancel()
            self._jobs.fail(text)
            self._context.change(playing=False)

    def close(self) -> None:
        """Save what is under way; exports are abandoned.

        Raises:
            CartsError: it could not be saved.
        """
        self._exporting.cancel()
        self._propagating.finish()
        self._jobs.close()
        self._context.save()

    def say(self, text: str | None) -> None:
        """Show the user what is being prepared; None when nothing is."""
        self._context.change(busy=text)

    def score(self) -> None:
        """Compare the pose with the truth, if that was not done yet; errors as `handle`."""
        self._context.score()

    def map(self) -> None:
        """Compute what the chosen layer shows beyond the pose; errors as `handle`."""
        self._optimizing.map()

    def _released(self) -> None:
        self._annotating.released()
        if self._context.state.time_error is not None:
            # Whoever leaves the field means what is in it.
            self._context.change(error=self._context.state.time_error, time_error=None)
        # A run is no gesture of a hand, so nobody's letting go of something ends it.
        if not self._optimizing.active:
            self._context.save()
