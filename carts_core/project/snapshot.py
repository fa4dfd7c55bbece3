"""A copy of a project file in memory, checked before anything in it is used. The file itself is only read."""

import os
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from ..errors import ProjectError
from . import database, digests
from .companions import LOG, beside, check_files, open_regular
from .wal import played_back

LARGEST = 768 * 2**20
"""What a project may have, its log included [bytes]; twice that is held while it is opened."""
_TRIES = 5
_MAGIC = b"SQLite format 3\0"
_WRITE_VERSION = slice(18, 20)
"""Bytes that say whether a database keeps a log; one in memory must not."""


@dataclass(frozen=True)
class Content:
    """What a project file and its log hold."""

    database: bytes
    log: bytes


@dataclass(frozen=True)
class Copy:
    """A copy in memory, which nothing was checked of yet.

    Attributes:
        connection: to it.
        fault: what was seen to be wrong with the files, for people; None if nothing was.
    """

    connection: sqlite3.Connection
    fault: str | None


def read(path: Path) -> Content:
    """What lies there, at one moment.

    Raises:
        ProjectError: it is not there, is no regular file, is too large, or never holds still.
        OSError: it cannot be read.
    """
    if not check_files(path):
        raise ProjectError(f"there is no project {path}. Name an existing one, or open it for writing to begin one.")
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
        # Whoever has it open writes to the log, and to the file itself when that is full or at the end.
        if (before.st_size, before.st_mtime_ns) == (after.st_size, after.st_mtime_ns):
            return Content(main, log)
    raise ProjectError(f"project {path} is being changed all the time. Try again when that has ended.")


def open_copy(content: Content, path: Path) -> Copy:
    """A connection to a copy in memory.

    Raises:
        ProjectError: it is no project, or of a newer version of carts.
        sqlite3.Error: SQLite cannot read it at all.
    """
    main = content.database
    if not main.startswith(_MAGIC) or len(main) < 512:
        raise database.not_a_project(path)
    played = played_back(main, content.log)
    memory = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
    try:
        patched = played.database
        patched[_WRITE_VERSION] = b"\1\1"
        # SQLite opens nothing that was cut off; with the rest empty it reads what is there.
        missing = min(_promised(patched), LARGEST) - len(patched)
        patched.extend(bytes(max(missing, 0)))
        memory.deserialize(patched)
        database.hardened(memory)
        database.check_version(memory, path)
    except BaseException:
        memory.close()
        raise
    # Logs of older versions were used again without being emptied, so that old frames lie at their end.
    drops = played.damaged and database.version(memory) >= database.SEALED
    fault = "the last edits in its log (-wal) cannot be read" if drops else None
    return Copy(memory, f"{missing} bytes at its end are missing" if missing > 0 else fault)


def check(copy: Copy) -> None:
    """See that a copy has our schema and is a sound database, before rows are read.

    Raises:
        DamagedProject, sqlite3.Error: it is not.
    """
    memory = copy.connection
    if copy.fault is not None:
        raise database.DamagedProject(copy.fault)
    pages = memory.execute("PRAGMA page_count").fetchone()[0]
    with database.time_limit(memory, 5.0 + pages / 5_000):
        database.check_schema(memory)
        found = memory.execute("PRAGMA integrity_check(3)").fetchall()
    if found != [("ok",)]:
        raise database.DamagedProject("; ".join(str(row[0]) for row in found)[:300])


def verified_seal(path: Path) -> tuple[bytes, bytes, bytes] | None:
    """What `seal` of the file that lies there now says, if all of it is as it was written; None if it is not."""
    try:
        with database.errors_explained(path):
            copy = open_copy(read(path), path)
            with closing(copy.connection):
                check(copy)
                digests.verify(copy.connection)
                return copy.connection.execute("SELECT nonce, total, digest FROM seal").fetchone()
    except ProjectError:
        return None


def _promised(main: bytearray) -> int:
    """How many bytes a database has, as its header says."""
    size = int.from_bytes(main[16:18], "big")
    return int.from_bytes(main[28:32], "big") * (65536 if size == 1 else size)


def _content(descriptor: int, path: Path) -> bytes:
    size = os.fstat(descriptor).st_size
    if size > LARGEST:
        raise ProjectError(f"{path} has {size / 2**20:.0f} MiB; a project may have {LARGEST // 2**20}. Name another.")
    parts = []
    while len(part := os.pread(descriptor, 1 << 26, sum(map(len, parts)))):
        parts.append(part)
    return b"".join(parts)
