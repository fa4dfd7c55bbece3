"""A function that calls back now and then, done bit by bit: its thread and the worker take turns."""

import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

from carts_core.export import Monitor

T = TypeVar("T")


class Stepped(Generic[T]):
    """A function that asks a `Monitor` whether to go on, between two of its steps.

    It runs on a thread of its own, but only while `advance` waits for it. So nothing happens at the same time, and what
    it uses needs no lock.

    Attributes:
        done: steps that are done.
        total: all steps; 0 until the first is done.
    """

    def __init__(self, function: Callable[[Monitor], T]) -> None:
        self.done, self.total = 0, 0
        self._function = function
        self._go, self._back = threading.Semaphore(0), threading.Semaphore(0)
        self._pause_at = 0.0
        self._cancelled = False
        self._result: T | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="carts-stepped", daemon=True)

    def advance(self, seconds: float) -> T | None:
        """Go on for about so long [s]; the function's result once there is one.

        Raises:
            Exception: what the function raised.
        """
        if self._thread.ident is None:
            self._thread.start()
        self._pause_at = time.monotonic() + seconds
        self._go.release()
        self._back.acquire()
        if self._error is not None:
            raise self._error
        return self._result

    def cancel(self) -> None:
        """Have the function stop, and wait until it has cleaned up."""
        self._cancelled = True
        if self._thread.is_alive():
            self._go.release()
            self._thread.join()

    def _work(self) -> None:
        self._go.acquire()
        try:
            self._result = self._function(Monitor(self._report, self._stop))
        except BaseException as error:
            self._error = error
        finally:
            self._back.release()

    def _report(self, done: int, total: int) -> None:
        self.done, self.total = done, total

    def _stop(self) -> bool:
        if not self._cancelled and time.monotonic() >= self._pause_at:
            self._back.release()
            self._go.acquire()
        return self._cancelled
