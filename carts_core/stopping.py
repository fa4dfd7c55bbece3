"""Graceful shutdown on SIGINT, SIGTERM and SIGHUP, between two steps."""

import ctypes
import os
import signal
import sys
import sysconfig
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class Stopped(KeyboardInterrupt):
    """The program was stopped by the user or the system.

    Attributes:
        number: of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


_NEVER_CUT = (
    *("importlib.", "_frozen_importlib", "llvmlite.", "numba.", "weakref", "_weakref"),
    "carts_core.project.database",
)
"""Prefixes of modules in which no exception may be raised from a signal handler.

Numba loads kernels through LLVM, and a project is opened through SQLite, which call back into Python: an exception
there is lost, and LLVM ends the process with SIGSEGV. In finalizers it is lost, too. A half imported module is useless.
"""
_OURS = ("carts_core", "carts_viewer")
_INSTALLED = ("<frozen", *(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")))
_PATIENCE = 2.0
"""Longest wait for a moment without library code on the stack [s]."""
_AGAIN = 0.02
"""Interval after which a waiting signal is sent again [s]."""
PARENT = "CARTS_PARENT"
"""Environment variable with the id of the process with which a command ends."""
_PR_SET_PDEATHSIG = 1
"""Constant of Linux's sys/prctl.h."""
_POLL = 1.0
"""Interval between checks for the parent, where the system has no signal for its end [s]."""


def end_with_parent(parent: int, number: int = signal.SIGTERM) -> None:
    """Send a signal to this process when its parent ends, by SIGKILL too; at once if it has already ended.

    Linux sends the signal (`prctl(PR_SET_PDEATHSIG)`) when the thread that started this process ends. Elsewhere, a
    thread checks once a second.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
    else:
        threading.Thread(target=_signal_at_end, args=(parent, number), name="carts-parent", daemon=True).start()
    if os.getppid() != parent:
        os.kill(os.getpid(), number)


def _signal_at_end(parent: int, number: int) -> None:
    while os.getppid() == parent:
        time.sleep(_POLL)
    os.kill(os.getpid(), number)


class _Unfinished:
    """Number of blocks to be finished, and the signal that waits for them."""

    blocks = 0
    waiting: int | None = None


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Make SIGTERM and SIGHUP raise `Stopped` in the main thread, as Ctrl-C does, in the block.

    One that comes while a library is at work waits for its end, two seconds at most; one that comes while a module is
    imported, a kernel is loaded or an object is finalized waits for that however long it takes. A signal that is
    ignored stays so, as SIGHUP is under `nohup`. Child processes get the system's own handling.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    taken = [number for number, handler in before.items() if handler is not signal.SIG_IGN]
    owner, repeated, since = os.getpid(), _Repeated(), None
    # The context manager's frame, that of contextlib, and the one that runs the block.
    begin = sys._getframe(2)

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal since
        since = since or time.monotonic()
        if os.getpid() != owner:
            # A forked child ends without the cleanup of its parent.
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        elif _Unfinished.blocks:
            _Unfinished.waiting = number
        elif _may_be_cut(frame, begin) and (_is_ours(frame) or time.monotonic() - since > _PATIENCE):
            raise Stopped(number)
        else:
            repeated.send(number)

    for number in taken:
        signal.signal(number, stop)
    try:
        yield
    finally:
        _Unfinished.waiting = None
        for number in taken:
            signal.signal(number, before[number])
        repeated.end()


class _Repeated:
    """Sends signals to this process again, until the end of their block."""

    def __init__(self) -> None:
        self._lock, self._over = threading.Lock(), False
        # A handler may run between any two instructions, where it must not wait for a lock; writing a byte it may.
        self._asked, self._ask = os.pipe()
        os.set_blocking(self._ask, False)
        threading.Thread(target=self._work, name="carts-signals", daemon=True).start()

    def send(self, number: int) -> None:
        with suppress(BlockingIOError):
            os.write(self._ask, bytes([number]))

    def end(self) -> None:
        with self._lock:
            self._over = True
        os.close(self._ask)

    def _work(self) -> None:
        while number := os.read(self._asked, 1):
            time.sleep(_AGAIN)
            with self._lock:
                if not self._over:
                    os.kill(os.getpid(), number[0])
        os.close(self._asked)


def _may_be_cut(frame: FrameType | None, begin: FrameType) -> bool:
    """Whether an exception may be raised in a frame; callers of the frame `begin` are not considered."""
    while frame is not None and frame is not begin:
        module = frame.f_globals.get("__name__") or ""
        if frame.f_code.co_name == "__del__" or module.startswith(_NEVER_CUT):
            return False
        frame = frame.f_back
    return True


def _is_ours(frame: FrameType | None) -> bool:
    """Whether a frame runs code of this project or its caller, not of a library."""
    if frame is None:
        return True
    package = str(frame.f_globals.get("__name__")).partition(".")[0]
    return package in _OURS or not frame.f_code.co_filename.startswith(_INSTALLED)


@contextmanager
def finished_first() -> Iterator[None]:
    """Block that is not interrupted: `Stopped` is raised at its end. It should take no longer than a write."""
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
    """Attach a note on the partial results to `Stopped`; the command prints it."""
    try:
        yield
    except KeyboardInterrupt as stopped:
        stopped.add_note(what_is_kept if isinstance(what_is_kept, str) else what_is_kept())
        raise


def exit_status(stopped: KeyboardInterrupt) -> int:
    """Exit status of a shell: 128 + the number of the signal."""
    return 128 + (stopped.number if isinstance(stopped, Stopped) else signal.SIGINT)


def message(stopped: KeyboardInterrupt) -> str:
    """Message for the user: the signal, and which results are kept."""
    by = f"stopped by {stopped}" if isinstance(stopped, Stopped) and stopped.number != signal.SIGINT else "interrupted"
    return "; ".join([by, *getattr(stopped, "__notes__", ())])
