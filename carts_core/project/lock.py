"""One writer per project: a lock on the project file itself, which ends with the process, however that ends.

It covers the bytes that SQLite locks, so other programs that use SQLite cannot write either. It belongs to the open
file (F_OFD_SETLK), so closing another descriptor of the file in this process does not end it, as it would end SQLite's.
"""

import errno
import fcntl
import os
import socket
import struct
import sys
from contextlib import suppress
from pathlib import Path

_START, _LENGTH = 0x40000000, 512
"""Bytes of a database on which SQLite's locks lie, whether the file is so long or not."""


def try_lock(descriptor: int) -> bool:
    """Lock an open project file for writing until it is closed; False if somebody else has it open for writing.

    Raises:
        OSError: the file is not open for writing, or its file system knows no locks.
    """
    if sys.platform == "darwin":
        request = struct.pack("qqihh", _START, _LENGTH, 0, fcntl.F_WRLCK, os.SEEK_SET)
    else:
        request = struct.pack("hhqqi4x", fcntl.F_WRLCK, os.SEEK_SET, _START, _LENGTH, 0)
    try:
        fcntl.fcntl(descriptor, fcntl.F_OFD_SETLK, request)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN):
            return False
        raise
    return True


def holder(path: Path) -> str:
    """Who has a project open, for people, as far as this system tells."""
    own = str(os.getpid())
    with suppress(OSError):
        wanted = os.stat(path, follow_symlinks=False)
        for process in sorted(Path("/proc").glob("[0-9]*"), key=lambda folder: folder.name == own):
            with suppress(OSError):
                if any(_is_open_at(entry, wanted) for entry in (process / "fd").iterdir()):
                    return f"process {process.name} on {socket.gethostname()}"
    return "another process"


def _is_open_at(entry: Path, wanted: os.stat_result) -> bool:
    try:
        return os.path.samestat(os.stat(entry), wanted)
    except OSError:
        return False
