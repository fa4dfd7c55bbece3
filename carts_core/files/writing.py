"""Atomic writing of files, never through a link, and file locks."""

import fcntl
import itertools
import os
import secrets
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from ..errors import OutputError
from .paths import OutputPath, as_output, explained, kind_of, opened_folder, status

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""Prefixes that spreadsheets interpret as a formula."""


def csv_cell(text: str) -> str:
    """Escape a text for a table cell: an apostrophe keeps spreadsheets from interpreting it as a formula.

    Numbers are not changed. `text_of_cell` is the inverse.
    """
    risky = text.startswith(_FORMULA) and not _is_number(text)
    return f"'{text}" if risky or text.startswith("'") else text


def text_of_cell(cell: str) -> str:
    """Text of a cell written by `csv_cell`."""
    return cell.removeprefix("'")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return text.isascii() and text[-1:].isalnum()


_NEW = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_MODE = 0o666
_OWN_DESCRIPTORS = Path("/proc/self/fd")
_NAMELESS = getattr(os, "O_TMPFILE", 0) if _OWN_DESCRIPTORS.is_dir() else 0
"""Flag for unnamed temporary files, which are linked when complete, so that a kill leaves no file; 0 if not supported.
"""


def write_bytes(path: OutputPath | Path, content: bytes) -> None:
    """Write a file atomically; missing folders are created.

    Readers see either the complete old file or the complete new one, even after a crash of the process or machine. If
    the path is a link, the link is replaced and its target is unchanged.

    Raises:
        OutputError: the file cannot be written; nothing is changed then.
    """
    with output_stream(path) as stream:
        stream.write(content)


def write_text(path: OutputPath | Path, text: str) -> None:
    """Write a text in UTF-8 with `write_bytes`; line ends are kept."""
    write_bytes(path, text.encode())


def write_new(path: OutputPath | Path, content: bytes) -> bool:
    """Write a file unless the path exists; returns whether it was written.

    Exactly one of several concurrent processes writes the file.

    Raises:
        OutputError: it cannot be written; nothing is changed then.
    """
    output = as_output(path)
    with explained(output), opened_folder(output.parent, make=True) as folder:
        descriptor, temporary = _new_file(folder)
        try:
            with os.fdopen(descriptor, "w+b") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
                if temporary is None:
                    _link(stream.fileno(), folder, output.name)
                else:
                    os.link(temporary, output.name, src_dir_fd=folder, dst_dir_fd=folder, follow_symlinks=False)
        except FileExistsError:
            return False
        finally:
            if temporary is not None:
                os.unlink(temporary, dir_fd=folder)
        os.fsync(folder)
    return True


@contextmanager
def output_stream(path: OutputPath | Path) -> Iterator[BinaryIO]:
    """Open a seekable, readable stream that becomes the file if the block succeeds; errors as in `write_bytes`."""
    output = as_output(path)
    with explained(output), opened_folder(output.parent, make=True) as folder:
        if output.draft:
            with os.fdopen(os.open(output.name, _NEW, _MODE, dir_fd=folder), "w+b") as stream:
                yield stream
            return
        found = status(folder, output.name)
        if found is not None and not (stat.S_ISREG(found.st_mode) or stat.S_ISLNK(found.st_mode)):
            text = f"{output} is {kind_of(found)}, where a file is to be. Remove it, or name another output."
            raise OutputError(text)
        descriptor, temporary = _new_file(folder)
        try:
            with os.fdopen(descriptor, "w+b") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
                if temporary is None:
                    temporary = _random_name()
                    _link(stream.fileno(), folder, temporary)
            os.replace(temporary, output.name, src_dir_fd=folder, dst_dir_fd=folder)
        except BaseException:
            if temporary is not None:
                with suppress(FileNotFoundError):
                    os.unlink(temporary, dir_fd=folder)
            raise
        os.fsync(folder)


def append_line(path: OutputPath | Path, line: bytes, *, sync: bool = True) -> None:
    """Append a line to a file, created if missing, and if `sync` is set synchronize it to disk.

    An incomplete last line, left by a killed process, is terminated first.

    Raises:
        OutputError: it cannot be written, is a link, has a second hard link, or is not a regular file.
    """
    output = as_output(path)
    flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    with explained(output), opened_folder(output.parent, make=True) as folder:
        check_own(folder, output)
        with os.fdopen(os.open(output.name, flags, _MODE, dir_fd=folder), "ab") as stream:
            length = os.fstat(stream.fileno()).st_size
            torn = length > 0 and os.pread(stream.fileno(), 1, length - 1) != b"\n"
            stream.write(b"\n" * torn + line + b"\n")
            stream.flush()
            if sync:
                os.fsync(stream.fileno())
        if length == 0 and sync:
            os.fsync(folder)


def remove_file(path: OutputPath | Path) -> None:
    """Remove a regular file if it exists; `OutputError` if it is a link, not a file, or cannot be removed."""
    output = as_output(path)
    with explained(output):
        try:
            with opened_folder(output.parent) as folder:
                check_own(folder, output)
                os.unlink(output.name, dir_fd=folder)
                os.fsync(folder)
        except FileNotFoundError:
            return


def set_aside(path: OutputPath | Path) -> Path:
    """Rename a damaged file to `NAME.damaged-1`, or the next free number, so that it is not overwritten.

    Returns:
        New path of the file.

    Raises:
        OutputError: it cannot be renamed.
    """
    output = as_output(path)
    with explained(output), opened_folder(output.parent) as folder:
        numbered = (f"{output.name}.damaged-{number}" for number in itertools.count(1))
        free = next(name for name in numbered if status(folder, name) is None)
        os.rename(output.name, free, src_dir_fd=folder, dst_dir_fd=folder)
        os.fsync(folder)
    return output.path.with_name(free)


def holds_file(path: OutputPath | Path) -> bool:
    """Whether the path is a regular file, reached without a link."""
    output = as_output(path)
    try:
        with opened_folder(output.parent) as folder:
            found = status(folder, output.name)
    except (OSError, OutputError):
        return False
    return found is not None and stat.S_ISREG(found.st_mode)


def check_own(folder: int, output: OutputPath) -> None:
    """Check that writing or removing an entry changes no other file; `OutputError` otherwise."""
    found = status(folder, output.name)
    if found is None or (stat.S_ISREG(found.st_mode) and found.st_nlink == 1):
        return
    what = "a file with a second name (a hard link)" if stat.S_ISREG(found.st_mode) else kind_of(found)
    raise OutputError(f"{output} is {what}, which is not written into. Remove it, or name another output.")


def _new_file(folder: int) -> tuple[int, str | None]:
    """Create an empty file in an open folder; returns its descriptor, and its name or None for an unnamed file."""
    if _NAMELESS:
        # On file systems without support, the attempt with a name below succeeds or reports the error.
        with suppress(OSError):
            return os.open(".", _NAMELESS | os.O_RDWR | os.O_CLOEXEC, _MODE, dir_fd=folder), None
    name = _random_name()
    return os.open(name, _NEW, _MODE, dir_fd=folder), name


def _link(descriptor: int, folder: int, name: str) -> None:
    """Link an unnamed file into an open folder."""
    os.link(_OWN_DESCRIPTORS / str(descriptor), name, dst_dir_fd=folder, follow_symlinks=True)


def _random_name() -> str:
    return f".carts-{secrets.token_hex(16)}.part"


_PAUSE = 0.1
"""Interval between attempts to take a lock [s]."""


class BusyError(OutputError):
    """Raised if another process is writing to the output."""


@contextmanager
def locked_folder(path: OutputPath | Path, *, wait: bool = False) -> Iterator[None]:
    """Lock a folder, created if missing, against other CaRTS processes.

    The lock is on the folder itself, so there is no lock file that could be deleted.

    Args:
        path: the folder.
        wait: wait until other processes have released the lock.

    Raises:
        BusyError: another process holds it.
        OutputError: the folder cannot be created, or its file system does not support locks.
    """
    output = path if isinstance(path, OutputPath) else OutputPath(path)
    with explained(output), opened_folder(output, make=True) as folder:
        while not try_lock(folder):
            if not wait:
                text = f"another process is writing to {output}. Wait until it has ended, or name another output."
                raise BusyError(text)
            time.sleep(_PAUSE)
        yield


def try_lock(descriptor: int) -> bool:
    """Lock an open file or folder until it is closed; False if it is already locked. `OSError` if locks are not
    supported.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
