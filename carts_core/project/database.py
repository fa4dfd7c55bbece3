"""The SQLite file: how it is made, opened, migrated and written to."""

import errno
import os
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from ..errors import ProjectError
from .identity import SequenceIdentity

APPLICATION_ID = 0x43415254
"""Marks an SQLite file as a project of ours ("CART")."""

VERSION_1 = """
CREATE TABLE project (            -- one row
    identity TEXT NOT NULL,       -- of the sequence, JSON
    position INTEGER NOT NULL,    -- how many steps are done; those after it are undone
    created REAL NOT NULL         -- seconds since 1970, as all times
);
CREATE TABLE steps (              -- one per gesture
    step INTEGER PRIMARY KEY,     -- 1, 2, 3, ...
    name TEXT NOT NULL,
    time REAL NOT NULL
);
CREATE TABLE changes (            -- what each gesture set
    kind TEXT NOT NULL,
    frame INTEGER NOT NULL,       -- index from 0; -1: all frames
    name TEXT NOT NULL,           -- arm or camera, or nothing
    step INTEGER NOT NULL,
    value BLOB,                   -- JSON text, PNG bytes, or NULL: removed
    UNIQUE (kind, frame, name, step)
);
CREATE INDEX changes_by_step ON changes (step);
CREATE TABLE figures (            -- computed for a frame as step `revision` had left it
    frame INTEGER NOT NULL,
    revision INTEGER NOT NULL,
    loss REAL,
    dice REAL,
    PRIMARY KEY (frame, revision)
);
CREATE TABLE exports (
    time REAL NOT NULL,
    format TEXT NOT NULL,
    path TEXT NOT NULL,
    frames INTEGER NOT NULL,
    settings TEXT NOT NULL        -- JSON
);
CREATE VIEW current AS            -- the last change of every value that is done
    SELECT kind, frame, name, step, value FROM changes JOIN (
        SELECT kind, frame, name, max(step) AS step FROM changes
        WHERE step <= (SELECT position FROM project) GROUP BY kind, frame, name
    ) USING (kind, frame, name, step);
"""

VERSION_2 = """
-- The same tables. Changes may be of the kind time_offset, which version 1 would take for damage.
"""

MIGRATIONS: tuple[str, ...] = (VERSION_1, VERSION_2)
"""Script number n takes a project from schema n to n + 1; a new project runs all of them. Never change one."""

_DISK_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}


def create(path: Path, identity: SequenceIdentity) -> None:
    """Make an empty project; it appears under its name when it is complete.

    Raises:
        ProjectError: the folder cannot be written to, or the disk is full.
    """
    part = path.with_name(path.name + ".part")
    try:
        with errors_explained(path):
            part.unlink(missing_ok=True)
            with closing(sqlite3.connect(part, isolation_level=None)) as connection:
                connection.execute("PRAGMA synchronous = FULL")
                connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
                _migrate(connection)
                insert = "INSERT INTO project (identity, position, created) VALUES (?, 0, ?)"
                connection.execute(insert, (identity.to_json(), time.time()))
                # The last thing: up to here, what is saved is in the file itself, so it can be renamed.
                connection.execute("PRAGMA journal_mode = WAL")
            part.replace(path)
            _sync_folder(path.parent)
    except ProjectError:
        for suffix in ("", "-wal", "-shm"):
            part.with_name(part.name + suffix).unlink(missing_ok=True)
        raise


def _sync_folder(folder: Path) -> None:
    """Have a new name on disk before something is saved under it."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def connect(path: Path) -> sqlite3.Connection:
    """A connection that writes to an existing project, which is migrated to the present schema.

    Raises:
        ProjectError: it cannot be written to.
    """
    with errors_explained(path):
        uri = f"{path.as_uri()}?mode=rw"
        connection = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
        try:
            connection.execute("PRAGMA trusted_schema = OFF")
            connection.execute("PRAGMA synchronous = FULL")
            _migrate(connection)
        except BaseException:
            connection.close()
            raise
    return connection


def snapshot(path: Path) -> sqlite3.Connection:
    """A copy of a project in memory, migrated there. The file stays as it is and is not held open.

    Raises:
        ProjectError: it is not there, not a project, or of a newer version of carts.
    """
    if not path.is_file():
        raise ProjectError(f"there is no project {path}. Name an existing one, or open it for writing to begin one.")
    memory = sqlite3.connect(":memory:", isolation_level=None)
    try:
        with errors_explained(path):
            _copy(path, memory)
            memory.execute("PRAGMA trusted_schema = OFF")
            _check_schema(memory, path)
            _migrate(memory)
    except BaseException:
        memory.close()
        raise
    return memory


def _copy(path: Path, memory: sqlite3.Connection) -> None:
    if not _has_log(path):
        # Nobody is writing. Reading it as it lies needs no further files, which a read-only folder would refuse.
        changed = path.stat().st_mtime_ns
        _backup(f"{path.as_uri()}?mode=ro&immutable=1", memory)
        if not _has_log(path) and path.stat().st_mtime_ns == changed:
            return
    _backup(f"{path.as_uri()}?mode=ro", memory)


def _has_log(path: Path) -> bool:
    """Whether there are writes that did not reach the file itself yet, as there are while somebody is writing."""
    try:
        return path.with_name(path.name + "-wal").stat().st_size > 0
    except FileNotFoundError:
        return False


def _backup(uri: str, memory: sqlite3.Connection) -> None:
    with closing(sqlite3.connect(uri, uri=True)) as connection:
        connection.backup(memory)


@contextmanager
def transaction(connection: sqlite3.Connection, path: Path) -> Iterator[sqlite3.Connection]:
    """All or nothing; on disk when the block has ended.

    Raises:
        ProjectError: it could not be written; nothing of it was.
    """
    with errors_explained(path):
        connection.execute("BEGIN IMMEDIATE")
        try:
            yield connection
            connection.execute("COMMIT")
        finally:
            if connection.in_transaction:
                connection.execute("ROLLBACK")


@contextmanager
def errors_explained(path: Path) -> Iterator[None]:
    """Turn errors of SQLite and of the operating system into `ProjectError`."""
    try:
        yield
    except sqlite3.Error as error:
        raise ProjectError(f"project {path}: {error}. {_advice(getattr(error, 'sqlite_errorname', ''))}") from error
    except OSError as error:
        code = "SQLITE_FULL" if error.errno in _DISK_FULL else "SQLITE_CANTOPEN"
        raise ProjectError(f"project {path}: {error.strerror}. {_advice(code)}") from error


def _advice(code: str) -> str:
    if code.startswith(("SQLITE_FULL", "SQLITE_IOERR")):
        return "Nothing of this was saved, all that was saved before is safe. Free space on the disk, then try again."
    if code.startswith(("SQLITE_READONLY", "SQLITE_CANTOPEN", "SQLITE_PERM")):
        return "Name a file in a folder that you may write to, or open the project read-only."
    if code.startswith("SQLITE_NOTADB"):
        return "It is not a project; nothing was changed. Name another file."
    if code.startswith("SQLITE_BUSY"):
        return "Another program holds it. Close that, then try again."
    return "Nothing of this was saved. If it stays so, the file may be damaged: keep a copy of it."


def _check_schema(connection: sqlite3.Connection, path: Path) -> None:
    if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise ProjectError(f"{path} is not a project of carts; nothing was changed. Name another file.")
    version = _version(connection)
    if version > len(MIGRATIONS):
        raise ProjectError(
            f"project {path} has schema {version}, made by a newer version of carts; this one knows schemas up to "
            f"{len(MIGRATIONS)}. Nothing was changed. Update carts to open it."
        )


def _version(connection: sqlite3.Connection) -> int:
    return connection.execute("PRAGMA user_version").fetchone()[0]


def _migrate(connection: sqlite3.Connection) -> None:
    """Run the scripts that are missing, all or none. With none missing, see whether the file can be written."""
    scripts = "".join(MIGRATIONS[_version(connection) :])
    try:
        connection.executescript(f"BEGIN IMMEDIATE; {scripts} PRAGMA user_version = {len(MIGRATIONS)}; COMMIT;")
    finally:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
