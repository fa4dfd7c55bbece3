"""Hidden folders beside an output, in which it is written before it is whole: found again after a kill, and removed.

A staging folder has a random name and is made exclusively, so nobody can have planted it. A mark inside names the
output, and the folder's own inode: a copy, or one that came with a recording, is not taken for ours and stays.
"""

import json
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass

from .folders import open_below, status
from .locks import BusyError, try_lock

_MARK = "carts-unfinished.json"
_NAME = re.compile(r"\.carts-[0-9a-f]{32}")
_MOST_MARK_BYTES = 10_000


@dataclass(frozen=True)
class _Mark:
    """What a staging folder says about itself."""

    output: str
    """Name of what it becomes."""
    key: str | None
    """What work that can be gone on with was made from."""
    inode: int


@dataclass(frozen=True)
class Staging:
    """A locked staging folder."""

    parent: int
    """Descriptor of the folder that it lies in."""
    name: str
    descriptor: int
    mark: _Mark

    def remove(self) -> None:
        """Remove it with all that it holds; links in it are removed, not followed.

        The mark goes last, so what a kill leaves of it is found again.
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
        """Let go of it."""
        os.close(self.descriptor)


def make_staging(parent: int, output: str, key: str | None) -> Staging:
    """A new staging folder in an open folder.

    Raises:
        OSError: it cannot be made.
    """
    while True:
        name = f".carts-{secrets.token_hex(16)}"
        os.mkdir(name, 0o700, dir_fd=parent)
        # Somebody who tidies up may take it away while it is empty and not locked: then make another.
        with suppress(FileNotFoundError):
            descriptor = open_below(parent, name)
            if try_lock(descriptor):
                mark = _Mark(output, key, os.fstat(descriptor).st_ino)
                staging = Staging(parent, name, descriptor, mark)
                try:
                    _write_mark(staging)
                except BaseException:  # Such as that of a full disk.
                    staging.remove()
                    staging.close()
                    raise
                return staging
            os.close(descriptor)


def leftovers(parent: int, output: str, besides: Staging) -> Iterator[Staging]:
    """Staging folders of ours for the same output, locked, whose processes have ended.

    Raises:
        BusyError: a process that has not ended writes the same output.
    """
    for name in os.listdir(parent):
        if not _NAME.fullmatch(name) or name == besides.name:
            continue
        try:
            descriptor = open_below(parent, name)
        except OSError:
            continue
        mark = _read_mark(descriptor)
        if mark is None:
            # Killed before it was marked. This removes empty folders only, and such with an empty mark.
            with suppress(OSError):
                if try_lock(descriptor):
                    found = status(descriptor, _MARK)
                    if found is not None and stat.S_ISREG(found.st_mode) and found.st_size == 0:
                        os.unlink(_MARK, dir_fd=descriptor)
                    os.rmdir(name, dir_fd=parent)
        elif mark.output == output:
            if not try_lock(descriptor):
                os.close(descriptor)
                raise BusyError(f"another export to {output} is running. Wait for it, or name another output.")
            yield Staging(parent, name, descriptor, mark)
            continue
        os.close(descriptor)


def _remove(folder: int, name: str) -> None:
    """Remove a file, a link or a folder in an open folder, as far as it can be."""
    with suppress(OSError):
        found = status(folder, name)
        if found is not None and stat.S_ISDIR(found.st_mode):
            shutil.rmtree(name, ignore_errors=True, dir_fd=folder)
        else:
            os.unlink(name, dir_fd=folder)


def _write_mark(staging: Staging) -> None:
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    with os.fdopen(os.open(_MARK, flags, 0o600, dir_fd=staging.descriptor), "wb") as stream:
        stream.write(json.dumps(asdict(staging.mark)).encode())


def _read_mark(folder: int) -> _Mark | None:
    """The mark in an open folder; None if it has none that is its own."""
    own = os.fstat(folder)
    try:
        descriptor = os.open(_MARK, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=folder)
        with os.fdopen(descriptor, "rb") as stream:
            mark = _Mark(**json.loads(stream.read(_MOST_MARK_BYTES)))
    except (OSError, ValueError, TypeError, RecursionError):
        return None
    return mark if mark.inode == own.st_ino and own.st_uid == os.geteuid() else None
