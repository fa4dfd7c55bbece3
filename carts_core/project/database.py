"""SQLite database of a project: schema, connections, and digests of the content."""

import errno
import secrets
import sqlite3
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path

from ..errors import ProjectError
from .identity import SequenceIdentity

TABLES = {
    "steps": ("step", "name", "time"),
    "changes": ("kind", "frame", "name", "step", "value"),
    "figures": ("frame", "revision", "loss", "dice"),
    "exports": ("time", "format", "path", "frames", "settings"),
}
"""Columns of each table that are included in the digests of its rows."""
NONCE_BYTES = 16
_BYTES = 16
_MODULUS = 1 << (8 * _BYTES)


def row_digest(table: str, row: Sequence[object]) -> bytes:
    """Digest of a row as returned by SQLite."""
    # `ascii` distinguishes strings, bytes, integers, floats and None, and is stable across Python versions.
    return blake2b(ascii((table, tuple(row))).encode(), digest_size=_BYTES).digest()


def as_number(digest: bytes) -> int:
    """Convert a digest to a number, so that digests can be summed."""
    return int.from_bytes(digest, "big")


@dataclass(frozen=True)
class Seal:
    """Content of the table `seal`, except the position in the history."""

    nonce: bytes
    """Random number that identifies the file."""
    about: bytes
    """Digest of the constants: nonce, identity and creation time."""
    total: int
    """Sum of the digests of all rows."""

    @staticmethod
    def of(nonce: bytes, identity: str, created: float, total: int) -> "Seal":
        """Seal of a project with these values."""
        about = blake2b(ascii((nonce, identity, created)).encode(), digest_size=_BYTES).digest()
        return Seal(nonce, about, total % _MODULUS)

    def plus(self, change: int) -> "Seal":
        """Seal after a change of the sum of digests."""
        return replace(self, total=(self.total + change) % _MODULUS)

    def row(self, position: int) -> tuple[bytes, bytes, bytes]:
        """Row of the table `seal` at a position of the history."""
        total = self.total.to_bytes(_BYTES, "big")
        whole = blake2b(ascii((self.about, position, total)).encode(), digest_size=_BYTES).digest()
        return self.nonce, total, whole


def seal(connection: sqlite3.Connection, nonce: bytes) -> None:
    """Compute and store the digests of all rows in the caller's transaction; `nonce` is used if the file has no
    nonce."""
    total = 0
    for table, columns in TABLES.items():
        rows = connection.execute(f"SELECT rowid, {', '.join(columns)} FROM {table}").fetchall()
        digests = [(row_digest(table, row), number) for number, *row in rows]
        connection.executemany(f"UPDATE {table} SET digest = ? WHERE rowid = ?", digests)
        total += sum(as_number(digest) for digest, _ in digests)
    identity, position, created = connection.execute("SELECT identity, position, created FROM project").fetchone()
    nonce = next((nonce for (nonce,) in connection.execute("SELECT nonce FROM seal")), nonce)
    connection.execute("DELETE FROM seal")
    row = Seal.of(nonce, identity, created, total).row(position)
    connection.execute("INSERT INTO seal (nonce, total, digest) VALUES (?, ?, ?)", row)


def check_seal(connection: sqlite3.Connection, total: int) -> Seal:
    """Read the seal of a file; `ProjectError` if it does not match the file, whose row digests have the sum `total`."""
    projects = connection.execute("SELECT identity, position, created FROM project").fetchmany(2)
    seals = connection.execute("SELECT nonce, total, digest FROM seal").fetchmany(2)
    if len(projects) != 1 or len(seals) != 1:
        raise ProjectError("it has no identity")
    (identity, position, created), (nonce, *_) = projects[0], seals[0]
    if not isinstance(nonce, bytes) or len(nonce) != NONCE_BYTES:
        raise ProjectError("its nonce was changed")
    found = Seal.of(nonce, identity, created, total)
    expected = found.row(position)
    if seals[0][2] != expected[2] or seals[0] != expected:
        what = "rows are missing" if seals[0][1] != expected[1] else "its position or identity was changed"
        raise ProjectError(what)
    return found


def checked_rows(connection: sqlite3.Connection, table: str) -> Iterable[tuple]:
    """Yield the verified rows of a table, with their digests as numbers in the last column; `ProjectError` for a
    changed row."""
    columns = TABLES[table]
    # Rows are read in storage order, since indices are not trusted.
    query = f"SELECT {', '.join(columns)}, digest FROM {table} NOT INDEXED ORDER BY rowid"
    for row in connection.execute(query):
        if row_digest(table, row[:-1]) != row[-1]:
            raise ProjectError(f"a row of its table {table!r} was changed")
        yield (*row[:-1], as_number(row[-1]))


def verify(connection: sqlite3.Connection) -> Seal:
    """Verify all rows without decoding values, and return the seal of the file; `ProjectError` for any change."""
    return check_seal(connection, sum(row[-1] for table in TABLES for row in checked_rows(connection, table)))


APPLICATION_ID = 0x43415254
"""SQLite application id of CaRTS projects ("CART")."""

MIGRATIONS: tuple[str, ...] = (
    """
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
""",
    "-- The same tables. Changes may be of the kind time_offset, which version 1 would take for damage.\n",
    """
ALTER TABLE steps ADD COLUMN digest BLOB;    -- of the row, see digests.py
ALTER TABLE changes ADD COLUMN digest BLOB;
ALTER TABLE figures ADD COLUMN digest BLOB;
ALTER TABLE exports ADD COLUMN digest BLOB;
CREATE TABLE seal (               -- one row
    nonce BLOB NOT NULL,          -- random, tells this file from other projects
    total BLOB NOT NULL,          -- sum of the digests of all rows
    digest BLOB NOT NULL          -- over nonce, total, identity, position and time of creation
);
""",
    "-- The same tables. Changes may be of the kind verdict, which version 3 would take for damage.\n",
    "-- The same tables. Changes may be of the kinds imported_mask, imported_keypoints and imported_labels.\n",
    "-- The same tables. Changes may be of the kind part_labels.\n",
)
"""Script n migrates a project from schema n to n + 1; a new project runs all scripts. Existing scripts must not be
changed."""
SEALED = 3
"""First schema with digests."""

MAX_VALUE_LENGTH = 128 * 2**20
"""Maximum size of a value in a row [bytes]."""
_LIMITS = {
    sqlite3.SQLITE_LIMIT_LENGTH: MAX_VALUE_LENGTH,
    sqlite3.SQLITE_LIMIT_SQL_LENGTH: 1_000_000,
    sqlite3.SQLITE_LIMIT_COLUMN: 100,
    sqlite3.SQLITE_LIMIT_EXPR_DEPTH: 100,
    sqlite3.SQLITE_LIMIT_COMPOUND_SELECT: 10,
    sqlite3.SQLITE_LIMIT_ATTACHED: 0,
    sqlite3.SQLITE_LIMIT_TRIGGER_DEPTH: 1,
    sqlite3.SQLITE_LIMIT_WORKER_THREADS: 0,
}
_NEVER = {
    sqlite3.SQLITE_ATTACH,
    sqlite3.SQLITE_CREATE_TRIGGER,
    sqlite3.SQLITE_CREATE_TEMP_TRIGGER,
    sqlite3.SQLITE_CREATE_TEMP_VIEW,
    sqlite3.SQLITE_CREATE_TEMP_TABLE,
    sqlite3.SQLITE_CREATE_VTABLE,
}
_STEPS_BETWEEN_LOOKS = 10_000
"""Number of SQLite virtual machine instructions (tens of microseconds) between checks of the time limit."""
_DISK_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}


class DamagedProject(ProjectError):
    """The content of a project file differs from what CaRTS wrote."""


def harden(connection: sqlite3.Connection) -> sqlite3.Connection:
    """Prevent a connection from running code of the file's schema and from opening other files."""
    for limit, value in _LIMITS.items():
        connection.setlimit(limit, value)
    for setting in ("trusted_schema = OFF", "cell_size_check = ON", "mmap_size = 0", "temp_store = MEMORY"):
        connection.execute(f"PRAGMA {setting}")
    connection.set_authorizer(_authorized)
    return connection


def _authorized(action: int, _first: object, _second: object, _schema: object, inside: str | None) -> int:
    """SQLite authorizer that denies the actions in `_NEVER`, and actions of foreign triggers and views."""
    return sqlite3.SQLITE_DENY if action in _NEVER or inside not in (None, "current") else sqlite3.SQLITE_OK


@contextmanager
def time_limit(connection: sqlite3.Connection, seconds: float) -> Iterator[None]:
    """Interrupt SQLite (`sqlite3.OperationalError`) if the block exceeds a time limit [s], as only crafted files do."""
    end = time.monotonic() + seconds
    connection.set_progress_handler(lambda: time.monotonic() > end, _STEPS_BETWEEN_LOOKS)
    try:
        yield
    finally:
        connection.set_progress_handler(None, 0)


def empty(identity: SequenceIdentity) -> sqlite3.Connection:
    """Create a new project in memory."""
    connection = harden(sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False))
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    with transaction(connection):
        for statement in _statements("".join(MIGRATIONS)):
            connection.execute(statement)
        insert = "INSERT INTO project (identity, position, created) VALUES (?, 0, ?)"
        connection.execute(insert, (identity.to_json(), time.time()))
        seal(connection, secrets.token_bytes(NONCE_BYTES))
        connection.execute(f"PRAGMA user_version = {len(MIGRATIONS)}")
    return connection


def migrate(connection: sqlite3.Connection, nonce: bytes) -> None:
    """Run the missing migrations of a verified project in one transaction; without missing migrations, check that the
    project is writable."""
    missing = MIGRATIONS[version(connection) :]
    with transaction(connection):
        for statement in _statements("".join(missing)):
            connection.execute(statement)
        if missing:
            seal(connection, nonce)
        connection.execute(f"PRAGMA user_version = {len(MIGRATIONS)}")


def check_version(connection: sqlite3.Connection, path: Path) -> None:
    """Check that a file is a project of a supported version; `ProjectError` otherwise."""
    if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise not_a_project(path)
    found = version(connection)
    if found > len(MIGRATIONS):
        raise ProjectError(
            f"project {path} has schema {found}, written by a newer version of carts; this version supports schemas "
            f"up to {len(MIGRATIONS)}. Nothing was changed. Update carts to open it."
        )


def check_schema(connection: sqlite3.Connection) -> None:
    """Check that the schema text equals the expected one, so that no foreign trigger, view or expression is
    executed."""
    found = version(connection)
    ours = _schema_of(MIGRATIONS[:found]) if found > 0 else frozenset()
    theirs = frozenset(connection.execute("SELECT type, name, tbl_name, sql FROM sqlite_schema").fetchmany(1000))
    if theirs != ours:
        odd = sorted({f"{kind} {name!r}" for kind, name, _, _ in theirs ^ ours if isinstance(kind, str)})
        raise DamagedProject(f"its tables are not those of a CaRTS project ({', '.join(odd)[:300]})")


def version(connection: sqlite3.Connection) -> int:
    """Schema version of a project."""
    return connection.execute("PRAGMA user_version").fetchone()[0]


def not_a_project(path: Path) -> ProjectError:
    """Error for a file that is not a project."""
    return ProjectError(f"{path} is not a CaRTS project; nothing was changed. Choose another file.")


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
    """Run a transaction, which is committed and synchronized to disk if the block ends without an exception."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield connection
        connection.execute("COMMIT")
    finally:
        if connection.in_transaction:
            with suppress(sqlite3.Error):
                connection.execute("ROLLBACK")


@lru_cache(maxsize=8)
def _schema_of(scripts: tuple[str, ...]) -> frozenset[tuple]:
    connection = sqlite3.connect(":memory:", isolation_level=None)
    try:
        connection.executescript("".join(scripts))
        return frozenset(connection.execute("SELECT type, name, tbl_name, sql FROM sqlite_schema"))
    finally:
        connection.close()


def _statements(script: str) -> Iterator[str]:
    """Yield the statements of a script, since `executescript` would commit the transaction."""
    statement = ""
    for line in script.splitlines(keepends=True):
        statement += line
        if sqlite3.complete_statement(statement):
            yield statement
            statement = ""


@contextmanager
def errors_explained(path: Path) -> Iterator[None]:
    """Convert errors of SQLite and the operating system to `ProjectError`."""
    try:
        yield
    except sqlite3.Error as error:
        raise ProjectError(f"project {path}: {error}. {_advice(getattr(error, 'sqlite_errorname', ''))}") from error
    except OSError as error:
        code = "SQLITE_FULL" if error.errno in _DISK_FULL else "SQLITE_CANTOPEN"
        raise ProjectError(f"project {path}: {error.strerror}. {_advice(code)}") from error


def _advice(code: str) -> str:
    if code.startswith(("SQLITE_FULL", "SQLITE_IOERR")):
        return "This change was not saved; earlier changes are safe. Free disk space and try again."
    if code.startswith(("SQLITE_READONLY", "SQLITE_CANTOPEN", "SQLITE_PERM")):
        return "Choose a file in a writable folder, or open the project read-only."
    if code.startswith("SQLITE_NOTADB"):
        return "The file is not a project; nothing was changed. Choose another file."
    if code.startswith("SQLITE_BUSY"):
        return "The project is open in another program. Close that program and try again."
    return "This change was not saved. If the error persists, the file may be damaged: keep a copy of it."
