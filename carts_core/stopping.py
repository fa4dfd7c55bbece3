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
    """Raised when the user or the system stops the program.

    Attributes:
        number: signal number.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


_NEVER_CUT = (
    *("importlib.", "_frozen_importlib", "llvmlite.", "numba.", "weakref", "_weakref"),
    "carts_core.project.database",
)
"""Prefixes of modules in which a signal handler must not raise an exception.

Numba loads kernels through LLVM, and a project is opened through SQLite; both call back into Python, where an exception
is lost, and LLVM ends the process with SIGSEGV. Exceptions in finalizers are also lost. A partially imported module is
unusable.
"""
_OURS = ("carts_core", "carts_viewer")
_INSTALLED = ("<frozen", *(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")))
_PATIENCE = 2.0
"""Maximum wait for a stack without library code [s]."""
_AGAIN = 0.02
"""Interval after which a pending signal is sent again [s]."""
PARENT = "CARTS_PARENT"
"""Environment variable with the id of the parent process; the command ends when the parent ends."""
_PR_SET_PDEATHSIG = 1
"""Constant from Linux's sys/prctl.h."""
_POLL = 1.0
"""Interval between checks for the parent on systems without a parent-death signal [s]."""


def end_with_parent(parent: int, number: int = signal.SIGTERM) -> None:
    """Send a signal to this process when its parent exits, even through SIGKILL; immediately if it has already exited.

    Linux sends the signal (`prctl(PR_SET_PDEATHSIG)`) when the thread that started this process ends. On other systems,
    a thread checks for the parent once a second.
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
    """Number of active `finished_first` blocks, and signal that is deferred until the end of these blocks."""

    blocks = 0
    waiting: int | None = None


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Make SIGTERM, SIGHUP and Ctrl-C raise `Stopped` in the main thread during the block.

    A signal received in library code is deferred until that code returns, for at most two seconds. During an import,
    the loading of a kernel or a finalizer, the signal is deferred without a limit. Ignored signals stay ignored, such
    as SIGHUP under `nohup`. Child processes have the default handlers.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    taken = [number for number, handler in before.items() if handler is not signal.SIG_IGN]
    owner, repeated, since = os.getpid(), _Repeated(), None
    # Stack frame of the caller; those of this generator and of contextlib are skipped.
    begin = sys._getframe(2)

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal since
        since = since or time.monotonic()
        if os.getpid() != owner:
            # A forked child exits without its parent's cleanup.
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
    """Thread that resends pending signals to this process until the end of the block."""

    def __init__(self) -> None:
        self._lock, self._over = threading.Lock(), False
        # A handler may run between any two instructions, so it must not wait for a lock, but writing a byte is safe.
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
    """Whether an exception may be raised in a stack frame; callers of `begin` are not considered."""
    while frame is not None and frame is not begin:
        module = frame.f_globals.get("__name__") or ""
        if frame.f_code.co_name == "__del__" or module.startswith(_NEVER_CUT):
            return False
        frame = frame.f_back
    return True


def _is_ours(frame: FrameType | None) -> bool:
    """Whether a stack frame runs code of this project or of its caller, as opposed to library code."""
    if frame is None:
        return True
    package = str(frame.f_globals.get("__name__")).partition(".")[0]
    return package in _OURS or not frame.f_code.co_filename.startswith(_INSTALLED)


@contextmanager
def finished_first() -> Iterator[None]:
    """Defer `Stopped` to the end of the block, which should be short, such as a single write."""
    _Unfinished.blocks += 1
    try:
        yield
    finally:
        _Unfinished.blocks -= 1
    if not _Unfinished.blocks and _Unfinished.waiting is not None:
        number, _Unfinished.waiting = _Unfinished.waiting, None
        raise Stopped(number)


@contextmanager
def message_if_stopped(what_is_kept: Callable[[], str] | str) -> Iterator[None]:
    """Attach a note on the partial results to `Stopped`, which the command prints."""
    try:
        yield
    except KeyboardInterrupt as stopped:
        stopped.add_note(what_is_kept if isinstance(what_is_kept, str) else what_is_kept())
        raise


def exit_status(stopped: KeyboardInterrupt) -> int:
    """Exit status as in a shell: 128 + signal number."""
    return 128 + (stopped.number if isinstance(stopped, Stopped) else signal.SIGINT)


def message(stopped: KeyboardInterrupt) -> str:
    """Message for the user: the signal, and which results are kept."""
    by = f"stopped by {stopped}" if isinstance(stopped, Stopped) and stopped.number != signal.SIGINT else "interrupted"
    return "; ".join([by, *getattr(stopped, "__notes__", ())])
