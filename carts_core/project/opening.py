"""Opening a project: everything is checked on a copy in memory, so that a file that is refused stays as it is."""

import secrets
import sqlite3
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..errors import OutputError, ProjectError
from ..files import write_new
from . import database, digests, journal, snapshot
from .companions import check_files
from .file import LostFile, ProjectFile
from .identity import SequenceIdentity
from .lock import holder
from .place import rescue_paths
from .rescue import UNREADABLE, rescue
from .state import ProjectState
from .store import Store, file_content


@dataclass(frozen=True)
class Writable:
    """A project that is open for writing."""

    state: ProjectState
    store: Store


@dataclass(frozen=True)
class ReadOnly:
    """What a project says that somebody else has open for writing."""

    state: ProjectState
    reason: str


def open_or_begin(path: Path, identity: SequenceIdentity) -> Writable | ReadOnly:
    """Open the project of a sequence for writing, or for reading where somebody else writes; begin it if it is missing.

    Raises:
        DamagedProject: it is damaged; what can be read of it is in a new file by now.
        ProjectError, OSError, sqlite3.Error: it cannot be opened; nothing is changed.
    """
    if not check_files(path):
        _begin(path, identity)
    file = ProjectFile.locked(path)
    if file is None:
        reason = f"It is open for writing elsewhere ({holder(path)}). Close it there, then open it again."
        return ReadOnly(read(path, identity), reason)
    try:
        memory, state, seal = _load(path, identity, keep_what_is_left=True)
        return Writable(state, Store(memory, seal, state.position, file))
    except LostFile as lost:
        file.abandon()
        raise ProjectError(f"project {path} {lost} while it was being opened. Open it again.") from lost
    except BaseException:
        file.dismiss()
        raise


def read(path: Path, identity: SequenceIdentity | None) -> ProjectState:
    """State of the project of a sequence, or with None of any sequence.

    Raises:
        DamagedProject, ProjectError, OSError, sqlite3.Error: it cannot be read.
    """
    memory, state, _ = _load(path, identity, keep_what_is_left=False)
    memory.close()
    return state


def _begin(path: Path, identity: SequenceIdentity) -> None:
    try:
        # Who began it in the same moment has made the same.
        write_new(path, file_content(database.empty(identity)))
    except OutputError as error:
        if isinstance(error.__cause__, OSError):
            raise error.__cause__ from error
        raise ProjectError(str(error)) from error


def _load(
    path: Path, identity: SequenceIdentity | None, *, keep_what_is_left: bool
) -> tuple[sqlite3.Connection, ProjectState, digests.Seal]:
    """A copy of the file in memory, migrated, and what it says."""
    content = snapshot.read(path)
    try:
        copy = snapshot.open_copy(content, path)
    except sqlite3.Error as error:
        raise database.DamagedProject(
            f"project {path} is damaged: {error}. It was not changed. Nothing of it can be read. Go back to a copy of "
            "it."
        ) from error
    try:
        state, seal = _checked(copy)
    except (ProjectError, sqlite3.Error, *UNREADABLE) as error:
        raise _damaged(path, identity, copy, error, keep_what_is_left=keep_what_is_left) from error
    if identity is not None and (difference := state.identity.difference(identity)) is not None:
        copy.connection.close()
        raise ProjectError(
            f"project {path} belongs to another sequence ({state.identity.name!r}, not {identity.name!r}): "
            f"{difference}. Nothing was changed. Open it with its own sequence, or name another project file."
        )
    return copy.connection, state, seal


def _checked(copy: snapshot.Copy) -> tuple[ProjectState, digests.Seal]:
    snapshot.check(copy)
    memory = copy.connection
    if database.SEALED <= database.version(memory) < len(database.MIGRATIONS):
        digests.verify(memory)
    database.migrate(memory, secrets.token_bytes(digests.NONCE_BYTES))
    return journal.load(memory)


def _damaged(
    path: Path, identity: SequenceIdentity | None, copy: snapshot.Copy, error: BaseException, *, keep_what_is_left: bool
) -> ProjectError:
    """The error for a damaged file; what can be read of it is in a new file by then, where that is asked for."""
    reason = (
        str(error).rstrip(".") if isinstance(error, ProjectError | sqlite3.Error) else f"unreadable values ({error})"
    )
    begin = f"project {path} is damaged: {reason}. It was not changed."
    if not keep_what_is_left or identity is None:
        return database.DamagedProject(f"{begin} Open it for writing to have what can be read of it rescued.")
    rescued = rescue(copy, identity)
    copy.connection.close()
    if rescued is None:
        return database.DamagedProject(f"{begin} Nothing of it can be read. Go back to a copy of it.")
    when = time.time()
    with suppress(OSError, OverflowError, ValueError):
        # The time of the file: whoever tries again finds what was rescued already.
        when = path.stat().st_mtime
        time.localtime(when)
    target, new = next(rescue_paths(path, when)), False
    with suppress(OutputError):
        new = write_new(target, file_content(rescued.connection))
    rescued.connection.close()
    if not new and not target.exists():
        return database.DamagedProject(f"{begin} {rescued.text}, but {target} could not be written. Make room for it.")
    was = "is now" if new else "was rescued before and is"
    return database.DamagedProject(
        f"{begin} {rescued.text}; that {was} in {target}. Go back to a copy of the project, or go on with what was "
        f"rescued: --project '{target}'."
    )
