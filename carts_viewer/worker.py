"""The worker thread: carries out intents, advances work, and publishes states."""

import gc
import logging
import threading
import time
from collections.abc import Callable
from queue import SimpleQueue

from carts_core.errors import CartsError
from carts_core.process import return_memory
from carts_viewer.actions import intents
from carts_viewer.tabs import IntentQueue, QueuedIntent, Tab, Tabs

_log = logging.getLogger(__name__)

MEMORY_KEPT = 10.0
"""Idle time after which freed memory is returned to the operating system [s]."""
MEMORY_KEPT_AT_WORK = 30.0
"""Interval between returns of memory during work with an open page [s]; each may delay a picture by milliseconds."""
_NOTICE = 5.0
"""Interval between messages while the end of the thread is awaited [s]."""
_STARTS_LONG_WORK = (intents.Optimizing, intents.SequenceIntent, intents.Exporting, intents.Jobs)
"""Classes of intents that may start long work."""


class Worker:
    """Carries out queued intents; sends pictures as fast as each page draws them, and always the last one.

    Tabs take turns: work of one tab delays the others by a single step.
    """

    def __init__(
        self,
        queue: IntentQueue[Tab],
        tabs: Tabs,
        computing: Callable[[], bool] = lambda: False,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        """
        Args:
            queue: intents of the tabs.
            tabs: the tabs.
            computing: returns whether the solver is busy; texts about its preparation are then kept.
            say: called with a line for the user while `stop` waits.
        """
        self._queue, self._computing, self._say = queue, computing, say
        self._tabs = tabs
        self._calls: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._stop = threading.Event()
        self._startup: Callable[[], None] | None = None
        self._rest = threading.Condition()
        self._resting = False
        self._worked_at: float | None = 0.0
        """Time of the last work [s, monotonic]; None once its memory is returned."""
        self._returned_at = 0.0
        """Time at which freed memory was last returned to the system [s, monotonic]."""
        self._thread = threading.Thread(target=self._work, name="carts-worker", daemon=True)

    def start(self, startup: Callable[[], None] | None = None) -> None:
        """Start the thread; it calls `startup` once a page has its first picture."""
        self._startup = startup
        self._thread.start()

    def stop(self) -> None:
        """Finish the current work and end the thread, however long the work takes."""
        self._stop.set()
        self._queue.wake()
        while True:
            self._thread.join(_NOTICE)
            if not self._thread.is_alive():
                return
            self._say("Waiting for the current step to end")

    def wake(self) -> None:
        """Continue with work that waits for a reply of the solver. Thread-safe."""
        self._queue.wake()

    def fail(self, error: CartsError) -> None:
        """Show an error in all tabs; called on the worker's thread."""
        self._fail(error, *self._tabs)

    def call(self, work: Callable[[], None]) -> None:
        """Call a function on the worker's thread, before pending intents. Thread-safe."""
        self._calls.put(work)
        self._queue.wake()

    def settled(self, timeout: float) -> bool:
        """Wait until all work is done and shown; False after `timeout` [s]."""
        end = time.monotonic() + timeout
        with self._rest:
            while not (self._resting and self._queue.empty() and self._calls.empty()):
                if not self._rest.wait(min(0.05, max(0.0, end - time.monotonic()))) and time.monotonic() > end:
                    return False
        return True

    def report(self, text: str | None) -> None:
        """Show a text about the current preparation at once in all tabs; called on the worker's thread."""
        for tab in self._tabs:
            tab.controller.say(text)
            tab.show_panels(lambda work, tab=tab: self._attempt(work, tab))

    def _work(self) -> None:
        self._publish()
        while not self._stop.is_set():
            self._round()
            if self._startup is not None and any(tab.pictured for tab in self._tabs):
                self._attempt(self._startup, *self._tabs)
                self._startup = None
        # Edits that arrived just before the end are also saved, but no long work is started.
        for queued in self._queue.take(0.0):
            if not isinstance(queued.intent, _STARTS_LONG_WORK):
                self._handle(queued)

    def _round(self) -> None:
        wait_time = self._wait_time()
        at_rest = wait_time is None and self._queue.empty() and self._calls.empty()
        self._set_resting(at_rest)
        waits = [wait_time, self._memory_wait(at_rest)]
        for tab in self._tabs:
            waits += [tab.controller.overdue_in(), tab.away_in()]
        known = [wait for wait in waits if wait is not None]
        waiting = self._queue.take(min(known, default=None) if self._calls.empty() else 0.0)
        self._set_resting(False)
        if waiting or any(tab.away_in() == 0.0 for tab in self._tabs):
            self._worked_at = time.monotonic()
        while not self._calls.empty():
            self._attempt(self._calls.get_nowait(), *self._tabs)
        for queued in waiting:
            self._handle(queued)
        for tab in self._tabs:
            self._attempt(tab.leave, tab)
            # Pictures of edits do not wait for other work.
            tab.show_picture(lambda work, tab=tab: self._attempt(work, tab))
        for tab in self._tabs:
            self._attempt(tab.controller.advance, tab, stop=True)
        self._advance_background()
        for tab in self._tabs:
            self._attempt(tab.controller.follow, tab)
            if tab.controller.state.busy is not None and not self._computing():
                tab.controller.say(None)
        self._publish()

    def _memory_wait(self, at_rest: bool) -> float | None:
        """Return freed memory when idle, and regularly during work, less often while a page is open.

        Returns the time until memory is returned next [s]; None if it has been returned.
        """
        now, alone = time.monotonic(), not any(tab.view for tab in self._tabs)
        if not (at_rest or alone) and now - self._returned_at > MEMORY_KEPT_AT_WORK:
            self._return_memory()
        if not at_rest and (not alone or self._worked_at is None):
            self._worked_at = now
        if self._worked_at is None:
            return None
        if now - self._worked_at < MEMORY_KEPT:
            return self._worked_at + MEMORY_KEPT - now
        self._worked_at = None if at_rest else now
        if alone and at_rest:
            self._attempt(self._tabs.forget_images)
            # Widgets of a closed page are reference cycles. While a page is open, collecting them would delay it.
            gc.collect()
        self._return_memory()
        return None

    def _return_memory(self) -> None:
        return_memory()
        self._returned_at = time.monotonic()

    def _handle(self, queued: QueuedIntent[Tab]) -> None:
        # Intents of removed tabs are dropped.
        if queued.tab in self._tabs:
            self._attempt(lambda: queued.tab.controller.handle(queued.intent), queued.tab)

    def _advance_background(self) -> None:
        try:
            self._tabs.job_runner.advance()
        except Exception as error:
            text = self._fail(error, *self._tabs)
            self._attempt(lambda: self._tabs.job_runner.fail(text), *self._tabs)

    def _set_resting(self, resting: bool) -> None:
        with self._rest:
            self._resting = resting
            self._rest.notify_all()

    def _wait_time(self) -> float | None:
        """Time to wait for an intent [s]: 0 while there is work, at most until a page takes a changed state."""
        waits = [self._tabs.job_runner.wait_time()]
        for tab in self._tabs:
            waits += [tab.controller.wait_time(), tab.show_wait()]
        return min((wait for wait in waits if wait is not None), default=None)

    def _publish(self) -> None:
        for tab in self._tabs:
            tab.publish(lambda work, tab=tab: self._attempt(work, tab))

    def _attempt(self, work: Callable[[], None], *tabs: Tab, stop: bool = False) -> None:
        """Call a function; errors are shown in `tabs`."""
        try:
            work()
        except Exception as error:
            self._fail(error, *tabs, stop=stop)

    def _fail(self, error: Exception, *tabs: Tab, stop: bool = False) -> str:
        if not isinstance(error, CartsError):
            # The terminal gets the traceback; the page shows the error.
            _log.error("Unexpected error in the viewer's worker at %s", time.strftime("%H:%M:%S"), exc_info=error)
        for tab in tabs:
            tab.controller.fail(error, stop=stop)
        return str(error) if isinstance(error, CartsError) else f"{type(error).__name__}: {error}"
