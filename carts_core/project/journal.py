"""The journal: every step and what it set. The state is the journal read up to a position, so undo moves that."""

import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import ProjectError
from .identity import SequenceIdentity
from .keys import Edits, Key, Kind, check_edit, decode
from .state import Entry, ExportRecord, ProjectState, Step
from .values import Figures


def load(connection: sqlite3.Connection, path: Path) -> ProjectState:
    """The state that a project file holds; `path` is for errors.

    Raises:
        ProjectError: something in it cannot be read.
    """
    try:
        text, position = connection.execute("SELECT identity, position FROM project").fetchone()
        identity = SequenceIdentity.from_json(text)
        rows = connection.execute("SELECT kind, frame, name, step, value FROM current")
        figures = connection.execute("SELECT frame, revision, loss, dice FROM figures")
        steps = tuple(Step(*row) for row in connection.execute("SELECT step, name, time FROM steps ORDER BY step"))
        exports = connection.execute("SELECT time, format, path, frames, settings FROM exports ORDER BY rowid")
        state = ProjectState(identity, steps, position, exports=tuple(ExportRecord(*row) for row in exports))
        entries = {key: Entry(step, value) for key, step, value in (_entry(*row) for row in rows)}
        state = state.with_entries(entries)
        state = state.with_figures({(frame, revision): Figures(*values) for frame, revision, *values in figures})
        for key, entry in entries.items():
            check_edit(identity, key, entry.value)
        if [step.number for step in steps] != list(range(1, len(steps) + 1)) or not 0 <= position <= len(steps):
            raise ValueError("its history has gaps")
    except (ValueError, TypeError, KeyError, ProjectError) as error:
        raise ProjectError(f"project {path} is damaged: {error}. Go back to a copy of it.") from error
    return state


def append(connection: sqlite3.Connection, step: Step, edits: Edits) -> None:
    """Add a step at the present position; steps that were undone are forgotten."""
    for statement in (
        "DELETE FROM steps WHERE step >= ?",
        "DELETE FROM changes WHERE step >= ?",
        "DELETE FROM figures WHERE revision >= ?",
    ):
        connection.execute(statement, (step.number,))
    connection.execute("INSERT INTO steps (step, name, time) VALUES (?, ?, ?)", (step.number, step.name, step.time))
    connection.executemany(
        "INSERT INTO changes (step, kind, frame, name, value) VALUES (?, ?, ?, ?, ?)",
        (
            (step.number, key.kind, key.frame, key.name, None if value is None else value.encode())
            for key, value in edits.items()
        ),
    )
    _set_position(connection, step.number)


def move(connection: sqlite3.Connection, start: int, target: int) -> dict[Key[Any], Entry | None]:
    """Go to another position of the history; gives the entries that may differ there (None: not there)."""
    touched = connection.execute(
        "SELECT DISTINCT kind, frame, name FROM changes WHERE step > ? AND step <= ?", sorted((start, target))
    ).fetchall()
    entries: dict[Key[Any], Entry | None] = {}
    for kind, frame, name in touched:
        row = connection.execute(
            "SELECT kind, frame, name, step, value FROM changes WHERE kind = ? AND frame = ? AND name = ? "
            "AND step <= ? ORDER BY step DESC LIMIT 1",
            (kind, frame, name, target),
        ).fetchone()
        if row is None:
            entries[Key(Kind(kind), frame, name)] = None
        else:
            key, step, value = _entry(*row)
            entries[key] = Entry(step, value)
    _set_position(connection, target)
    return entries


def write_figures(connection: sqlite3.Connection, figures: Mapping[tuple[int, int], Figures]) -> None:
    """Keep figures of (frame, revision)."""
    connection.executemany(
        "INSERT OR REPLACE INTO figures (frame, revision, loss, dice) VALUES (?, ?, ?, ?)",
        ((frame, revision, value.loss, value.dice) for (frame, revision), value in figures.items()),
    )


def write_export(connection: sqlite3.Connection, record: ExportRecord) -> None:
    """Add a line to the log of exports."""
    connection.execute(
        "INSERT INTO exports (time, format, path, frames, settings) VALUES (?, ?, ?, ?, ?)",
        (record.time, record.format, record.path, record.frames, record.settings),
    )


def _set_position(connection: sqlite3.Connection, position: int) -> None:
    connection.execute("UPDATE project SET position = ?", (position,))


def _entry(kind: str, frame: int, name: str, step: int, stored: str | bytes | None) -> tuple[Key[Any], int, Any]:
    key: Key[Any] = Key(Kind(kind), frame, name)
    return key, step, decode(key.kind, stored)
