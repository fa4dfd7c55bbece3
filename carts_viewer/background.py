"""What takes long and belongs to no tab: the queue of jobs, with the solving and exporting that they do."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from carts_core.errors import CartsError
from carts_viewer import intents
from carts_viewer.checks import unknown
from carts_viewer.context import Context
from carts_viewer.handlers.exporting import Deliver, ExportingHandler
from carts_viewer.handlers.jobs import Asker, JobsHandler
from carts_viewer.handlers.propagating import PropagatingHandler
from carts_viewer.overlay import OverlayRenderer
from carts_viewer.people import Person
from carts_viewer.running import OptimizerFactory
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
