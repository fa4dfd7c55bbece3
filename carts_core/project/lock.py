"""One writer per project: a lock that ends with the process, however that ends."""

import fcntl
import os
import socket
from contextlib import suppress
from pathlib import Path


class WriterLock:
    """The right to write to a project, held on a small file beside it. Made by `acquire`."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self._path = path
        self._descriptor = descriptor

    @staticmethod
    def acquire(path: Path) -> "WriterLock | None":
        """Take the lock; None if somebody holds it.

        Raises:
            OSError: the file cannot be made, or its file system knows no locks.
        """
        while True:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # Whoever held the lock before may have removed the file between our two calls: then lock the new one.
                if _is_at(path, descriptor):
                    _sign(descriptor)
                    return WriterLock(path, descriptor)
            except BlockingIOError:
                os.close(descriptor)
                return None
            except BaseException:
                os.close(descriptor)
                raise
            os.close(descriptor)

    @staticmethod
    def holder(path: Path) -> str:
        """Who holds the lock, for people."""
        try:
            return path.read_text(encoding="utf-8") or "another process"
        except OSError:
            return "another process"

    def release(self) -> None:
        """Let the next one in."""
        self._path.unlink(missing_ok=True)
        os.close(self._descriptor)


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _sign(descriptor: int) -> None:
    """Say who holds the lock. On a full disk nobody does; the lock holds all the same."""
    with suppress(OSError):
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode())
