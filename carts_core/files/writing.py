"""Atomic writing of files and folders, never through a link, and file locks.

Outputs of several files are written in a hidden staging folder and renamed when complete.
"""

import ctypes
import errno
import fcntl
import itertools
import json
import os
import re
import secrets
import shutil
import stat
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import BinaryIO

import msgspec

from ..errors import OutputError
from ..wording import listed
from .paths import OutputPath, as_output, explained, kind_of, open_below, opened_folder, status

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""Prefixes that spreadsheets interpret as a formula."""


def csv_cell(text: str) -> str:
    """Escape a string for a table cell: an apostrophe prevents spreadsheets from interpreting the string as a formula.

    Numbers are not changed. `text_of_cell` is the inverse.
    """
    risky = text.startswith(_FORMULA) and not _is_number(text)
    return f"'{text}" if risky or text.startswith("'") else text


def text_of_cell(cell: str) -> str:
    """String of a cell written by `csv_cell`."""
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
"""Flag for unnamed temporary files, which are linked when complete, so that a killed process leaves no file; 0 if not
supported.
"""


def write_bytes(path: OutputPath | Path, content: bytes, *, sync: bool = True) -> None:
    """Write a file atomically; missing folders are created.

    Readers see either the complete old or the complete new file, even after a crash of the process or, with `sync`, of
    the machine. If the path is a link, the link is replaced and its target is unchanged.

    Raises:
        OutputError: the file cannot be written, and nothing was changed.
    """
    with output_stream(path, sync=sync) as stream:
        stream.write(content)


def write_text(path: OutputPath | Path, text: str) -> None:
    """Write a string as UTF-8 with `write_bytes`; line ends are kept."""
    write_bytes(path, text.encode())


def indented_json(value: object) -> bytes:
    """Indented JSON of a value; for large values several times faster than `json.dumps` with `indent`."""
    try:
        return msgspec.json.format(msgspec.json.encode(value), indent=1)
    except UnicodeEncodeError:  # Names of files that are not UTF-8 are escaped.
        return json.dumps(value, indent=1).encode()


def write_new(path: OutputPath | Path, content: bytes) -> bool:
    """Write a file unless the path exists; returns whether it was written.

    Exactly one of several concurrent processes writes the file.

    Raises:
        OutputError: the file cannot be written, and nothing was changed.
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
def output_stream(path: OutputPath | Path, *, sync: bool = True) -> Iterator[BinaryIO]:
    """Open a seekable, readable stream that becomes the file if the block succeeds; `sync` and errors as in
    `write_bytes`."""
    output = as_output(path)
    with explained(output), opened_folder(output.parent, make=True) as folder:
        if output.draft:
            with os.fdopen(os.open(output.name, _NEW, _MODE, dir_fd=folder), "w+b") as stream:
                yield stream
            return
        found = status(folder, output.name)
        if found is not None and not (stat.S_ISREG(found.st_mode) or stat.S_ISLNK(found.st_mode)):
            text = f"{output} is {kind_of(found)}, but must be a file. Remove it, or choose another output."
            raise OutputError(text)
        descriptor, temporary = _new_file(folder)
        try:
            with os.fdopen(descriptor, "w+b") as stream:
                yield stream
                stream.flush()
                if sync:
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
        if sync:
            os.fsync(folder)


def write_link(path: OutputPath, target: Path) -> None:
    """Create a symbolic link to an input file in an unpublished folder (see `published`).

    Raises:
        OutputError: the link cannot be created.
    """
    assert path.draft, "links are only part of outputs that are published as a whole"
    with explained(path), opened_folder(path.parent, make=True) as folder:
        os.symlink(os.path.abspath(target), path.name, dir_fd=folder)


def append_line(path: OutputPath | Path, line: bytes, *, sync: bool = True) -> None:
    """Append a line to a file, created if missing, and synchronize the file to disk if `sync`.

    An incomplete last line of a killed process is terminated first.

    Raises:
        OutputError: the file cannot be written, is a link, has a second hard link, or is not a regular file.
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


def synchronize(folder: OutputPath) -> None:
    """Synchronize all files of a folder's file system to disk, such as those written without `sync`.

    Raises:
        OutputError: the folder is missing, or the disk reports an error.
    """
    with explained(folder), opened_folder(folder) as descriptor:
        system = ctypes.CDLL(None, use_errno=True)
        if not hasattr(system, "syncfs"):
            os.sync()
        elif system.syncfs(descriptor) != 0:
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code))


def pipe_stream(path: Path) -> BinaryIO:
    """Open an existing named pipe for writing, unbuffered.

    Raises:
        OutputError: the path is missing or not a pipe, or no program has opened the pipe for reading.
    """
    try:
        if not stat.S_ISFIFO(os.stat(path).st_mode):
            raise OutputError(f"{path} is not a pipe. Create one with `mkfifo`, and give its path.")
        descriptor = os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError as error:
        raise OutputError(f"{path} is missing. Create it with `mkfifo {path}`, and start its reader.") from error
    except OSError as error:
        reason = "no program reads it" if error.errno == errno.ENXIO else error.strerror
        raise OutputError(f"{path} cannot be written to: {reason}. Start its reader first.") from error
    os.set_blocking(descriptor, True)
    return os.fdopen(descriptor, "wb", buffering=0)


def remove_file(path: OutputPath | Path) -> None:
    """Remove a regular file if it exists; `OutputError` for a link, for other kinds of files, and if the file cannot be
    removed."""
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
        OutputError: the file cannot be renamed.
    """
    output = as_output(path)
    with explained(output), opened_folder(output.parent) as folder:
        numbered = (f"{output.name}.damaged-{number}" for number in itertools.count(1))
        free = next(name for name in numbered if status(folder, name) is None)
        os.rename(output.name, free, src_dir_fd=folder, dst_dir_fd=folder)
        os.fsync(folder)
    return output.path.with_name(free)


def holds_file(path: OutputPath | Path) -> bool:
    """Whether the path is a regular file, without following links below its folder."""
    output = as_output(path)
    try:
        with opened_folder(output.parent) as folder:
            found = status(folder, output.name)
    except (OSError, OutputError):
        return False
    return found is not None and stat.S_ISREG(found.st_mode)


def check_own(folder: int, output: OutputPath) -> None:
    """Check that writing or removing an entry does not change another file; `OutputError` otherwise."""
    found = status(folder, output.name)
    if found is None or (stat.S_ISREG(found.st_mode) and found.st_nlink == 1):
        return
    what = "a file with a second hard link" if stat.S_ISREG(found.st_mode) else kind_of(found)
    raise OutputError(f"{output} is {what}, which is never overwritten. Remove it, or choose another output.")


def _new_file(folder: int) -> tuple[int, str | None]:
    """Create an empty file in an open folder; returns its descriptor, and its name or None for an unnamed file."""
    if _NAMELESS:
        # Without support by the file system, the attempt with a name below succeeds or reports the error.
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

    The folder itself is locked, so there is no lock file that could be deleted.

    Args:
        path: the folder.
        wait: wait until other processes have released the lock.

    Raises:
        BusyError: another process holds the lock.
        OutputError: the folder cannot be created, or its file system does not support locks.
    """
    output = path if isinstance(path, OutputPath) else OutputPath(path)
    with explained(output), opened_folder(output, make=True) as folder:
        while not try_lock(folder):
            if not wait:
                text = f"another process is writing to {output}. Wait until it has finished, or choose another output."
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


_MARK = "carts-unfinished.json"
_NAME = re.compile(r"\.carts-[0-9a-f]{32}")
_MAX_MARK_BYTES = 10_000


@dataclass(frozen=True)
class _Mark:
    """Content of the mark file of a staging folder."""

    output: str
    """Name of the output."""
    key: str | None
    """Fingerprint of the inputs of resumable work."""
    inode: int


@dataclass(frozen=True)
class Staging:
    """Locked staging folder."""

    parent: int
    """Descriptor of the parent folder."""
    name: str
    descriptor: int
    mark: _Mark

    def remove(self) -> None:
        """Remove the folder and its contents; links are removed, not followed.

        The mark file is removed last, so that leftovers are found after a kill.
        """
        found = status(self.parent, self.name)
        if found is None or found.st_ino != self.mark.inode:
            return
        for name in os.listdir(self.descriptor):
            if name != _MARK:
                _remove(self.descriptor, name)
        with suppress(OSError):
            if os.listdir(self.descriptor) == [_MARK]:
                os.unlink(_MARK, dir_fd=self.descriptor)
            os.rmdir(self.name, dir_fd=self.parent)

    def close(self) -> None:
        """Release the lock."""
        os.close(self.descriptor)


def make_staging(parent: int, output: str, key: str | None) -> Staging:
    """Create a staging folder in an open folder; `OSError` on failure."""
    while True:
        name = f".carts-{secrets.token_hex(16)}"
        os.mkdir(name, 0o700, dir_fd=parent)
        # Another process may remove the folder while it is empty and unlocked; in this case create another folder.
        with suppress(FileNotFoundError):
            descriptor = open_below(parent, name)
            if try_lock(descriptor):
                mark = _Mark(output, key, os.fstat(descriptor).st_ino)
                staging = Staging(parent, name, descriptor, mark)
                try:
                    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
                    with os.fdopen(os.open(_MARK, flags, 0o600, dir_fd=descriptor), "wb") as stream:
                        stream.write(json.dumps(asdict(mark)).encode())
                except BaseException:  # This happens if the disk is full, for example.
                    staging.remove()
                    staging.close()
                    raise
                return staging
            os.close(descriptor)


def leftovers(parent: int, output: str, besides: Staging) -> Iterator[Staging]:
    """Yield the locked staging folders for the same output whose processes have ended; `BusyError` if a process is
    still running."""
    for name in os.listdir(parent):
        if not _NAME.fullmatch(name) or name == besides.name:
            continue
        try:
            descriptor = open_below(parent, name)
        except OSError:
            continue
        mark = _read_mark(descriptor)
        if mark is None:
            # The process was killed before marking the folder. Only empty folders, and folders with an empty mark, are
            # removed.
            with suppress(OSError):
                if try_lock(descriptor):
                    found = status(descriptor, _MARK)
                    if found is not None and stat.S_ISREG(found.st_mode) and found.st_size == 0:
                        os.unlink(_MARK, dir_fd=descriptor)
                    os.rmdir(name, dir_fd=parent)
        elif mark.output == output:
            if not try_lock(descriptor):
                os.close(descriptor)
                raise BusyError(f"another export to {output} is running. Wait for it, or choose another output.")
            yield Staging(parent, name, descriptor, mark)
            continue
        os.close(descriptor)


def _remove(folder: int, name: str) -> None:
    """Remove a file, link or folder in an open folder, ignoring errors."""
    with suppress(OSError):
        found = status(folder, name)
        if found is not None and stat.S_ISDIR(found.st_mode):
            shutil.rmtree(name, ignore_errors=True, dir_fd=folder)
        else:
            os.unlink(name, dir_fd=folder)


def _read_mark(folder: int) -> _Mark | None:
    """Read the mark in an open folder; None without a valid mark."""
    own = os.fstat(folder)
    try:
        descriptor = os.open(_MARK, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=folder)
        with os.fdopen(descriptor, "rb") as stream:
            mark = _Mark(**json.loads(stream.read(_MAX_MARK_BYTES)))
    except (OSError, ValueError, TypeError, RecursionError):
        return None
    return mark if mark.inode == own.st_ino and own.st_uid == os.geteuid() else None


MARKER = "export.json"
"""Name of the file that marks a folder as an export; other folders are never replaced."""
_PROJECTS = (".carts", "_exports")
"""Endings of projects and of the folders with their exports, which are not deleted with a replaced folder."""
_OLD = "carts-replaced"
"""Temporary name of the replaced output, between two renames."""


@contextmanager
def published(
    target: OutputPath | Path,
    *,
    overwrite: bool = False,
    key: str | None = None,
    pause: Callable[[], None] | None = None,
) -> Iterator[OutputPath]:
    """Write an output that replaces `target` when the block ends without an exception.

    The output is written in a hidden folder with a random name beside `target`. If the block fails or is interrupted,
    this folder is removed. If the process is killed, the next call for the same target removes the folder.

    Args:
        target: file or folder to create, which must not be a link. An empty folder counts as absent.
        overwrite: replace an existing file, or a folder written by an export without a project in it.
        key: fingerprint of the inputs. If given, partial output is kept if the block fails, and a later call with the
            same key continues with the partial output.
        pause: called after each file is synchronized to disk, before the target is replaced; an exception counts as one
            of the block.

    Yields:
        Path with the target's name, for a file or a folder; it does not exist yet without `key`.

    Raises:
        OutputError: the target exists and may not be replaced, another process is writing it, or it cannot be written.
    """
    output = as_output(target)
    with explained(output), opened_folder(output.parent, make=True) as folder:
        staging = _take_staging(folder, output, key)
        try:
            _check_free(folder, output, overwrite)
            yield replace(output, names=(*output.names[:-1], staging.name, output.name), draft=key is None)
            _sync(staging.descriptor, output.name, pause)
            _check_free(folder, output, overwrite)
            _move(staging, folder, output.name)
            os.fsync(folder)
            key = None
        finally:
            if key is None or status(staging.descriptor, output.name) is None:
                staging.remove()
            staging.close()


@contextmanager
def published_file(target: OutputPath | Path, *, overwrite: bool = False) -> Iterator[OutputPath]:
    """Like `published`, for a single file that is written by `write_bytes` or `output_stream`."""
    output = as_output(target)
    with explained(output), opened_folder(output.parent, make=True) as folder:
        _check_free(folder, output, overwrite)
        yield output


def _take_staging(folder: int, output: OutputPath, key: str | None) -> Staging:
    """Create a staging folder, or take a remaining folder with the same key. Other remaining folders are removed."""
    taken = make_staging(folder, output.name, key)
    try:
        for left in leftovers(folder, output.name, taken):
            if status(left.descriptor, _OLD) is not None and status(folder, output.name) is None:
                # The earlier output is here if a process was killed between the two renames of `_move`.
                os.rename(_OLD, output.name, src_dir_fd=left.descriptor, dst_dir_fd=folder)
            reused = key is not None and left.mark.key == key
            needless, taken = (taken, left) if reused else (left, taken)
            needless.remove()
            needless.close()
    except BaseException:
        taken.remove()
        taken.close()
        raise
    return taken


def _check_free(folder: int, output: OutputPath, overwrite: bool) -> None:
    found = status(folder, output.name)
    if found is None:
        return
    if stat.S_ISDIR(found.st_mode):
        if not (entries := _entries(folder, output.name)):
            return
        with _below(folder, output.name) as inside:
            marker = status(inside, MARKER)
        if marker is None or not stat.S_ISREG(marker.st_mode):
            raise OutputError(
                f"{output} is a folder without {MARKER}; only folders written by an export are replaced. Choose a new "
                "folder."
            )
        if overwrite and (kept := sorted(name for name in entries if name.endswith(_PROJECTS))):
            raise OutputError(
                f"{output} contains {listed(kept)}, which --overwrite would delete: projects (.carts) hold your edits. "
                "Move them out of this folder, or choose another output."
            )
    elif not stat.S_ISREG(found.st_mode):
        raise OutputError(f"{output} is {kind_of(found)}, which is never replaced. Choose another output.")
    if not overwrite:
        raise OutputError(f"{output} exists. Add --overwrite to replace it, or choose another output.")


def _entries(folder: int, name: str) -> list[str]:
    with _below(folder, name) as descriptor:
        return os.listdir(descriptor)


@contextmanager
def _below(folder: int, name: str) -> Iterator[int]:
    descriptor = open_below(folder, name)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _sync(folder: int, name: str, pause: Callable[[], None] | None) -> None:
    """Synchronize an output in an open folder to disk, including its content; `pause` is called after each file."""
    found = status(folder, name)
    if found is not None and not stat.S_ISDIR(found.st_mode):
        _sync_file(folder, name)
        return
    for _, _, files, descriptor in os.fwalk(name, dir_fd=folder):
        for file in files:
            found = status(descriptor, file)
            if found is not None and not stat.S_ISLNK(found.st_mode):
                _sync_file(descriptor, file)
                if pause is not None:
                    pause()
        os.fsync(descriptor)


def _sync_file(folder: int, name: str) -> None:
    file = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=folder)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def _move(staging: Staging, folder: int, name: str) -> None:
    inside = staging.descriptor
    found = status(folder, name)
    if found is None or not stat.S_ISDIR(found.st_mode) or not _entries(folder, name):
        os.replace(name, name, src_dir_fd=inside, dst_dir_fd=folder)
    elif not _exchanged(inside, folder, name):
        os.rename(name, _OLD, src_dir_fd=folder, dst_dir_fd=inside)
        try:
            os.rename(name, name, src_dir_fd=inside, dst_dir_fd=folder)
        except OSError:
            os.rename(_OLD, name, src_dir_fd=inside, dst_dir_fd=folder)
            raise


def _exchanged(one: int, other: int, name: str) -> bool:
    """Exchange two entries of the same name in two open folders atomically, if the system supports it."""
    if not sys.platform.startswith("linux"):
        return False
    exchange = 2  # RENAME_EXCHANGE of renameat2(2)
    rename = getattr(ctypes.CDLL(None), "renameat2", None)
    return rename is not None and rename(one, os.fsencode(name), other, os.fsencode(name), exchange) == 0
