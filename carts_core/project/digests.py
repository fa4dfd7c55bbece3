"""Digests of everything that a project file holds, so that damage is noticed when it is read.

Every row has a digest of its columns. The table `seal` has the sum of all of them, so that a row that has vanished is
noticed too, and a digest over that sum, the position in the history and the identity of the sequence.
"""

import sqlite3
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b

from ..errors import ProjectError

TABLES = {
    "steps": ("step", "name", "time"),
    "changes": ("kind", "frame", "name", "step", "value"),
    "figures": ("frame", "revision", "loss", "dice"),
    "exports": ("time", "format", "path", "frames", "settings"),
}
"""Columns of each table that its rows' digests cover."""
NONCE_BYTES = 16
_BYTES = 16
_MODULUS = 1 << (8 * _BYTES)


def row_digest(table: str, row: Sequence[object]) -> bytes:
    """Digest of a row as SQLite gives it back."""
    # `ascii` tells texts, bytes, integers, floats and None apart, and does not change from one Python to the next.
    return blake2b(ascii((table, tuple(row))).encode(), digest_size=_BYTES).digest()


def as_number(digest: bytes) -> int:
    """A digest as a summand of the total."""
    return int.from_bytes(digest, "big")


@dataclass(frozen=True)
class Seal:
    """What `seal` says but for the position in the history."""

    nonce: bytes
    """Random, made with the file; tells it from every other project of the sequence."""
    about: bytes
    """Digest of what never changes: nonce, identity and time of creation."""
    total: int
    """The sum of all rows' digests."""

    @staticmethod
    def of(nonce: bytes, identity: str, created: float, total: int) -> "Seal":
        """The seal of a project with these."""
        about = blake2b(ascii((nonce, identity, created)).encode(), digest_size=_BYTES).digest()
        return Seal(nonce, about, total % _MODULUS)

    def plus(self, change: int) -> "Seal":
        """The seal with digests added as one number, negative where rows go."""
        return replace(self, total=(self.total + change) % _MODULUS)

    def row(self, position: int) -> tuple[bytes, bytes, bytes]:
        """The row of `seal` at a position of the history."""
        total = self.total.to_bytes(_BYTES, "big")
        whole = blake2b(ascii((self.about, position, total)).encode(), digest_size=_BYTES).digest()
        return self.nonce, total, whole


def seal(connection: sqlite3.Connection, nonce: bytes) -> None:
    """Give every row its digest anew, inside a transaction of the caller's.

    Args:
        connection: to a project of the present schema.
        nonce: for one that has none yet.
    """
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
    """The seal of a file whose rows were all checked, and whose digests add up to `total`.

    Raises:
        ProjectError: it does not fit.
    """
    projects = connection.execute("SELECT identity, position, created FROM project").fetchmany(2)
    seals = connection.execute("SELECT nonce, total, digest FROM seal").fetchmany(2)
    if len(projects) != 1 or len(seals) != 1:
        raise ProjectError("it has no identity of its own")
    (identity, position, created), (nonce, *_) = projects[0], seals[0]
    if not isinstance(nonce, bytes) or len(nonce) != NONCE_BYTES:
        raise ProjectError("its own number was changed")
    found = Seal.of(nonce, identity, created, total)
    expected = found.row(position)
    if seals[0][2] != expected[2] or seals[0] != expected:
        what = "rows are missing" if seals[0][1] != expected[1] else "its position or identity was changed"
        raise ProjectError(what)
    return found


def checked_rows(connection: sqlite3.Connection, table: str) -> Iterable[tuple]:
    """The rows of a table with their digests as numbers in the last column, each checked.

    Raises:
        ProjectError: a row is not as it was written.
    """
    columns = TABLES[table]
    # No index is trusted: rows are read in the order in which they lie.
    query = f"SELECT {', '.join(columns)}, digest FROM {table} NOT INDEXED ORDER BY rowid"
    for row in connection.execute(query):
        if row_digest(table, row[:-1]) != row[-1]:
            raise ProjectError(f"a row of its table {table!r} was changed")
        yield (*row[:-1], as_number(row[-1]))


def verify(connection: sqlite3.Connection) -> Seal:
    """The seal of a file, with every row checked against it; values are not decoded.

    Raises:
        ProjectError: something is not as it was written.
    """
    return check_seal(connection, sum(row[-1] for table in TABLES for row in checked_rows(connection, table)))
