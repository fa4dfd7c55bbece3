"""Journal of all steps with their changes. The state is given by the steps up to a position, which undo and redo move.

Changes are returned as a `Transaction`, which is run on the file and on its in-memory copy.
"""

import sqlite3
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from .database import TABLES, DamagedProject, Seal, as_number, check_seal, checked_rows, row_digest
from .identity import SequenceIdentity
from .state import Entry, ExportRecord, ProjectState, Step
from .values import Edits, Figures, Key, Kind, ReviewState, check_edit, decode


@dataclass
class Transaction:
    """Statements of one transaction.

    Attributes:
        statements: SQL statements, each with its parameter rows.
        digests: change of the sum of digests.
        position: new position in the history; None if unchanged.
        cut_at: first step whose rows are removed, before the statements; None to keep all.
    """

    statements: list[tuple[str, list[tuple]]] = field(default_factory=list)
    digests: int = 0
    position: int | None = None
    cut_at: int | None = None

    def insert(self, table: str, rows: Iterable[tuple]) -> None:
        """Add rows, which replace rows with the same key."""
        sealed = [(*row, row_digest(table, row)) for row in rows]
        columns = TABLES[table]
        marks = ", ".join("?" * (len(columns) + 1))
        statement = f"INSERT OR REPLACE INTO {table} ({', '.join(columns)}, digest) VALUES ({marks})"
        self.statements.append((statement, sealed))
        self.digests += sum(as_number(row[-1]) for row in sealed)

    def subtract(self, found: Iterable[tuple[bytes]]) -> None:
        """Subtract the digests of removed or replaced rows from the sum."""
        self.digests -= sum(as_number(digest) for (digest,) in found)


def load(connection: sqlite3.Connection) -> tuple[ProjectState, Seal]:
    """Load the state and seal of a project; all rows are verified, including undone steps.

    Raises:
        ProjectError, sqlite3.Error and those of `store.UNREADABLE`: the project cannot be read, or was changed.
    """
    row = connection.execute("SELECT identity, position FROM project").fetchone()
    if row is None:
        raise DamagedProject("its sequence is unknown")
    text, position = _typed(row[0], str), _typed(row[1], int)
    identity = SequenceIdentity.from_json(text)
    total, steps, exports = 0, [], []
    newest: dict[tuple[str, int, str], tuple[int, Any]] = {}
    for number, name, time, digest in checked_rows(connection, "steps"):
        total += digest
        steps.append(Step(_typed(number, int), _typed(name, str), _typed(time, float)))
    for kind, frame, name, step, value, digest in checked_rows(connection, "changes"):
        total += digest
        about = kind, frame, name
        if step <= position and (about not in newest or newest[about][0] < step):
            newest[about] = step, value
    figures: dict[tuple[int, int], Figures] = {}
    for frame, revision, *values, digest in checked_rows(connection, "figures"):
        total += digest
        figures[_typed(frame, int), _typed(revision, int)] = Figures(*values)
    for *row, digest in checked_rows(connection, "exports"):
        total += digest
        exports.append(_record(*row))
    seal = check_seal(connection, total)
    steps.sort(key=lambda step: step.number)
    if [step.number for step in steps] != list(range(1, len(steps) + 1)) or not 0 <= position <= len(steps):
        raise DamagedProject("steps of its history are missing")
    decoded: dict[Key[Any], Entry | None] = {}
    for (kind, frame, name), (step, stored) in newest.items():
        key = Key(Kind(kind), frame, name)
        value = decode(key.kind, stored)
        check_edit(identity, key, value)
        decoded[key] = Entry(step, value)
    state = ProjectState(identity, tuple(steps), position, exports=tuple(exports))
    return state.with_entries(decoded).with_figures(figures), seal


def append(memory: sqlite3.Connection, step: Step, edits: Edits, last: int) -> Transaction:
    """Append a step at the current position, and remove the undone steps after it (through `last`)."""
    script = Transaction(position=step.number)
    if last >= step.number:
        script.cut_at = step.number
        for table, column in (("steps", "step"), ("changes", "step"), ("figures", "revision")):
            script.subtract(memory.execute(f"SELECT digest FROM {table} WHERE {column} >= ?", (step.number,)))
            script.statements.append((f"DELETE FROM {table} WHERE {column} >= ?", [(step.number,)]))
    script.insert("steps", [(step.number, step.name, float(step.time))])
    rows = [
        (key.kind.value, int(key.frame), str(key.name), step.number, None if value is None else value.encode())
        for key, value in edits.items()
    ]
    script.insert("changes", rows)
    return script


def move(memory: sqlite3.Connection, start: int, target: int) -> tuple[Transaction, dict[Key[Any], Entry | None]]:
    """Move to another position of the history; also returns the entries that may differ at the new position (None:
    absent)."""
    touched = memory.execute(
        "SELECT DISTINCT kind, frame, name FROM changes WHERE step > ? AND step <= ?", sorted((start, target))
    ).fetchall()
    entries: dict[Key[Any], Entry | None] = {}
    for about in touched:
        step, value = _newest(memory, about, target)
        key: Key[Any] = Key(Kind(about[0]), *about[1:])
        entries[key] = Entry(step, decode(key.kind, value)) if step >= 0 else None
    return Transaction(position=target), entries


def _newest(memory: sqlite3.Connection, about: tuple[str, int, str], last: int) -> tuple[int, Any]:
    """Latest step up to `last` that set a key, and the stored value; (-1, None) without such a step."""
    query = "SELECT step, value FROM changes WHERE kind = ? AND frame = ? AND name = ? AND step <= ?"
    return memory.execute(f"{query} ORDER BY step DESC LIMIT 1", (*about, last)).fetchone() or (-1, None)


def before(memory: sqlite3.Connection, step: int, position: int) -> tuple[dict[Key[Any], Any], int | None]:
    """Edits that undo a step, and the number of a later step that changed the same keys, if any.

    Verdicts are omitted, since a verdict depends on all values of its frame.
    """
    edits: dict[Key[Any], Any] = {}
    later: list[int] = []
    changed = "SELECT kind, frame, name FROM changes WHERE step = ? AND kind != ?"
    for about in memory.execute(changed, (step, Kind.VERDICT.value)).fetchall():
        key: Key[Any] = Key(Kind(about[0]), *about[1:])
        edits[key] = decode(key.kind, _newest(memory, about, step - 1)[1])
        number, value = _newest(memory, about, position)
        if value != _newest(memory, about, step)[1]:
            later.append(number)
    return edits, min(later, default=None)


def acceptance(memory: sqlite3.Connection, frame: int, position: int) -> int | None:
    """Last step up to a position that accepted a frame, or changed the note of an accepted frame; None without one."""
    changed = "SELECT step, value FROM changes WHERE kind = ? AND frame = ? AND step <= ? ORDER BY step DESC"
    for step, value in memory.execute(changed, (Kind.REVIEW.value, frame, position)):
        review = decode(Kind.REVIEW, value)
        if review is not None and review.state is ReviewState.ACCEPTED:
            return step
    return None


def add_figures(
    memory: sqlite3.Connection, script: Transaction, figures: Mapping[tuple[int, int], Figures]
) -> Transaction:
    """Add quality figures by (frame, revision)."""
    for key in figures:
        if script.cut_at is not None and key[1] >= script.cut_at:
            continue
        script.subtract(memory.execute("SELECT digest FROM figures WHERE frame = ? AND revision = ?", key))
    script.insert(
        "figures", [(int(frame), revision, value.loss, value.dice) for (frame, revision), value in figures.items()]
    )
    return script


def add_remark(memory: sqlite3.Connection, key: Key[Any], entry: Entry) -> Transaction:
    """Set a value as part of an existing step, in place of the value that the step has set before."""
    script, row = Transaction(), (key.kind.value, int(key.frame), str(key.name), entry.step)
    found = "SELECT digest FROM changes WHERE kind = ? AND frame = ? AND name = ? AND step = ?"
    script.subtract(memory.execute(found, row))
    script.insert("changes", [(*row, entry.value.encode())])
    return script


def add_export(record: ExportRecord) -> Transaction:
    """Add a row to the log of exports."""
    script = Transaction()
    script.insert("exports", [(record.time, str(record.format), record.path, int(record.frames), record.settings)])
    return script


def _record(time: Any, format: Any, path: Any, frames: Any, settings: Any) -> ExportRecord:
    texts = [_typed(text, str) for text in (format, path, settings)]
    return ExportRecord(_typed(time, float), texts[0], texts[1], _typed(frames, int), texts[2])


def _typed(value: Any, kind: type) -> Any:
    if not isinstance(value, kind):
        raise DamagedProject(f"it has a {type(value).__name__} instead of a {kind.__name__}")
    return value
