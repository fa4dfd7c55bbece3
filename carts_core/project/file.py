"""Project file on disk: file checks, writer lock, verified copy in memory, and verified commits.

The lock covers the bytes that SQLite locks and belongs to the open file description (F_OFD_SETLK), so it is released at
the end of the process instead of when another descriptor is closed. While the file is open, edits are written to
SQLite's write-ahead log, so any other change of the file is due to another process. SQLite replays a log up to the
first damaged frame, which may only be followed by an incomplete, unacknowledged transaction. Format:
https://www.sqlite.org/fileformat2.html#the_write_ahead_log
"""

import ctypes
import errno
import fcntl
import os
import shutil
import socket
import sqlite3
import stat
import struct
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ..errors import ProjectError
from . import database
from .database import verify

LOG, JOURNAL = "-wal", "-journal"
_OPEN = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC | getattr(os, "O_NOCTTY", 0)


def beside(path: Path, suffix: str) -> Path:
    """Path of a companion file of a database, such as the log."""
    return path.with_name(path.name + suffix)


def check_files(path: Path) -> bool:
    """Check a project and its companion files before opening them; returns whether the project exists.

    Raises:
        ProjectError: a file is a link, has a second hard link or is not a regular file; another program left a journal
            that SQLite would apply; or there is a log without its project.
        OSError: the folder cannot be read.
    """
    there = _is_there(path)
    log = _is_there(beside(path, LOG))
    if _is_there(beside(path, JOURNAL)):
        raise ProjectError(
            f"{beside(path, JOURNAL)} is beside the project, but carts does not create such files. Nothing was "
            "changed. If another program is changing the project, let it finish; otherwise move that file away."
        )
    if log and not there:
        raise ProjectError(
            f"{beside(path, LOG)} exists without its project {path.name}, which was moved or deleted. Nothing was "
            "changed. Move the project back beside it, or move that file away to create a new project."
        )
    return there


def open_regular(path: Path, *, write: bool = False) -> int:
    """Open a regular file with a single hard link and return its descriptor; links are not followed, and pipes do not
    block."""
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
        stat.S_IFREG: f"a file with {found.st_nlink} hard links",
        stat.S_IFLNK: "a link",
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a pipe",
    }
    raise ProjectError(
        f"{path} is {kinds.get(stat.S_IFMT(found.st_mode), 'a device or socket')}. A project and its companion files "
        "must be regular files with a single hard link; nothing was changed. Move this file away, "
        "or copy the project to a new file."
    )


_START, _LENGTH = 0x40000000, 512
"""Byte range of SQLite's locks, which may lie beyond the end of the file."""


def try_lock(descriptor: int) -> bool:
    """Lock an open project file for writing until it is closed; False if another process holds the lock."""
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
    """Description of the process that has a project open, if the system provides its name."""
    own = str(os.getpid())
    with suppress(OSError):
        wanted = os.stat(path, follow_symlinks=False)
        for process in sorted(Path("/proc").glob("[0-9]*"), key=lambda folder: folder.name == own):
            with suppress(OSError):
                for entry in (process / "fd").iterdir():
                    with suppress(OSError):
                        if os.path.samestat(os.stat(entry), wanted):
                            return f"process {process.name} on {socket.gethostname()}"
    return "another process"


HEADER, FRAME_HEADER = 32, 24
"""Sizes of the log header, and of the header before each page [bytes]."""
_ORDERS: dict[int, Literal["<", ">"]] = {0x377F0682: "<", 0x377F0683: ">"}
"""Magic number -> byte order of checksum words."""
_WORD = 0xFFFFFFFF
_FRAMES_AT_ONCE = 256
_PAGE_SIZES = frozenset(1 << n for n in range(9, 17))


def _recovered(main: bytes, log: bytes) -> tuple[bytearray, bool]:
    """Apply all committed transactions of a log to a database, like SQLite; also returns whether the log is damaged.

    Logs start empty, so that at most one incomplete transaction follows the committed transactions.
    """
    result, unfinished = bytearray(main), []
    for frame in _frames(log):
        if frame is None:
            return result, True
        page, pages, content = frame
        unfinished.append((page, content))
        if pages:
            for number, content in unfinished:
                end = number * len(content)
                result.extend(bytes(max(end - len(result), 0)))
                result[end - len(content) : end] = content
            unfinished.clear()
            del result[pages * len(content) :]
    return result, False


def _frames(log: bytes) -> Iterator[tuple[int, int, bytes] | None]:
    """Yield each complete frame: page number, database size [pages] if the frame commits a transaction (else 0), and
    page.

    If a frame or the header is damaged, the last item is None, and the following frames are not read.
    """
    if len(log) < HEADER:
        # The header is written first and in one call, so it is incomplete only if the process was killed during this
        # call.
        return
    magic, _, page_size, _, *salts, s, t = struct.unpack_from(">8I", log)
    order = _ORDERS.get(magic)
    if order is None or page_size not in _PAGE_SIZES or _checksums(order, log[: HEADER - 8])[0] != [s, t]:
        yield None
        return
    size = FRAME_HEADER + page_size
    for start in range(HEADER, len(log) - size + 1, size * _FRAMES_AT_ONCE):
        frames = [
            log[at : at + size] for at in range(start, min(start + size * _FRAMES_AT_ONCE, len(log) - size + 1), size)
        ]
        *sums, (a, c), (b, d) = _checksums(order, *(frame[:8] + frame[FRAME_HEADER:] for frame in frames))
        for frame, (x, y) in zip(frames, sums, strict=True):
            # A checksum is linear in the data and in the previous checksum.
            s, t = (x + a * s + b * t) & _WORD, (y + c * s + d * t) & _WORD
            page, pages, *rest = struct.unpack_from(">6I", frame)
            if rest != [*salts, s, t] or page == 0:
                yield None
                return
            yield page, pages, frame[FRAME_HEADER:]


def _checksums(order: Literal["<", ">"], *parts: bytes) -> list[list[int]]:
    """WAL checksums of equal-length blocks, each from (0, 0), then of a block of zeros from (1, 0) and from (0, 1)."""
    words = np.frombuffer(b"".join([*parts, bytes(2 * len(parts[0]))]), np.dtype(np.uint32).newbyteorder(order))
    s, t = np.zeros((2, len(parts) + 2), np.uint32)
    s[-2] = t[-1] = 1
    for x, y in words.reshape(len(s), -1, 2).transpose(1, 2, 0).astype(np.uint32):
        s = s + x + t
        t = t + y + s
    return np.stack([s, t], 1).tolist()


LARGEST = 768 * 2**20
"""Maximum size of a project including its log [bytes]; opening it requires twice as much memory."""
_TRIES = 5
_MAGIC = b"SQLite format 3\0"
_WRITE_VERSION = slice(18, 20)
"""Header bytes with the journal mode (WAL or rollback); an in-memory database requires a rollback journal."""


@dataclass(frozen=True)
class Content:
    """Content of a project file and its log."""

    database: bytes
    log: bytes


@dataclass(frozen=True)
class Copy:
    """Unverified copy of a project in memory.

    Attributes:
        connection: connection to the copy.
        fault: clause that describes damage of the files; None for intact files.
    """

    connection: sqlite3.Connection
    fault: str | None


def read_files(path: Path) -> Content:
    """Read a consistent snapshot of project and log; `ProjectError` if the project is missing, too large, or keeps
    changing."""
    if not check_files(path):
        raise ProjectError(
            f"there is no project {path}. Choose an existing project, or open this one for writing to create it."
        )
    for _ in range(_TRIES):
        descriptor = open_regular(path)
        try:
            before = os.fstat(descriptor)
            main, log = _content(descriptor, path), b""
            try:
                log_descriptor = open_regular(beside(path, LOG))
            except FileNotFoundError:
                pass
            else:
                try:
                    log = _content(log_descriptor, path)
                finally:
                    os.close(log_descriptor)
            after = os.fstat(descriptor)
        finally:
            os.close(descriptor)
        # A writer appends to the log, and checkpoints it into the file if the log is large or the file is closed.
        if (before.st_size, before.st_mtime_ns) == (after.st_size, after.st_mtime_ns):
            return Content(main, log)
    raise ProjectError(f"project {path} is changing continuously. Try again later.")


def open_copy(content: Content, path: Path) -> Copy:
    """Open a project as an unverified copy in memory; `ProjectError` or `sqlite3.Error` if the file is not a project or
    its schema is too new."""
    main = content.database
    if not main.startswith(_MAGIC) or len(main) < 512:
        raise database.not_a_project(path)
    patched, damaged = _recovered(main, content.log)
    memory = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
    try:
        patched[_WRITE_VERSION] = b"\1\1"
        # SQLite does not open truncated files; with zeros appended, the remaining content can be read.
        page_size = int.from_bytes(patched[16:18], "big")
        promised = int.from_bytes(patched[28:32], "big") * (65536 if page_size == 1 else page_size)
        missing = min(promised, LARGEST) - len(patched)
        patched.extend(bytes(max(missing, 0)))
        memory.deserialize(patched)
        database.harden(memory)
        database.check_version(memory, path)
    except BaseException:
        memory.close()
        raise
    # Older versions reused logs without truncating them, so old frames remain at the end.
    drops = damaged and database.version(memory) >= database.SEALED
    fault = "the last edits in its log (-wal) cannot be read" if drops else None
    return Copy(memory, f"{missing} bytes at its end are missing" if missing > 0 else fault)


def check_copy(copy: Copy) -> None:
    """Check schema and database integrity of a copy before rows are read."""
    memory = copy.connection
    if copy.fault is not None:
        raise database.DamagedProject(copy.fault)
    pages = memory.execute("PRAGMA page_count").fetchone()[0]
    with database.time_limit(memory, 5.0 + pages / 5_000):
        database.check_schema(memory)
        found = memory.execute("PRAGMA integrity_check(3)").fetchall()
    if found != [("ok",)]:
        raise database.DamagedProject("; ".join(str(row[0]) for row in found)[:300])


def _content(descriptor: int, path: Path) -> bytes:
    size = os.fstat(descriptor).st_size
    if size > LARGEST:
        raise ProjectError(
            f"{path} has {size / 2**20:.0f} MiB; the limit is {LARGEST // 2**20} MiB. Choose another file."
        )
    parts = []
    while len(part := os.pread(descriptor, 1 << 26, sum(map(len, parts)))):
        parts.append(part)
    return b"".join(parts)


Statements = Sequence[tuple[str, Iterable[Sequence[object]]]]
"""SQL statements, each with the rows of its parameters."""

SealRow = tuple[bytes, bytes, bytes]
"""Row of the table `seal`."""

MAX_LOG_BYTES = 64 * 2**20
"""Size above which the log is checkpointed into the file [bytes]."""


class LostFile(ProjectError):
    """The file on disk is not, or may not be, the opened file. The message states the cause as a clause."""


class ProjectFile:
    """Project file locked for writing, created by `locked`.

    Attributes:
        path: path of the file.
    """

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path = path
        self._log_path = beside(path, LOG)
        self._descriptor = descriptor
        self._log: int | None = None
        self._connection: sqlite3.Connection | None = None
        self._seal: SealRow = (b"", b"", b"")
        self._left: tuple[object, ...] = ()
        """Identity, size and modification time of file and log after the last write of this process."""
        self._end, self._written = 0, (b"", b"")
        """End of the last transaction in the log [bytes], and headers of the log and of its last frame."""

    @classmethod
    def locked(cls, path: Path) -> "ProjectFile | None":
        """Lock an existing project file; None if another process has locked it."""
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
        """Open the verified file with SQLite, and migrate it.

        Args:
            nonce: nonce for a file with a schema without nonce.
            seal: seal of the file after the migration.

        Raises:
            ProjectError: the file cannot be written to, or was replaced by another file.
        """
        uri = f"{self.path.as_uri()}?mode=rw&vfs=unix-none"
        with database.errors_explained(self.path):
            # This process already holds the lock, so SQLite does not lock the file and keeps its log index in memory.
            connection = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
            self._connection = connection
            connection.execute("PRAGMA locking_mode = EXCLUSIVE")
            database.harden(connection)
            if connection.execute("PRAGMA journal_mode = WAL").fetchone() != ("wal",):
                raise ProjectError(f"project {self.path} cannot be opened for writing. Open it read-only.")
            connection.execute("PRAGMA synchronous = FULL")
            connection.execute("PRAGMA wal_autocheckpoint = 0")
            page_size = connection.execute("PRAGMA page_size").fetchone()[0]
            # A larger project could not be opened again.
            connection.execute(f"PRAGMA max_page_count = {(LARGEST - MAX_LOG_BYTES) // page_size}")
            # Logs start empty; see `_recovered`.
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            database.migrate(connection, nonce)
            self._log = open_regular(self._log_path)
        self._seal = seal
        self._remember()
        self._check_since(committed=True)
        self._check_names()

    def commit(self, statements: Statements, seal: SealRow) -> None:
        """Run statements as one transaction, synchronized to disk on return.

        Raises:
            LostFile: the file has changed; it is unknown whether the edit was written.
            ProjectError: the transaction could not be written, and nothing was changed.
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
            # The log may have grown by an incomplete transaction.
            self._remember()
            if getattr(error.__cause__, "sqlite_errorname", "") == "SQLITE_FULL" and self._has_room():
                raise ProjectError(
                    f"project {self.path} has reached the limit of {(LARGEST - MAX_LOG_BYTES) // 2**20} MiB. This "
                    "change was not saved; earlier changes are safe. Continue in a new project (--project FILE)."
                ) from error
            raise
        self._check_since(committed=True)
        self._seal = seal
        self._remember()

    def _has_room(self) -> bool:
        """Whether the disk has space for twice the largest log of usual size."""
        return shutil.disk_usage(self.path.parent).free > 2 * MAX_LOG_BYTES

    def checkpoint(self) -> None:
        """Checkpoint a large log into the file, and verify the file; `LostFile` if the content differs."""
        if os.fstat(self._open_log()).st_size < MAX_LOG_BYTES:
            return
        with suppress(sqlite3.Error):
            self._usable().execute("PRAGMA wal_checkpoint(TRUNCATE)")
        if os.fstat(self._open_log()).st_size == 0:
            self._end, self._written = 0, (b"", b"")
        self._check_names()
        self._check_content()
        self._remember()

    def check(self) -> None:
        """Check that file and log are unchanged since the last write of this process; `LostFile` otherwise."""
        self._check_names()
        if self._look() != self._left:
            # The modification time may change without a change of the content.
            self._check_content()
            self._remember()

    def close(self) -> None:
        """Checkpoint the log into the file, verify its content (`LostFile` if it differs), and release the lock."""
        if self._connection is not None:
            self.check()
            self._connection.close()
            self._connection = None
            self._check_names(log=False)
            self._check_content()
        self._release()

    def dismiss(self) -> None:
        """Close a file to which this process has written no edits."""
        if self._connection is not None and _lies_at(self.path, self._descriptor):
            with suppress(sqlite3.Error):
                self._connection.close()
            self._connection = None
        self.abandon()

    def abandon(self) -> None:
        """Close a lost file without writing to it."""
        if self._connection is not None:
            # Closing the connection would checkpoint the log into the file, and remove any file with the name of the
            # log.
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._connection))
            self._connection = None
        if self._log is not None and not _lies_at(self.path, self._descriptor) and _lies_at(self._log_path, self._log):
            # Without its file the log is useless, and SQLite would apply it to another file of that name.
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
        """Check that the paths of file and log still refer to the opened files."""
        if not _lies_at(self.path, self._descriptor):
            if os.path.lexists(self.path):
                raise LostFile("was replaced by another file")
            raise LostFile("was moved" if os.fstat(self._descriptor).st_nlink else "was deleted")
        if log and not _lies_at(self._log_path, self._open_log()):
            raise LostFile("has lost its log (-wal), which holds the newest edits")

    def _check_content(self) -> None:
        """Verify the content on disk."""
        with suppress(OSError, ProjectError), database.errors_explained(self.path):
            copy = open_copy(read_files(self.path), self.path)
            with closing(copy.connection):
                check_copy(copy)
                verify(copy.connection)
                if copy.connection.execute("SELECT nonce, total, digest FROM seal").fetchone() == self._seal:
                    return
        raise LostFile("was changed by another program and lacks saved edits")

    def _check_since(self, *, committed: bool) -> None:
        """Check that no other process changed the file or truncated its log during a transaction."""
        self._check_names()
        if _look(self._descriptor) != self._left[0]:
            raise LostFile("was changed by another program while an edit was being saved")
        if not committed:
            return
        written = self._headers(self._end)
        end = os.fstat(self._open_log()).st_size
        headers = self._headers(end)
        salts, pages = headers[0][16:24], headers[1][4:8]
        if (self._end and written != self._written) or end <= self._end or headers[1][8:16] != salts or not any(pages):
            raise LostFile("lost an edit, or earlier content of its log (-wal), during a write")
        self._end, self._written = end, headers

    def _headers(self, end: int) -> tuple[bytes, bytes]:
        """Headers of the log, and of the log frame that ends at an offset [bytes]."""
        log = self._open_log()
        header = os.pread(log, HEADER, 0)
        size = FRAME_HEADER + int.from_bytes(header[8:12], "big")
        return header, os.pread(log, FRAME_HEADER, max(end - size, 0))


def _look(descriptor: int) -> tuple[int, ...]:
    found = os.fstat(descriptor)
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def _lies_at(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.stat(path, follow_symlinks=False), os.fstat(descriptor))
    except OSError:
        return False
