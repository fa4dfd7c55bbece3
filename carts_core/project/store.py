"""Opening, committing and rescuing of projects; a project is a file with an in-memory copy.

All checks run on the copy first, so a refused file is not changed. A file that is lost while open is rescued from the
copy. The readable content of a damaged file is saved as a new project.
"""

import logging
import secrets
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import CartsError, OutputError, ProjectError
from ..files import write_new
from ..wording import counted
from . import database, journal
from .database import NONCE_BYTES, TABLES, Seal, row_digest, seal, verify
from .file import Copy, LostFile, ProjectFile, SealRow, check_copy, check_files, holder, open_copy, read_files
from .identity import SequenceIdentity, data_dir, rescue_paths
from .journal import Transaction
from .state import ProjectState
from .values import Figures, Key, Kind, check_edit, decode

UNREADABLE = (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError, MemoryError)
"""Exceptions raised when decoding untrusted values, in addition to `ProjectError`."""
_TYPES: dict[str, tuple[Any, ...]] = {
    "steps": (int, str, float),
    "changes": (str, int, str, int, str | bytes | None),
    "figures": (int, int, float | None, float | None),
    "exports": (float, str, str, int, str),
}
"""Table -> types of a row's values."""
_LISTED = 5
_LOST_STEP = "Step (name lost)"


@dataclass
class Rescued:
    """Rescued project in memory, with a report."""

    connection: sqlite3.Connection
    kept: int = 0
    lost: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        """Summary of the rescue, as a clause."""
        named = ", ".join(self.lost[:_LISTED]) + (" and more" if len(self.lost) > _LISTED else "")
        missing = f"{len(self.lost)} could not be read ({named})" if self.lost else "missing rows are unknown"
        return f"{counted(self.kept, 'row')} could be read; {missing}"


def rescue(copy: Copy, identity: SequenceIdentity) -> Rescued | None:
    """Rescue the readable content of a project of this sequence; None without readable content."""
    old = copy.connection
    rescued = Rescued(database.empty(identity))
    tables = {table: list(_rows(copy, table, rescued)) for table in TABLES}
    for table in ("changes", "figures"):
        tables[table] = [row for row in tables[table] if _fits(identity, table, row, rescued)]
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
        seal(new, b"")
    rescued.kept = len(steps) + len(changes) + len(figures) + len(tables["exports"])
    if rescued.kept:
        return rescued
    rescued.connection.close()
    return None


def _insert(new: sqlite3.Connection, table: str, rows: list[tuple]) -> None:
    columns = TABLES[table]
    marks = ", ".join("?" * len(columns))
    new.executemany(f"INSERT INTO {table} ({', '.join(columns)}) VALUES ({marks})", rows)


def _rows(copy: Copy, table: str, rescued: Rescued) -> Iterator[tuple]:
    """Intact rows of a table, read from both ends up to unreadable parts."""
    connection, columns = copy.connection, ", ".join(TABLES[table])
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
                    typed = all(isinstance(value, kind) for value, kind in zip(row, _TYPES[table], strict=True))
                    if (sealed and row_digest(table, row) != written) or not typed:
                        rescued.lost.append(f"a row of {table}")
                    else:
                        yield tuple(row)
            return
        except (sqlite3.Error, *UNREADABLE):
            rescued.lost.append(f"a part of {table}")


def _fits(identity: SequenceIdentity, table: str, row: tuple, rescued: Rescued) -> bool:
    """Whether a row of changes or figures belongs to a sequence."""
    what, frame = row[:2] if table == "changes" else (table, row[0])
    try:
        if table == "changes":
            key: Key[Any] = Key(Kind(what), frame, row[2])
            check_edit(identity, key, decode(key.kind, row[4]))
        else:
            check_edit(identity, Key.review(frame), None)
            Figures(*row[2:])
    except (ProjectError, *UNREADABLE):
        rescued.lost.append(f"{what} of frame number {frame}")
        return False
    return True


def _position(old: sqlite3.Connection, numbers: list[int]) -> int:
    """Number of steps in effect; all steps if the position cannot be read."""
    try:
        (position,) = old.execute("SELECT position FROM project").fetchone()
    except (sqlite3.Error, TypeError):
        return len(numbers)
    return sum(number <= position for number in numbers) if isinstance(position, int) else len(numbers)


_log = logging.getLogger(__name__)

_WRITE_VERSION = slice(18, 20)
"""Header bytes of the journal mode."""
_LOG = b"\2\2"
_TRIES = 3


def file_content(memory: sqlite3.Connection) -> bytes:
    """File content of a project in memory."""
    content = bytearray(memory.serialize())
    content[_WRITE_VERSION] = _LOG
    return bytes(content)


class Store:
    """A project open for writing.

    Attributes:
        memory: connection to the in-memory copy.
        path: file to which edits are written; changes after a rescue.
        storage_failure: message describing the failure of the opened file; None without a failure.
    """

    def __init__(self, memory: sqlite3.Connection, seal: Seal, position: int, file: ProjectFile) -> None:
        self.memory = memory
        self.path = file.path
        self.storage_failure: str | None = None
        self._what = "was lost"
        self._seal = seal
        self._position = position
        self._file: ProjectFile | None = file
        file.connect(seal.nonce, self._row())

    @property
    def safe(self) -> bool:
        """Whether all acknowledged edits are on disk, as of the last check."""
        return self._file is not None

    def commit(self, script: Transaction) -> None:
        """Write a transaction to `path`; `ProjectError` if it could not be written."""
        position = self._position if script.position is None else script.position
        seal = self._seal.plus(script.digests)
        row = seal.row(position)
        statements = [*script.statements, ("UPDATE seal SET total = ?, digest = ?", [row[1:]])]
        if position != self._position:
            statements.append(("UPDATE project SET position = ?", [(position,)]))
        for _ in range(_TRIES):
            try:
                self._usable().commit(statements, row)
                break
            except LostFile as lost:
                self._rescue(str(lost))
        else:
            raise ProjectError(f"project {self.path} was lost repeatedly. {self.storage_failure}")
        with database.transaction(self.memory) as memory:
            for statement, rows in statements:
                memory.executemany(statement, rows)
        self._seal, self._position = seal, position
        self._guarded(lambda file: file.checkpoint())

    def check(self) -> None:
        """Check that the file is unchanged since the last write; otherwise rescue the project, or raise
        `ProjectError`."""
        self._guarded(lambda file: file.check())

    def close(self) -> None:
        """Close the file and verify its content; `ProjectError` if acknowledged edits are not on disk."""
        for _ in range(_TRIES):
            try:
                self._usable().close()
                break
            except LostFile as lost:
                self._rescue(str(lost))
        self.memory.close()
        self._file = None

    def _row(self) -> SealRow:
        return self._seal.row(self._position)

    def _guarded(self, action: Callable[[ProjectFile], None]) -> None:
        file = self._usable()
        try:
            action(file)
        except LostFile as lost:
            self._rescue(str(lost))

    def _usable(self) -> ProjectFile:
        if self._file is None:
            self._rescue("was lost")
        assert self._file is not None, "a rescue that fails is an error"
        return self._file

    def _rescue(self, what: str) -> None:
        """Write the project to a new file, which is used instead of the lost file."""
        lost = self.path
        if self._file is not None:
            self._what = what
            self._file.abandon()
            self._file = None
        what = self._what
        content, failure = file_content(self.memory), ""
        for path in rescue_paths(lost, time.time()):
            try:
                self._file = self._moved_to(path, content)
            except (CartsError, OSError) as error:
                failure = str(error)
            if self._file is not None:
                break
        else:
            failed = (
                f"NOT SAVED: project {lost} {what} while it was open, and its edits could not be saved to another file "
                f"either ({failure}). They are in memory. Free disk space, or make the folder writable; saving is "
                "retried."
            )
            if failed != self.storage_failure:
                _log.error("%s", failed)
            self.storage_failure = failed
            raise ProjectError(failed)
        self.path = self._file.path
        self.storage_failure = (
            f"Project {lost} {what} while it was open. Every edit was saved to {self.path}; further edits are "
            f"saved there. To open it again: --project '{self.path}'."
        )
        _log.error("%s", self.storage_failure)

    def _moved_to(self, path: Path, content: bytes) -> ProjectFile | None:
        """Create a project file with all content at `path`; None if the name is taken."""
        if path.parent != data_dir() and not path.parent.is_dir():
            return None
        if not write_new(path, content):
            return None
        file = ProjectFile.locked(path)
        if file is None:
            return None
        try:
            file.connect(self._seal.nonce, self._row())
        except BaseException:
            file.abandon()
            raise
        return file


def open_or_begin(path: Path, identity: SequenceIdentity) -> tuple[ProjectState, Store | str]:
    """Open the project of a sequence; a missing project is created. Returns the state, and the store or a message that
    another process has the project open.

    Raises:
        DamagedProject: the project is damaged; its readable content was saved to a new file.
        ProjectError, OSError, sqlite3.Error: the project cannot be opened; nothing is changed.
    """
    if not check_files(path):
        _begin(path, identity)
    file = ProjectFile.locked(path)
    if file is None:
        reason = f"It is open for writing elsewhere ({holder(path)}). Close it there and open it again."
        return read_project(path, identity), reason
    try:
        memory, state, seal = _load(path, identity, keep_what_is_left=True)
        return state, Store(memory, seal, state.position, file)
    except LostFile as lost:
        file.abandon()
        raise ProjectError(f"project {path} {lost} while it was being opened. Open it again.") from lost
    except BaseException:
        file.dismiss()
        raise


def read_project(path: Path, identity: SequenceIdentity | None) -> ProjectState:
    """Read the state of the project of a sequence, or of any sequence; errors are those of `open_or_begin`, but the
    content of a damaged project is not saved."""
    memory, state, _ = _load(path, identity, keep_what_is_left=False)
    memory.close()
    return state


def _begin(path: Path, identity: SequenceIdentity) -> None:
    try:
        # If another process creates the file concurrently, its empty project is used.
        write_new(path, file_content(database.empty(identity)))
    except OutputError as error:
        if isinstance(error.__cause__, OSError):
            raise error.__cause__ from error
        raise ProjectError(str(error)) from error


def _load(
    path: Path, identity: SequenceIdentity | None, *, keep_what_is_left: bool
) -> tuple[sqlite3.Connection, ProjectState, Seal]:
    """Load a migrated copy of the file into memory, with its state and seal."""
    content = read_files(path)
    try:
        copy = open_copy(content, path)
    except sqlite3.Error as error:
        raise database.DamagedProject(
            f"project {path} is damaged: {error}. The file was not changed and cannot be read. Restore a backup copy."
        ) from error
    try:
        state, seal = _checked(copy)
    except (ProjectError, sqlite3.Error, *UNREADABLE) as error:
        raise _damaged(path, identity, copy, error, keep_what_is_left=keep_what_is_left) from error
    if identity is not None and (difference := state.identity.difference(identity)) is not None:
        copy.connection.close()
        raise ProjectError(
            f"project {path} belongs to another sequence ({state.identity.name!r}, not {identity.name!r}): "
            f"{difference}. Nothing was changed. Open it with its sequence, or choose another project file."
        )
    return copy.connection, state, seal


def _checked(copy: Copy) -> tuple[ProjectState, Seal]:
    check_copy(copy)
    memory = copy.connection
    if database.SEALED <= database.version(memory) < len(database.MIGRATIONS):
        verify(memory)
    database.migrate(memory, secrets.token_bytes(NONCE_BYTES))
    return journal.load(memory)


def _damaged(
    path: Path, identity: SequenceIdentity | None, copy: Copy, error: BaseException, *, keep_what_is_left: bool
) -> ProjectError:
    """Error for a damaged file; if requested, the readable content is rescued to a new file first."""
    reason = (
        str(error).rstrip(".") if isinstance(error, ProjectError | sqlite3.Error) else f"unreadable values ({error})"
    )
    begin = f"project {path} is damaged: {reason}. The file was not changed."
    if not keep_what_is_left or identity is None:
        return database.DamagedProject(f"{begin} Open it for writing to rescue its readable content.")
    rescued = rescue(copy, identity)
    copy.connection.close()
    if rescued is None:
        return database.DamagedProject(f"{begin} It cannot be read. Restore a backup copy.")
    when = time.time()
    with suppress(OSError, OverflowError, ValueError):
        # The name contains the file's modification time, so that another attempt finds the same rescued file.
        when = path.stat().st_mtime
        time.localtime(when)
    target, new = next(rescue_paths(path, when)), False
    with suppress(OutputError):
        new = write_new(target, file_content(rescued.connection))
    rescued.connection.close()
    if not new and not target.exists():
        return database.DamagedProject(f"{begin} {rescued.text}, but {target} could not be written. Free disk space.")
    was = "is now" if new else "was rescued earlier and is"
    return database.DamagedProject(
        f"{begin} {rescued.text}. The readable content {was} in {target}. Restore a backup copy, or continue with "
        f"the rescued file: --project '{target}'."
    )
