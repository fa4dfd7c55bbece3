"""The one thread that computes: takes intents, changes the state, and shows what came out."""

import logging
import threading
import time
from collections.abc import Callable
from typing import Protocol

from carts_core.errors import CartsError
from carts_viewer import intents
from carts_viewer.controller import Controller
from carts_viewer.intent_queue import IntentQueue
from carts_viewer.state import ViewState

_log = logging.getLogger(__name__)

_BEGINNING = (intents.Optimizing, intents.Propagating, intents.Exporting, intents.Jobs)
"""Intents that may begin what takes long."""


class Display(Protocol):
    """Where states are shown."""

    def ready_in(self) -> float:
        """How long until the page can take another picture [s]; 0 when it can now."""
        ...

    def show_picture(self, state: ViewState) -> None:
        """Send frame, overlay and 3D scene, as far as they changed."""

    def show_panels(self, state: ViewState) -> None:
        """Bring every widget up to date."""


class Worker:
    """Drains the queue, newest wins; pictures go out as fast as the page draws them and the last one always does."""

    def __init__(self, queue: IntentQueue, controller: Controller, display: Display) -> None:
        self._queue = queue
        self._controller = controller
        self._display = display
        self._stop = threading.Event()
        self._shown: ViewState | None = None
        self._pictured: ViewState | None = None
        self._startup: Callable[[], None] | None = None
        self._rest = threading.Condition()
        self._resting = False
        self._thread = threading.Thread(target=self._work, name="carts-worker", daemon=True)

    def start(self, startup: Callable[[], None] | None = None) -> None:
        """Begin; `startup` runs on the worker's thread once the first picture is out."""
        self._startup = startup
        self._thread.start()

    def stop(self) -> None:
        """Finish what is being done and end the thread."""
        self._stop.set()
        self._queue.wake()
        self._thread.join(timeout=30.0)

    def settled(self, timeout: float) -> bool:
        """Wait until nothing is left to do or to show; False when that took longer than `timeout` [s]."""
        end = time.monotonic() + timeout
        with self._rest:
            while not (self._resting and self._queue.empty()):
                if not self._rest.wait(min(0.05, max(0.0, end - time.monotonic()))) and time.monotonic() > end:
                    return False
        return True

    def report(self, text: str | None) -> None:
        """Show what is being prepared, at once; called on the worker's thread from within the work."""
        self._controller.say(text)
        self._display.show_panels(self._controller.state)

    def _work(self) -> None:
        self._attempt(self._publish)
        if self._startup is not None:
            self._attempt(self._startup)
        while not self._stop.is_set():
            self._attempt(self._round)
        # What somebody did just before the end is saved, too; nothing long is begun.
        for intent in self._queue.take(0.0):
            if not isinstance(intent, _BEGINNING):
                self._attempt(lambda intent=intent: self._controller.handle(intent))

    def _round(self) -> None:
        wait_time = self._wait_time()
        self._set_resting(wait_time is None and self._queue.empty())
        waits = [wait for wait in (wait_time, self._controller.overdue_in()) if wait is not None]
        waiting = self._queue.take(min(waits, default=None))
        self._set_resting(False)
        for intent in waiting:
            self._attempt(lambda intent=intent: self._controller.handle(intent))
        self._attempt(self._controller.advance, stop=True)
        self._publish()

    def _set_resting(self, resting: bool) -> None:
        with self._rest:
            self._resting = resting
            self._rest.notify_all()

    def _wait_time(self) -> float | None:
        """How long to wait for an intent: not while there is work, and no longer than a picture waits for the page."""
        wait_time = self._controller.wait_time()
        if self._pictured is not self._controller.state:
            ready = self._display.ready_in()
            return ready if wait_time is None else min(ready, wait_time)
        return wait_time

    def _publish(self) -> None:
        if self._pictured is not self._controller.state and self._display.ready_in() <= 0.0:
            self._attempt(self._controller.map)
            self._attempt(lambda: self._display.show_picture(self._controller.state))
            # Numbers come after the picture: somebody may be dragging.
            self._attempt(self._controller.score)
            # Also after an error, which would otherwise be met again at once, and for ever.
            self._pictured = self._controller.state
        if self._shown is not self._controller.state:
            self._display.show_panels(self._controller.state)
            self._shown = self._controller.state

    def _attempt(self, work: Callable[[], None], *, stop: bool = False) -> None:
        """Do something; an error is shown in the page and the worker goes on."""
        try:
            work()
        except CartsError as error:
            self._controller.fail(error, stop=stop)
        except Exception as error:
            # The traceback helps whoever reads the terminal; the page shows what happened.
            _log.exception("The viewer's worker met an unexpected error at %s", time.strftime("%H:%M:%S"))
            self._controller.fail(error, stop=stop)
