"""The project file that is open for writing: locked, and seen to be the same file before and after each commit.

While it is open, edits go into SQLite's log beside it and the file itself is not written to. So any change of it, and
any change of the log between two commits, was made by somebody else.
"""

import ctypes
import os
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from ..errors import ProjectError
from . import database
from .companions import LOG, beside, open_regular
from .lock import try_lock
from .snapshot import verified_seal
from .wal import HEADER, Mark, next_mark

Statements = Sequence[tuple[str, Iterable[Sequence[object]]]]
"""SQL, each with the rows of its parameters."""

SealRow = tuple[bytes, bytes, bytes]
"""The row of `seal`."""

LARGEST_LOG = 64 * 2**20
"""A log beyond this is moved into the file [bytes]."""


class LostFile(ProjectError):
    """The file is not, or may not be, the one that was opened. The text says what happened to it."""


class ProjectFile:
    """A project file that this process alone writes to. Made by `locked`.

    Attributes:
        path: where it lies.
    """

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path = path
        self._log_path = beside(path, LOG)
        self._descriptor = descriptor
        self._log: int | None = None
        self._connection: sqlite3.Connection | None = None
        self._seal: SealRow = (b"", b"", b"")
        self._left: tuple[object, ...] = ()
        """What file and log looked like when this process had last written."""
        self._mark, self._header = Mark(), b""

    @classmethod
    def locked(cls, path: Path) -> "ProjectFile | None":
        """Lock an existing project file; None if somebody else has it open for writing.

        Raises:
            ProjectError, OSError: it cannot be opened.
        """
        descriptor = open_regular(path, write=True)
        try:
            if try_lock(descriptor):
                return cls(path, descriptor)
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
        return None

    def connect(self, nonce: bytes, seal: SealRow) -> None:
        """Have SQLite open the file, whose content was checked, and migrate it.

        Args:
            nonce: for a file of a schema without one.
            seal: what it says when it is migrated.

        Raises:
            ProjectError: it cannot be written to, or is another file by now.
        """
        uri = f"{self.path.as_uri()}?mode=rw&vfs=unix-none"
        with database.errors_explained(self.path):
            # The lock is ours already, so SQLite takes none, and keeps its index of the log in memory.
            connection = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
            self._connection = connection
            connection.execute("PRAGMA locking_mode = EXCLUSIVE")
            database.hardened(connection)
            if connection.execute("PRAGMA journal_mode = WAL").fetchone() != ("wal",):
                raise ProjectError(f"project {self.path} cannot be opened for writing. Open it read-only.")
            connection.execute("PRAGMA synchronous = FULL")
            connection.execute("PRAGMA wal_autocheckpoint = 0")
            # A log of ours begins empty; see wal.py.
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            database.migrate(connection, nonce)
            self._log = open_regular(self._log_path)
        self._seal = seal
        self._remember()
        self._check_since(committed=True)
        self._check_names()

    def commit(self, statements: Statements, seal: SealRow) -> None:
        """Run statements as one transaction, on disk when this returns.

        Args:
            statements: what to do.
            seal: what the file says then; one of the statements writes it.

        Raises:
            LostFile: the file is not the same any more; whether the edit is in it is not known.
            ProjectError: it could not be written; nothing of it was.
        """
        connection = self._usable()
        self.check()
        try:
            with database.errors_explained(self.path), database.transaction(connection):
                for statement, rows in statements:
                    connection.executemany(statement, rows)
        except ProjectError as error:
            self._check_since(committed=False)
            if getattr(error.__cause__, "sqlite_errorname", "").startswith(("SQLITE_CORRUPT", "SQLITE_NOTADB")):
                raise LostFile("was damaged") from error
            # The log may have grown by what does not count.
            self._remember()
            raise
        self._check_since(committed=True)
        self._seal = seal
        self._remember()

    def checkpoint(self) -> None:
        """Move the log into the file if it is large, and read that back.

        Raises:
            LostFile: it is not what it should be.
        """
        if os.fstat(self._open_log()).st_size < LARGEST_LOG:
            return
        with suppress(sqlite3.Error):
            self._usable().execute("PRAGMA wal_checkpoint(TRUNCATE)")
        if os.fstat(self._open_log()).st_size == 0:
            self._mark, self._header = Mark(), b""
        self._check_names()
        self._check_content()
        self._remember()

    def check(self) -> None:
        """See that file and log are as this process left them.

        Raises:
            LostFile: they are not.
        """
        self._check_names()
        if self._look() != self._left:
            # Somebody may have touched it without changing it.
            self._check_content()
            self._remember()

    def close(self) -> None:
        """Move the log into the file, read all of it back, and let others write.

        Raises:
            LostFile: it does not hold what was saved.
        """
        if self._connection is not None:
            self.check()
            self._connection.close()
            self._connection = None
            self._check_names(log=False)
            self._check_content()
        self._release()

    def dismiss(self) -> None:
        """Close a file that was not written to, or not with success."""
        if self._connection is not None and _lies_at(self.path, self._descriptor):
            with suppress(sqlite3.Error):
                self._connection.close()
            self._connection = None
        self.abandon()

    def abandon(self) -> None:
        """Let go of a file that is lost, without writing to it again."""
        if self._connection is not None:
            # Closing it would move the log into the file, and remove whatever has the log's name by now.
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._connection))
            self._connection = None
        if self._log is not None and not _lies_at(self.path, self._descriptor) and _lies_at(self._log_path, self._log):
            # Nobody can use it without its file, and SQLite would play it into another one of that name.
            with suppress(OSError):
                self._log_path.unlink()
        self._release()

    def _release(self) -> None:
        for descriptor in (self._descriptor, self._log):
            if descriptor is not None:
                os.close(descriptor)
        self._descriptor, self._log = -1, None

    def _usable(self) -> sqlite3.Connection:
        if self._connection is None:
            raise ProjectError(f"project {self.path} is closed.")
        return self._connection

    def _open_log(self) -> int:
        assert self._log is not None, "it is open while the project is"
        return self._log

    def _look(self) -> tuple[object, ...]:
        return _look(self._descriptor), _look(self._open_log())

    def _remember(self) -> None:
        self._left = self._look()

    def _check_names(self, *, log: bool = True) -> None:
        """See that both files lie where they lay."""
        if not _lies_at(self.path, self._descriptor):
            if os.path.lexists(self.path):
                raise LostFile("was replaced by another file")
            raise LostFile("was moved" if os.fstat(self._descriptor).st_nlink else "was deleted")
        if log and not _lies_at(self._log_path, self._open_log()):
            raise LostFile("has lost the file beside it that holds its newest edits (-wal)")

    def _check_content(self) -> None:
        """Read all of it back."""
        with suppress(OSError):
            if verified_seal(self.path) == self._seal:
                return
        raise LostFile("was changed by something else, and does not hold what was saved in it")

    def _check_since(self, *, committed: bool) -> None:
        """See that nobody wrote to the file, or cut its log, while a transaction was being written to the log."""
        self._check_names()
        if _look(self._descriptor) != self._left[0]:
            raise LostFile("was changed by something else while an edit was being saved")
        if not committed:
            return
        log = self._open_log()
        header = os.pread(log, HEADER, 0)
        frames = os.pread(log, max(os.fstat(log).st_size - self._mark.start, 0), self._mark.start)
        mark = next_mark(frames, header, self._mark)
        if mark is None or (self._mark.frames and header != self._header):
            raise LostFile("lost an edit, or what was before it in its log (-wal), while that was being saved")
        self._mark, self._header = mark, header


def _look(descriptor: int) -> tuple[int, ...]:
    found = os.fstat(descriptor)
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def _lies_at(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.stat(path, follow_symlinks=False), os.fstat(descriptor))
    except OSError:
        return False
