"""The process of the solver, and its proxy in the process of the page.

The child process is started with `subprocess`, since `multiprocessing` would import the main module of the caller, and
ends with the page's process. Requests and results are sent through a pipe of `multiprocessing`, of which this program
owns both ends.
"""

import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import suppress
from functools import cache
from importlib import import_module
from itertools import count
from multiprocessing.connection import Connection, Pipe
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Generic, Protocol, TypeVar

from carts_core import errors
from carts_core.errors import CartsError
from carts_core.process import return_memory, tune_process
from carts_core.recording import Sequence
from carts_core.stopping import end_with_parent
from carts_viewer.jobs.solver import NetworkChoice, Solver

T = TypeVar("T")
_log = logging.getLogger(__name__)
_NICENESS = 5
"""Increment of the niceness of the process, so that the page takes precedence."""
_LENGTH = 8
"""Length of the number before each request [bytes]."""
_MAX_FAILURES = 3
"""Number of consecutive processes that end without a reply, after which only a request starts the next process."""
_MEMORY_KEPT = 10.0
"""Idle time after which freed memory is returned to the operating system [s]."""
_IMPORTED_LATER = ("pytorch_kinematics", "roma")
"""Modules that take a second to import (matplotlib, PyTorch's compiler), imported by the idle solver before its first
run."""
_IDLE = 0.5
"""Idle time after which such a module is imported [s]."""


class SolverStopped(CartsError):
    """The solver process has ended, and its runs are lost."""


class Reply(Generic[T]):
    """Result of a request, which may not be known yet. `yield from reply` yields it until it is done."""

    def __init__(self) -> None:
        self._done = threading.Event()
        self._value: Any = None
        self._error: Exception | None = None
        self._callbacks: SimpleQueue[Callable[[], None]] = SimpleQueue()

    @classmethod
    def of(cls, function: Callable[[], T]) -> "Reply[T]":
        """Completed reply with the result or the error of a function, which is called immediately."""
        reply = cls()
        try:
            reply.set(function())
        except Exception as error:
            reply.set(error=error)
        return reply

    @property
    def done(self) -> bool:
        """Whether the result or an error is known."""
        return self._done.is_set()

    def on_done(self, function: Callable[[], None]) -> None:
        """Call a function, on any thread, when the result or an error is known."""
        self._callbacks.put(function)
        if self.done:
            self._call_back()

    def wait(self, timeout: float | None = None) -> None:
        """Wait until the result or an error is known, at most `timeout` [s]."""
        self._done.wait(timeout)

    def result(self) -> T:
        """Wait for the result.

        Raises:
            CartsError: the request failed; `SolverStopped` if the process has ended.
        """
        self.wait()
        if self._error is not None:
            raise self._error
        return self._value

    def check(self) -> None:
        """Wait for the result; errors are those of `result`."""
        self.result()

    def __iter__(self) -> "Generator[Reply[T], None, T]":
        while not self.done:
            yield self
        return self.result()

    def set(self, value: Any = None, error: Exception | None = None) -> None:
        """Set the result or the error."""
        self._value, self._error = value, error
        self._done.set()
        self._call_back()

    def _call_back(self) -> None:
        with suppress(Empty):
            while True:
                self._callbacks.get_nowait()()


class Listener(Protocol):
    """Receives events of the solver process, on a thread of its proxy."""

    def solver_replied(self) -> None:
        """A reply is done."""

    def solver_reports(self, text: str) -> None:
        """The solver prepares something; `text` is for the user."""

    def solver_stopped(self, error: SolverStopped) -> None:
        """The process has ended unexpectedly; its requests fail with this error. For restarts, see `_MAX_FAILURES`."""


class Requests(Protocol):
    """Carries out requests of the page, in their order.

    Attributes:
        listeners: objects that receive events.
    """

    listeners: list[Listener]

    @property
    def busy(self) -> bool:
        """Whether a request is not answered yet."""
        ...

    def start(self, *warm_up: Any) -> None:
        """Prepare for requests; the request `warm_up` is carried out after every restart."""

    def ask(self, *request: Any) -> Reply[Any]:
        """Request of `_Desk.answer`."""
        ...

    def close(self) -> None:
        """End; unanswered requests fail."""


class Run(Generic[T]):
    """An iterator of the solver; see `Solver`."""

    _numbers = count()

    def __init__(self, requests: Requests, choice: NetworkChoice, method: str, task: Any) -> None:
        self._requests, self._number = requests, next(self._numbers)
        self._first: tuple[Any, ...] | None = (choice, method, task)

    def next(self, sent: object = None) -> "Reply[T | None]":
        """The next result; None after the last one. `sent` is sent into the iterator."""
        first, self._first = self._first, None
        if first is not None:
            return self._requests.ask("start", self._number, *first)
        return self._requests.ask("next", self._number, sent)

    def close(self) -> None:
        """Drop the iterator."""
        self._requests.ask("close", self._number)


class _Desk:
    """Solver and its running iterators."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report
        self._solver: tuple[NetworkChoice, Solver] | None = None
        self._running: dict[int, Any] = {}

    def answer(self, kind: str, *content: Any) -> Any:
        """Carry out a request: `call`, or `start`, `next` and `close` of an iterator."""
        match kind, *content:
            case "call", choice, method, *arguments:
                return getattr(self._of(choice), method)(*arguments)
            case "start", number, choice, method, task:
                self._running[number] = getattr(self._of(choice), method)(task)
                return next(self._running[number], None)
            case "next", number, sent:
                running = self._running.get(number)
                if running is None:
                    raise SolverStopped("The solver process was restarted, so this run has ended. Start it again.")
                try:
                    return next(running) if sent is None else running.send(sent)
                except StopIteration:
                    return None
            case "close", number:
                self._running.pop(number, None)
        return None

    def _of(self, choice: NetworkChoice) -> Solver:
        if self._solver is None or self._solver[0] != choice:
            self._solver = choice, Solver(choice, self._report)
        return self._solver[1]


class SolverInProcess:
    """The solver in the calling process, which imports PyTorch: replies are already complete. See `Requests`."""

    busy = False

    def __init__(self) -> None:
        self.listeners: list[Listener] = []
        self._desk = _Desk(self._report)

    def start(self, *warm_up: Any) -> None:
        """See `Requests`."""

    def ask(self, *request: Any) -> Reply[Any]:
        """See `Requests`; errors are raised by `Reply.result`."""
        return Reply.of(lambda: self._desk.answer(*request))

    def close(self) -> None:
        """See `Requests`."""

    def _report(self, text: str) -> None:
        for listener in self.listeners:
            listener.solver_reports(text)


class SolverProcess:
    """The solver in a process of its own, which is started by `start` or the first request. Thread-safe.

    If the process ends unexpectedly, its requests fail with `SolverStopped`, and it is started again.

    Attributes:
        listeners: objects that receive events.
        pid: id of the process; None if it is not running.
    """

    def __init__(self) -> None:
        self.listeners: list[Listener] = []
        self.pid: int | None = None
        self._changing = threading.Lock()
        self._numbers = count()
        self._waiting: dict[int, Reply[Any]] = {}
        self._unsent: list[bytes] = []
        self._warm_up: bytes | None = None
        self._pipe: Connection | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._wanted, self._closed = threading.Event(), False
        # The process ends with the thread that starts it.
        self._thread = threading.Thread(target=self._serve, name="carts-solver", daemon=True)

    @property
    def busy(self) -> bool:
        """Whether a request is not answered yet."""
        return bool(self._waiting)

    def start(self, *warm_up: Any) -> None:
        """Start the process unless it is running; it carries out the request `warm_up` after every restart."""
        with self._changing:
            self._warm_up = _packed(next(self._numbers), warm_up) if warm_up else self._warm_up
            if self._thread.ident is None and not self._closed:
                self._thread.start()
        self._wanted.set()

    def ask(self, *request: Any) -> Reply[Any]:
        """See `Requests`."""
        reply, number = Reply[Any](), next(self._numbers)
        packed = _packed(number, request)
        with self._changing:
            if self._closed:
                reply.set(error=SolverStopped("The solver process is closed."))
                return reply
            self._waiting[number] = reply
            self._unsent.append(packed)
            self._send()
        self.start()
        return reply

    def close(self) -> None:
        """End the process; unanswered requests fail."""
        with self._changing:
            self._closed = True
            process = self._process
        self._wanted.set()
        if process is not None:
            process.kill()
        if self._thread.ident is not None:
            self._thread.join()

    def _serve(self) -> None:
        """Start the process when it is needed, and receive its results."""
        failures, urgent = 0, False
        while True:
            self._wanted.wait()
            here, there = Pipe()
            with there, self._changing:
                process = self._process = None if self._closed else _started(there, urgent)
                self.pid = None if process is None else process.pid
            answered = process is not None and self._receive(here)
            status = 0 if process is None else process.wait()
            failures, urgent = 0 if answered else failures + 1, True
            with self._changing:
                self._process = self._pipe = self.pid = None
                lost, self._waiting = list(self._waiting.values()), {}
                self._unsent = [] if self._warm_up is None else [self._warm_up]
                closed = self._closed
                if failures >= _MAX_FAILURES:
                    # It is started again with the next request.
                    self._wanted.clear()
            here.close()
            error = SolverStopped("The viewer was closed." if closed else _description(status, failures))
            for reply in lost:
                reply.set(error=error)
            if closed:
                return
            for listener in tuple(self.listeners):
                listener.solver_stopped(error)

    def _send(self) -> None:
        """Send queued requests if the process, which always reads, is ready. The lock must be held."""
        while self._pipe is not None and self._unsent:
            try:
                self._pipe.send_bytes(self._unsent.pop(0))
            except OSError:
                # `_serve` handles the end of the process.
                return

    def _receive(self, pipe: Connection) -> bool:
        """Receive messages until the process ends; returns whether it has answered a request."""
        answered = False
        while True:
            try:
                number, value, error = pipe.recv()
            except (EOFError, OSError):
                return answered
            if number is None and value is None:
                with self._changing:
                    self._pipe = pipe
                    self._send()
                continue
            if number is None:
                for listener in tuple(self.listeners):
                    listener.solver_reports(value)
                continue
            answered = True
            with self._changing:
                reply = self._waiting.pop(number, None)
            if reply is not None:
                reply.set(value, None if error is None else _raised(*error))
            for listener in tuple(self.listeners):
                listener.solver_replied()


def _started(pipe: Connection, urgent: bool) -> "subprocess.Popen[bytes] | None":
    """The process, with low priority (if `urgent`, only after its first request); None if it cannot be started."""
    paths = [os.path.abspath(path) for path in sys.path]
    start = "import sys; sys.path[:] = sys.argv[4:]; from carts_viewer.jobs.solver_process import serve; serve()"
    try:
        return subprocess.Popen(
            [sys.executable, "-P", "-c", start, str(os.getpid()), str(pipe.fileno()), str(int(urgent)), *paths],
            stdin=subprocess.DEVNULL,
            pass_fds=[pipe.fileno()],
        )
    except OSError as error:
        _log.error("The solver process cannot be started: %s", error)
        return None


def _packed(number: int, request: tuple[Any, ...]) -> bytes:
    """A numbered request; recordings are sent as their paths."""
    return number.to_bytes(_LENGTH, "little") + bytes(ForkingPickler.dumps(request))


def _description(status: int, failures: int) -> str:
    """Message about the unexpected end of the process with an exit status."""
    reason = f"exit status {status}"
    if status < 0:
        reason = signal.Signals(-status).name
        if -status == signal.SIGKILL:
            reason += ", for example because memory ran out"
    if failures >= _MAX_FAILURES:
        return f"The solver process cannot be started ({reason}). Read the terminal, and try again."
    return (
        f"The solver process ended unexpectedly ({reason}) and was started again. Edits and saved results are kept; "
        "start the interrupted work again."
    )


def _raised(name: str, text: str) -> Exception:
    """The exception of a failed request."""
    known = SolverStopped if name == SolverStopped.__name__ else getattr(errors, name, None)
    return known(text) if known is not None else RuntimeError(f"{name}: {text}" if name else text)


def _described(error: Exception) -> tuple[str, str]:
    """Class and message of an exception; the class is one of `carts_core.errors` if possible."""
    known = [one.__name__ for one in type(error).__mro__ if one is SolverStopped or hasattr(errors, one.__name__)]
    if known:
        return known[0], str(error)
    if isinstance(error, MemoryError):
        return "CartsError", "The solver needs more memory than is available. Use smaller images or fewer frames."
    _log.error("Unexpected error in the solver process", exc_info=error)
    return type(error).__name__, str(error)


@cache
def _opened(path: Path) -> Sequence:
    return Sequence.open(path)


_MOVED: dict[Path, Sequence] = {}
"""Sequence file -> sequence with the time offset that was used last."""


def _reopened(path: Path, time_offset: float | None) -> Sequence:
    """The sequence of a file, with its caches, at a time offset [s]."""
    for one in (own := _opened(path), _MOVED.get(path)):
        if one is not None and (None if one.matching is None else one.matching.time_offset) == time_offset:
            return one
    assert time_offset is not None
    _MOVED[path] = own.with_time_offset(time_offset)
    return _MOVED[path]


def _by_path(sequence: Sequence) -> tuple[Any, ...]:
    return _reopened, (sequence.path, None if sequence.matching is None else sequence.matching.time_offset)


# The process opens the recording itself.
ForkingPickler.register(Sequence, _by_path)


def serve() -> None:
    """Entry point of the process; its arguments are the id of the page's process, a pipe, and whether it is urgent."""
    parent, descriptor, urgent = (int(text) for text in sys.argv[1:4])
    end_with_parent(parent, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the page's process.
    if not urgent:
        _lower_priority()
    pipe = Connection(descriptor)
    requests = SimpleQueue[bytes]()
    threading.Thread(target=_read, args=(pipe, requests), daemon=True).start()
    tune_process()
    desk = _Desk(lambda text: pipe.send((None, text, None)))
    pipe.send((None, None, None))
    idle, later = False, list(_IMPORTED_LATER)
    while True:
        try:
            packed = requests.get(timeout=_IDLE if later else None if idle else _MEMORY_KEPT)
        except Empty:
            if later:
                import_module(later.pop(0))
            else:
                return_memory()
                idle = True
            continue
        idle, error, value = False, None, None
        try:
            value = desk.answer(*ForkingPickler.loads(packed[_LENGTH:]))  # pyright: ignore[reportAttributeAccessIssue]
        except Exception as failed:
            error = _described(failed)
        pipe.send((int.from_bytes(packed[:_LENGTH], "little"), value, error))
        if urgent:
            urgent = 0
            _lower_priority()


def _lower_priority() -> None:
    """Lower the priority of all threads; on Linux, each has a niceness of its own."""
    for thread in os.listdir("/proc/self/task") if sys.platform == "linux" else ("0",):
        os.setpriority(os.PRIO_PROCESS, int(thread), _NICENESS)


def _read(pipe: Connection, requests: SimpleQueue[bytes]) -> None:
    """Queue requests until the page's process closes the pipe."""
    try:
        while True:
            requests.put(pipe.recv_bytes())
    except (EOFError, OSError):
        os.kill(os.getpid(), signal.SIGKILL)  # does not wait for the main thread
