"""Decoding of untrusted files in a child process with limited memory and processor time.

Library decoders may need unlimited memory or time for a small file with repeated references, false sizes or
compression. A decoder is a module-level function of this package that imports neither torch nor the rest of the
application. It runs in a separate interpreter through `decoded`; its arguments and result are plain values, paths and
arrays.

The child exits when its parent does.
"""

import atexit
import contextlib
import errno
import importlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from .. import errors
from ..errors import CartsError
from ..stopping import end_with_parent
from ..wording import shortened
from .reading import GIB, MIB, RefusedFileError

_SECONDS, _SECONDS_PER_MIB = 2.5, 0.2
_MEMORY, _MEMORY_PER_BYTE = 320 * MIB, 8
_COUNTED = 128 * MIB
"""File size up to which the memory limit of a decoder grows with the file size [bytes]; larger files are read in
parts."""
_PATIENCE = 20
"""Wall-clock timeout as a multiple of the processor time limit, for busy machines."""
_IDLE = 10.0
_MAX_IDLE_WORKERS = 4
_MAX_FILE_BYTES = GIB
"""Maximum size of a library's temporary file [bytes], in addition to a hundred times the size of the decoded file."""
_ARRAY, _PATH = 1, 2
_ENVIRONMENT = {
    # Thread pools and arenas reserve address space, which counts as memory.
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "ARROW_DEFAULT_MEMORY_POOL": "system",
    "MALLOC_ARENA_MAX": "2",
}


@dataclass(frozen=True)
class Limits:
    """Resource limits of a call, in addition to the resources of the interpreter and imported libraries."""

    seconds: float = _SECONDS
    """Processor time [s]."""
    memory: int = _MEMORY
    """Memory [bytes]."""
    written: int = _MAX_FILE_BYTES
    """Maximum size of a temporary file [bytes]."""

    @staticmethod
    def of(path: Path, *, seconds_per_mib: float = _SECONDS_PER_MIB) -> "Limits":
        """Limits for a file or folder, in proportion to its size; `seconds_per_mib` of processor time [s/MiB]."""
        files = [path] if not path.is_dir() else path.iterdir()
        size = sum(file.stat().st_size for file in files if file.is_file())
        return Limits(
            _SECONDS + seconds_per_mib * size / MIB,
            _MEMORY + _MEMORY_PER_BYTE * min(size, _COUNTED),
            _MAX_FILE_BYTES + 100 * size,
        )


class DecodingLimitError(CartsError, ValueError):
    """Decoding exceeds the memory or time limit."""


def decoded(function: Callable[..., Any], path: Path, *arguments: Any) -> Any:
    """Run a decoder on a file in a child process within the limits `Limits.of(path)`; returns its result.

    Args:
        function: decoder, at module level in this package. The table `LIBRARIES` of its module maps function names to
            libraries that are imported before memory is counted.
        path: first argument, a file or folder.
        arguments: further arguments.

    Raises:
        OSError, CartsError: as raised by the decoder.
        DecodingLimitError: the decoder needs more memory or time than the limits.
        ValueError: any other error of the decoder.
    """
    return called(function, path, *arguments, limits=Limits.of(path))


def called(function: Callable[..., Any], *arguments: Any, limits: Limits) -> Any:
    """Like `decoded`, with given limits."""
    decoder = acquire()
    try:
        return decoder.call(function, *arguments, limits=limits)
    finally:
        release(decoder)


def acquire() -> "Decoder":
    """Acquire a decoder for several calls that share open files; an idle one if available."""
    with _LOCK:
        return _IDLE_DECODERS.pop() if _IDLE_DECODERS else Decoder()


def release(decoder: "Decoder") -> None:
    """Return an acquired decoder to the pool, or close it if the pool is full."""
    with _LOCK:
        if len(_IDLE_DECODERS) < _MAX_IDLE_WORKERS:
            _IDLE_DECODERS.append(decoder)
            return
    decoder.close()


def prepare() -> None:
    """Start a child process in advance, for a faster first call."""
    decoder = Decoder()
    decoder.start()
    release(decoder)


class Decoder:
    """Child process that runs decoders sequentially. It is started on the first call, and restarted after a failure.

    Decoders may keep files open between calls. Not thread-safe.
    """

    def __init__(self, *, idle: float = _IDLE) -> None:
        """`idle`: time after which an idle child exits [s]."""
        self._idle = idle
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None
        self._folder = ""

    def call(self, function: Callable[..., Any], *arguments: Any, limits: Limits) -> Any:
        """Run a function in the child and return its result; errors are those of `decoded`."""
        request = _packed([os.getcwd(), function.__module__, function.__qualname__, arguments, *vars(limits).values()])
        try:
            if (reply := self._reply(request, limits)) is None:
                # The idle child exited while the request was sent.
                reply = self._reply(request, limits)
        except BaseException:
            self.close()
            raise
        if reply is None:
            raise ValueError("its decoder process cannot be started")
        kind, *values = reply
        if kind == "result":
            return values[0]
        if kind == "system":
            raise OSError(*values[:2], *map(str, values[2:]))  # Python selects the subclass by errno.
        if kind == "memory":
            self.close()
            raise _needs_memory(limits)
        raise _ERRORS.get(kind, ValueError)(*values)

    def close(self) -> None:
        """Terminate the child and remove its temporary files."""
        process, pipe, folder = self._process, self._pipe, self._folder
        self._process, self._pipe = None, None
        if pipe is not None:
            pipe.close()
        if process is not None:
            process.kill()
            process.wait()
            shutil.rmtree(folder, ignore_errors=True)

    def _reply(self, request: bytes, limits: Limits) -> Any:
        """Receive the child's reply; None if the child exited before it received the request. Errors as in
        `decoded`."""
        self.start()
        assert self._process is not None and self._pipe is not None
        patience = limits.seconds * _PATIENCE
        try:
            self._pipe.send_bytes(request)
            if not self._pipe.poll(patience):
                self.close()
                raise DecodingLimitError(f"decoding it takes longer than {patience:.0f} s")
            return _unpacked(self._pipe.recv_bytes())
        except (EOFError, ConnectionError):
            status = self._process.wait()
            self.close()
        if status == 0:
            return None
        if -status == signal.SIGXCPU:
            raise DecodingLimitError(f"decoding it takes longer than {limits.seconds:.0f} s")
        if -status in (signal.SIGKILL, signal.SIGABRT):
            raise _needs_memory(limits)
        raise ValueError(f"its decoder process ended with status {status}; the file is damaged or malicious")

    def start(self) -> None:
        """Start the child unless it is running."""
        if self._process is not None:
            return
        here, there = Pipe()
        self._folder = tempfile.mkdtemp(prefix="carts-decoding-")
        paths = [os.path.abspath(path) for path in sys.path]
        start = "import sys; sys.path[:] = sys.argv[4:]; from carts_core.files.decoding import serve; serve()"
        with there:
            self._process = (
                _spawner()
                .submit(
                    subprocess.Popen,
                    [sys.executable, "-P", "-c", start, str(os.getpid()), str(there.fileno()), str(self._idle), *paths],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    pass_fds=[there.fileno()],
                    env={**os.environ, **_ENVIRONMENT, "TMPDIR": self._folder},
                )
                .result()
            )
        self._pipe = here


_LOCK = threading.Lock()
_IDLE_DECODERS: list[Decoder] = []
_ERRORS: dict[str, type[Exception]] = {
    **{name: value for name, value in vars(errors).items() if isinstance(value, type)},
    "RefusedFileError": RefusedFileError,
    "DecodingLimitError": DecodingLimitError,
}


@atexit.register
def _end() -> None:
    for decoder in _IDLE_DECODERS:
        decoder.close()
    _IDLE_DECODERS.clear()


@cache
def _spawner() -> ThreadPoolExecutor:
    """Executor whose thread starts all children, since a child is terminated when the thread that started it ends."""
    return ThreadPoolExecutor(1, "carts-decoding")


def _forget() -> None:
    """Discard the parent's thread and children after a fork."""
    _IDLE_DECODERS.clear()
    _spawner.cache_clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


def serve() -> None:
    """Entry point of the child; the command-line arguments are the parent's process id, a pipe and the maximum idle
    time [s].
    """
    parent, descriptor, idle = sys.argv[1:4]
    end_with_parent(int(parent), signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent.
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with Connection(int(descriptor)) as pipe, contextlib.suppress(EOFError, ConnectionError):
        while pipe.poll(float(idle)):
            pipe.send_bytes(_answer(pipe.recv_bytes()))


def _answer(request: bytes) -> bytes:
    folder, module, name, arguments, seconds, memory, written = _unpacked(request)
    try:
        os.chdir(folder)  # Relative paths refer to the working directory of the parent.
        for limit in (resource.RLIMIT_CPU, resource.RLIMIT_AS):
            # Without this reset, the limits of the previous call would apply to imports.
            _, most = resource.getrlimit(limit)
            resource.setrlimit(limit, (most, most))
        home = importlib.import_module(module)
        for library in getattr(home, "LIBRARIES", {}).get(name, ()):
            importlib.import_module(library)
        _limit(seconds, memory, written)
        return _packed(["result", getattr(home, name)(*arguments)])
    except Exception as error:
        return _packed(_described(error))


def _described(error: Exception) -> list[Any]:
    """Class name and arguments of an exception; exceptions of libraries become `ValueError`."""
    # Extension modules that run out of memory may return without setting an exception, which causes a `SystemError`.
    if isinstance(error, MemoryError | SystemError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return ["memory"]
    if isinstance(error, CartsError):
        return [type(error).__name__, str(error)]
    if isinstance(error, OSError):
        named = [] if error.filename is None else [Path(str(error.filename))]
        return ["system", error.errno or 0, error.strerror or str(error), *named]
    text = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
    return ["ValueError", shortened(text, 1000).encode(errors="backslashreplace").decode()]


def _limit(seconds: float, memory: int, written: int) -> None:
    used = int(time.process_time() + 1)
    resource.setrlimit(resource.RLIMIT_CPU, (used + int(seconds), resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_FSIZE, (written, resource.RLIM_INFINITY))
    with contextlib.suppress(OSError, ValueError):  # Only Linux has this file and limits the address space.
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + memory, resource.RLIM_INFINITY))


def _needs_memory(limits: Limits) -> DecodingLimitError:
    return DecodingLimitError(f"decoding it needs more than {limits.memory // MIB} MiB of memory")


def _packed(value: Any) -> bytes:
    return msgspec.msgpack.encode(value, enc_hook=_pack)


def _pack(value: Any) -> Any:
    if isinstance(value, Path):
        return msgspec.msgpack.Ext(_PATH, os.fsencode(value))
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray) and value.dtype.kind == "O":
        return value.tolist()
    if isinstance(value, np.ndarray):
        head = msgspec.msgpack.encode([value.dtype.str, value.shape])
        return msgspec.msgpack.Ext(_ARRAY, len(head).to_bytes(4, "little") + head + value.tobytes())
    raise TypeError(f"a {type(value).__name__} cannot be passed between processes")


def _unpacked(data: bytes) -> Any:
    return msgspec.msgpack.decode(data, ext_hook=_unpack)


def _unpack(code: int, data: memoryview) -> Any:
    if code == _PATH:
        return Path(os.fsdecode(bytes(data)))
    end = 4 + int.from_bytes(data[:4], "little")
    kind, shape = msgspec.msgpack.decode(data[4:end])
    return np.frombuffer(data[end:], kind).reshape(shape).copy()
