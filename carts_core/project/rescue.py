"""What can be read of a damaged project, as a new one. The damaged file is only read."""

import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from ..wording import counted
from . import database, digests
from .identity import SequenceIdentity
from .keys import Key, Kind, check_edit, decode
from .snapshot import Copy
from .values import Figures

UNREADABLE = (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError, MemoryError)
"""What decoding of foreign values raises, besides `ProjectError`."""
_LISTED = 5
_LOST_STEP = "A step whose name was lost to damage"


@dataclass
class Rescued:
    """A new project in memory, and what happened, for people."""

    connection: sqlite3.Connection
    kept: int = 0
    lost: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        """For people."""
        named = ", ".join(self.lost[:_LISTED]) + (" and more" if len(self.lost) > _LISTED else "")
        missing = f"{len(self.lost)} could not ({named})" if self.lost else "what is missing left no trace"
        return f"{counted(self.kept, 'row')} of it could be read, {missing}"


def rescue(copy: Copy, identity: SequenceIdentity) -> Rescued | None:
    """What can be read of a project of this sequence; None if that is nothing."""
    old = copy.connection
    rescued = Rescued(database.empty(identity))
    tables = {table: list(_rows(copy, table, rescued)) for table in digests.TABLES}
    tables["changes"] = [row for row in tables["changes"] if _fits(identity, row, rescued)]
    tables["figures"] = [row for row in tables["figures"] if _is_figure(identity, row, rescued)]
    names = {number: (name, time) for number, name, time in tables["steps"]}
    numbers = sorted(names.keys() | {row[3] for row in tables["changes"]})
    renumbered = {old_number: number for number, old_number in enumerate(numbers, start=1)} | {0: 0}
    steps = [(renumbered[n], *names.get(n, (_LOST_STEP, 0.0))) for n in numbers]
    changes = {(kind, frame, name, renumbered[n]): value for kind, frame, name, n, value in tables["changes"]}
    figures = {(frame, renumbered[n]): values for frame, n, *values in tables["figures"] if n in renumbered}
    with database.transaction(rescued.connection) as new:
        _insert(new, "steps", steps)
        _insert(new, "changes", [(*key, value) for key, value in changes.items()])
        _insert(new, "figures", [(*key, *values) for key, values in figures.items()])
        _insert(new, "exports", tables["exports"])
        new.execute("UPDATE project SET position = ?", (_position(old, numbers),))
        digests.seal(new, b"")
    rescued.kept = len(steps) + len(changes) + len(figures) + len(tables["exports"])
    if rescued.kept:
        return rescued
    rescued.connection.close()
    return None


def _insert(new: sqlite3.Connection, table: str, rows: list[tuple]) -> None:
    columns = digests.TABLES[table]
    marks = ", ".join("?" * len(columns))
    new.executemany(f"INSERT INTO {table} ({', '.join(columns)}) VALUES ({marks})", rows)


def _rows(copy: Copy, table: str, rescued: Rescued) -> Iterator[tuple]:
    """The rows that are as they were written, from both ends of the table up to where it cannot be read."""
    connection, columns = copy.connection, ", ".join(digests.TABLES[table])
    sealed = database.version(connection) >= database.SEALED
    digest = "digest" if sealed else "NULL"
    seen: set[int] = set()
    for order in ("ASC", "DESC"):
        query = f"SELECT rowid, {columns}, {digest} FROM {table} NOT INDEXED ORDER BY rowid {order}"
        try:
            with database.time_limit(connection, 3.0):
                for number, *row, written in connection.execute(query):
                    if number in seen:
                        continue
                    seen.add(number)
                    if (sealed and digests.row_digest(table, row) != written) or not _has_types(table, row):
                        rescued.lost.append(f"a row of {table}")
                    else:
                        yield tuple(row)
            return
        except (sqlite3.Error, *UNREADABLE):
            rescued.lost.append(f"a part of {table}")


def _has_types(table: str, row: list[Any]) -> bool:
    types: dict[str, tuple[type | tuple[type, ...], ...]] = {
        "steps": (int, str, float),
        "changes": (str, int, str, int, (str, bytes, type(None))),
        "figures": (int, int, (float, type(None)), (float, type(None))),
        "exports": (float, str, str, int, str),
    }
    return all(isinstance(value, kind) for value, kind in zip(row, types[table], strict=True))


def _fits(identity: SequenceIdentity, row: tuple, rescued: Rescued) -> bool:
    kind, frame, name, _, value = row
    try:
        key: Key[Any] = Key(Kind(kind), frame, name)
        check_edit(identity, key, decode(key.kind, value))
    except (database.ProjectError, *UNREADABLE):
        rescued.lost.append(f"{kind} of frame number {frame}")
        return False
    return True


def _is_figure(identity: SequenceIdentity, row: tuple, rescued: Rescued) -> bool:
    try:
        check_edit(identity, Key.review(row[0]), None)
        Figures(*row[2:])
    except (database.ProjectError, *UNREADABLE):
        rescued.lost.append(f"figures of frame number {row[0]}")
        return False
    return True


def _position(old: sqlite3.Connection, numbers: list[int]) -> int:
    """How many of the steps are done; all, where the file does not say so."""
    try:
        (position,) = old.execute("SELECT position FROM project").fetchone()
    except (sqlite3.Error, TypeError):
        return len(numbers)
    return sum(number <= position for number in numbers) if isinstance(position, int) else len(numbers)
