"""Paths that code writes and reads, from the audit events of the interpreter."""

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
_REMOVING = {"os.remove", "os.rmdir", "os.mkdir", "os.truncate", "shutil.rmtree"}


@dataclass
class Trace:
    """Paths used by code."""

    written: set[Path] = field(default_factory=set)
    """Paths opened for writing, created, renamed, linked or removed."""
    read: set[Path] = field(default_factory=set)
    """Paths opened for reading."""


_traces: list[Trace] = []
_folder = threading.local()
_open = os.open


def _opened(path, flags, mode=0o777, *, dir_fd=None):
    # The event of an opening does not say relative to which folder it is.
    _folder.path = None if dir_fd is None else os.readlink(f"/proc/self/fd/{dir_fd}")
    try:
        return _open(path, flags, mode, dir_fd=dir_fd)
    finally:
        _folder.path = None


def _below(path: object, folder: object) -> Path | None:
    if not isinstance(path, str | bytes | os.PathLike):
        return None
    base = os.readlink(f"/proc/self/fd/{folder}") if isinstance(folder, int) and folder >= 0 else str(folder or "")
    return Path(os.path.normpath(os.path.join(os.getcwd(), base, os.fsdecode(path))))


def _hook(event: str, arguments: tuple) -> None:
    if not _traces:
        return
    found: list[Path | None] = []
    if event == "open":
        path = _below(arguments[0], getattr(_folder, "path", None))
        writes = isinstance(arguments[2], int) and arguments[2] & _WRITING
        for trace in _traces:
            (trace.written if writes else trace.read).update([path] if path else [])
    elif event in ("os.rename", "os.link"):
        found = [_below(arguments[0], arguments[2]), _below(arguments[1], arguments[3])]
    elif event in _REMOVING:
        found = [_below(arguments[0], arguments[-1])]
    for trace in _traces:
        trace.written.update(path for path in found if path is not None)


sys.addaudithook(_hook)


@contextmanager
def traced() -> Iterator[Trace]:
    """Every path that is used in the block."""
    trace = Trace()
    with mock.patch("os.open", _opened):
        _traces.append(trace)
        try:
            yield trace
        finally:
            _traces.remove(trace)


def read_places(trace: Trace, folder: Path) -> list[Path]:
    """Files below a folder that code reads and does not write."""
    found = {path for path in trace.read - trace.written if path.is_relative_to(folder) and path.is_file()}
    return sorted(path.relative_to(folder) for path in found)


def places(trace: set[Path], folder: Path) -> list[Path]:
    """Paths at which entries can be planted in advance: written paths below a folder, and their parent folders.

    Random names are excluded.
    """
    found = {part for path in trace if path.is_relative_to(folder) for part in (path, *path.parents)}
    inside = {path.relative_to(folder) for path in found if path != folder and path.is_relative_to(folder)}
    return sorted(path for path in inside if not any(name.startswith(".carts-") for name in path.parts))
