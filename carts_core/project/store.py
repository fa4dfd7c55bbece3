"""Where a project's edits go: into its file, and into a copy of it in memory, from which everything can be rescued."""

import logging
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path

from ..errors import CartsError, ProjectError
from ..files import write_new
from . import database, digests
from .file import LostFile, ProjectFile, SealRow
from .journal import Script
from .place import data_dir, rescue_paths

_log = logging.getLogger(__name__)

_WRITE_VERSION = slice(18, 20)
"""Bytes that say whether a database keeps a log."""
_LOG = b"\2\2"
_TRIES = 3


def file_content(memory: sqlite3.Connection) -> bytes:
    """What a project in memory is as a file."""
    content = bytearray(memory.serialize())
    content[_WRITE_VERSION] = _LOG
    return bytes(content)


class Store:
    """An open project that is written to.

    Attributes:
        memory: the same as the file, in memory.
        path: the file that edits go to; another one after a rescue.
        incident: what has happened to the file that was opened, for people; None if nothing has.
    """

    def __init__(self, memory: sqlite3.Connection, seal: digests.Seal, position: int, file: ProjectFile) -> None:
        self.memory = memory
        self.path = file.path
        self.incident: str | None = None
        self._what = "was lost"
        self._seal = seal
        self._position = position
        self._file: ProjectFile | None = file
        file.connect(seal.nonce, self._row())

    @property
    def safe(self) -> bool:
        """Whether everything that was acknowledged is on disk, as far as was seen."""
        return self._file is not None

    def commit(self, script: Script) -> None:
        """Write a transaction; it is on disk, in `path`, when this returns.

        Raises:
            ProjectError: it could not be written; nothing of it was.
        """
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
            raise ProjectError(f"project {self.path} is lost again and again. {self.incident}")
        with database.transaction(self.memory) as memory:
            for statement, rows in statements:
                memory.executemany(statement, rows)
        self._seal, self._position = seal, position
        self._guarded(lambda file: file.checkpoint())

    def check(self) -> None:
        """See that the file is still there and as it was left; rescue everything if not.

        Raises:
            ProjectError: it is lost, and nothing could be rescued to a disk yet.
        """
        self._guarded(lambda file: file.check())

    def close(self) -> None:
        """Close the file, and read back that it holds everything.

        Raises:
            ProjectError: what was acknowledged is nowhere on disk.
        """
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
        """Write everything to a new file, and go on with that."""
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
                f"NOT SAVED: project {lost} {what} while it was open, and its edits could not be saved elsewhere "
                f"either ({failure}). They are in memory. Make room, or make the folder writable: it is tried again."
            )
            if failed != self.incident:
                _log.error("%s", failed)
            self.incident = failed
            raise ProjectError(failed)
        self.path = self._file.path
        self.incident = (
            f"Project {lost} {what} while it was open. Every edit was saved to {self.path}, and edits go on being "
            f"saved there. To open it again: --project '{self.path}'."
        )
        _log.error("%s", self.incident)

    def _moved_to(self, path: Path, content: bytes) -> ProjectFile | None:
        """A new project file with everything in it; None if its name is taken."""
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
