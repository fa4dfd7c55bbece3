"""Ctrl-C, and the signals that end a program in its stead, between two steps and never within one."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class Stopped(KeyboardInterrupt):
    """A person or the system asked the program to end.

    Attributes:
        number: of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


class _Unfinished:
    """How many blocks have to be finished first, and the signal that waits for them."""

    blocks = 0
    waiting: int | None = None


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Have SIGTERM and SIGHUP, as Ctrl-C, raise `Stopped` in the main thread while the block runs.

    A signal that is ignored stays so, as SIGHUP is under `nohup`. Child processes get the system's own handling.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    taken = [number for number, handler in before.items() if handler is not signal.SIG_IGN]
    owner = os.getpid()

    def stop(number: int, frame: FrameType | None) -> None:
        if os.getpid() != owner:
            # A forked child, which is to end as one that never heard of this.
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        elif _Unfinished.blocks:
            _Unfinished.waiting = number
        else:
            raise Stopped(number)

    for number in taken:
        signal.signal(number, stop)
    try:
        yield
    finally:
        _Unfinished.waiting = None
        for number in taken:
            signal.signal(number, before[number])


@contextmanager
def finished_first() -> Iterator[None]:
    """A block that no signal cuts in two: `Stopped` is raised at its end. It should take no longer than a write."""
    _Unfinished.blocks += 1
    try:
        yield
    finally:
        _Unfinished.blocks -= 1
    if not _Unfinished.blocks and _Unfinished.waiting is not None:
        number, _Unfinished.waiting = _Unfinished.waiting, None
        raise Stopped(number)


@contextmanager
def when_stopped(what_is_kept: Callable[[], str] | str) -> Iterator[None]:
    """Say what there is of the work, should the block be stopped: a note on the exception, which the command prints."""
    try:
        yield
    except KeyboardInterrupt as stopped:
        stopped.add_note(what_is_kept if isinstance(what_is_kept, str) else what_is_kept())
        raise


def exit_status(stopped: KeyboardInterrupt) -> int:
    """128 + the number of the signal, as shells have it."""
    return 128 + (stopped.number if isinstance(stopped, Stopped) else signal.SIGINT)


def message(stopped: KeyboardInterrupt) -> str:
    """What to tell the person: by what it was stopped, and what is kept."""
    by = f"stopped by {stopped}" if isinstance(stopped, Stopped) and stopped.number != signal.SIGINT else "interrupted"
    return "; ".join([by, *getattr(stopped, "__notes__", ())])
