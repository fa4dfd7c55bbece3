"""What may lie where a project and SQLite's files beside it lie: regular files with one name, or nothing."""

import os
import stat
from pathlib import Path

from ..errors import ProjectError

LOG, JOURNAL = "-wal", "-journal"
_OPEN = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC | getattr(os, "O_NOCTTY", 0)


def beside(path: Path, suffix: str) -> Path:
    """A file of SQLite's beside a project."""
    return path.with_name(path.name + suffix)


def check_files(path: Path) -> bool:
    """Check a project and what lies beside it before anything is opened; whether the project is there.

    Raises:
        ProjectError: something is a link, has a second name, or is no regular file; or a journal of another program is
            there, which SQLite would play back.
        OSError: the folder cannot be read.
    """
    there = _is_there(path)
    log = _is_there(beside(path, LOG))
    if _is_there(beside(path, JOURNAL)):
        raise ProjectError(
            f"{beside(path, JOURNAL)} lies beside the project, and carts makes no such file. Nothing was changed. If "
            "another program changed the project, let it finish; else move that file away."
        )
    if log and not there:
        raise ProjectError(
            f"{beside(path, LOG)} is there without its project {path.name}, which was moved or deleted. Nothing was "
            "changed. Move the project back beside it, or move that file away to begin a new project."
        )
    return there


def open_regular(path: Path, *, write: bool = False) -> int:
    """A descriptor of a regular file with one name; nothing is followed, nothing waited for.

    Raises:
        ProjectError: it is something else.
        OSError: it cannot be opened.
    """
    _is_there(path)
    descriptor = os.open(path, (os.O_RDWR if write else os.O_RDONLY) | _OPEN)
    try:
        _check(os.fstat(descriptor), path)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _is_there(path: Path) -> bool:
    try:
        found = os.stat(path, follow_symlinks=False)
    except FileNotFoundError:
        return False
    _check(found, path)
    return True


def _check(found: os.stat_result, path: Path) -> None:
    if stat.S_ISREG(found.st_mode) and found.st_nlink <= 1:
        return
    kinds = {
        stat.S_IFREG: f"one of {found.st_nlink} names of a file (hard links)",
        stat.S_IFLNK: "a link",
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a pipe",
    }
    raise ProjectError(
        f"{path} is {kinds.get(stat.S_IFMT(found.st_mode), 'a device or socket')}. A project and the files beside it "
        "must be regular files with one name, so that nothing else is written to; nothing was changed. Move it away, "
        "or copy the project to a file of its own."
    )
