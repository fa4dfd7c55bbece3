"""Folders that are opened name by name, so that no link is followed."""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import OutputError
from .paths import OutputPath

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC


@contextmanager
def explained(path: object) -> Iterator[None]:
    """Turn errors of the operating system into `OutputError`."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{path} cannot be written ({error.strerror or error}). "
            "Nothing was changed there. Make room, or name a folder you may write to."
        ) from error


@contextmanager
def opened_folder(path: OutputPath, *, make: bool = False) -> Iterator[int]:
    """A descriptor of the folder at `path`.

    Args:
        path: links are followed on the way to `path.folder` only.
        make: make what is missing.

    Raises:
        OutputError: something below `path.folder` is a link, or no folder.
        OSError: it is not there, or may not be opened.
    """
    if make:
        _make(path.folder.absolute())
    descriptor = os.open(path.folder, _FOLDER)
    try:
        for number, name in enumerate(path.names, start=1):
            below = _step(descriptor, name, path.folder.joinpath(*path.names[:number]), make)
            os.close(descriptor)
            descriptor = below
        yield descriptor
    finally:
        os.close(descriptor)


def open_below(folder: int, name: str) -> int:
    """A descriptor of the folder `name` in an open one.

    Raises:
        OSError: it is not there, a link, or no folder.
    """
    return os.open(name, _FOLDER | os.O_NOFOLLOW, dir_fd=folder)


def status(folder: int, name: str) -> os.stat_result | None:
    """What lies under `name` in an open folder, a link for itself; None if nothing does."""
    try:
        return os.stat(name, dir_fd=folder, follow_symlinks=False)
    except FileNotFoundError:
        return None


def kind_of(found: os.stat_result) -> str:
    """What something is, for people."""
    names = {stat.S_IFLNK: "a link", stat.S_IFDIR: "a folder", stat.S_IFREG: "a file", stat.S_IFIFO: "a pipe"}
    return names.get(stat.S_IFMT(found.st_mode), "a device or socket")


def _step(folder: int, name: str, path: Path, make: bool) -> int:
    if make:
        with suppress(FileExistsError):
            os.mkdir(name, dir_fd=folder)
            os.fsync(folder)
    try:
        return open_below(folder, name)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.ENOTDIR):
            raise
        found = status(folder, name)
        raise OutputError(
            f"{path} is {kind_of(found) if found else 'gone'}, where a folder is needed; what is written is never led "
            "elsewhere by a link. Nothing was changed there. Remove it, or name another output."
        ) from error


def _make(folder: Path) -> None:
    """Make a folder that a person named, and those above it, and have their names on disk."""
    if folder.is_dir():
        return
    _make(folder.parent)
    with suppress(FileExistsError):
        os.mkdir(folder)
        descriptor = os.open(folder.parent, _FOLDER)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
