"""Locks that end with the process, however that ends."""

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import OutputError
from .folders import explained, opened_folder
from .paths import OutputPath, as_output
from .writing import check_own

_PAUSE = 0.1
"""Between looks at a lock that others hold [s]."""

_SIGNATURE = b"carts lock: "
"""What the content of a lock file of ours begins with."""


class BusyError(OutputError):
    """Another process writes there at present."""


@contextmanager
def locked_folder(path: OutputPath | Path) -> Iterator[None]:
    """Hold a folder, made if it is missing, so that no other process of ours writes to it at the same time.

    The lock is on the folder itself: no file is made for it, and none can be deleted.

    Raises:
        BusyError: another process holds it.
        OutputError: the folder cannot be made, or its file system knows no locks.
    """
    output = path if isinstance(path, OutputPath) else OutputPath(path)
    with explained(output), opened_folder(output, make=True) as folder:
        if not try_lock(folder):
            raise BusyError(f"another process is writing to {output}. Wait until it has ended, or name another output.")
        yield


@contextmanager
def one_after_another(path: OutputPath | Path) -> Iterator[None]:
    """Hold a folder, made if it is missing, after waiting for all others that hold it like this.

    Raises:
        OutputError: the folder cannot be made, or its file system knows no locks.
    """
    output = path if isinstance(path, OutputPath) else OutputPath(path)
    with explained(output), opened_folder(output, make=True) as folder:
        while not try_lock(folder):
            time.sleep(_PAUSE)
        yield


def open_lock(path: OutputPath | Path) -> int:
    """A descriptor of a lock file, made if it is missing; its content is never changed by opening it.

    Raises:
        OSError: it cannot be opened or made.
        OutputError: it is a link, has a second name, or is no regular file.
    """
    output = as_output(path)
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    with opened_folder(output.parent) as folder:
        check_own(folder, output)
        return os.open(output.name, flags, 0o666, dir_fd=folder)


def try_lock(descriptor: int) -> bool:
    """Lock an open file or folder until it is closed; False if another process, or another opening, holds it.

    Raises:
        OSError: the file system knows no locks.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def sign_lock(descriptor: int, holder: str) -> None:
    """Say in a lock file who holds it, unless the file holds something that we did not write.

    On a full disk nobody is named; the lock holds all the same.
    """
    before = os.pread(descriptor, len(_SIGNATURE), 0)
    if before and before != _SIGNATURE:
        return
    with suppress(OSError):
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, _SIGNATURE + holder.encode(), 0)


def lock_holder(descriptor: int) -> str | None:
    """Who signed a lock file; None if nobody did."""
    content = os.pread(descriptor, 1000, 0)
    return content.removeprefix(_SIGNATURE).decode(errors="replace") if content.startswith(_SIGNATURE) else None
