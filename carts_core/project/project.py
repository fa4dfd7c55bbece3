"""An open project: edits that are on disk before the call returns, undo and redo, one writer at a time."""

import json
import logging
import sqlite3
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import AbstractContextManager, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from ..errors import ProjectError
from ..wording import counted
from . import database, journal
from .identity import SequenceIdentity
from .keys import WHOLE_PROJECT, Edits, Key, check_edit
from .lock import WriterLock
from .place import default_path
from .state import ExportRecord, ProjectState, Step
from .values import Figures

if TYPE_CHECKING:
    from ..data import Sequence

LONGEST_NAME = 200
"""Characters of a step's name."""


Action = Literal["apply", "undo", "redo", "figures", "export"]


@dataclass(frozen=True)
class Change:
    """What has just been saved. The new state is that of the project."""

    action: Action
    step: Step | None
    """The step that was done or, for "undo", taken back; the furthest one when several were passed."""
    keys: frozenset[Key[Any]]
    """What may have another value now."""
    frames: tuple[int, ...]
    """Indices of the frames that it is about, in order; values of the whole project aside."""


class Project:
    """The corrections of one sequence, in one file. Safe to use from several threads.

    Attributes:
        path: the file.
        state: what it says now. An immutable snapshot, which reading needs no lock for.
        read_only_reason: for people, why nothing can be saved; None if it can.

    Args:
        identity: of the sequence.
        path: the file; it is made if it is not there and may be written.
        read_only: do not write. What another process saves later is not seen.

    Raises:
        ProjectError: the file belongs to another sequence or to a newer version of carts, is not a project, is not
            there (read-only), or cannot be written (folder read-only, disk full). Nothing is changed then.
    """

    def __init__(self, identity: SequenceIdentity, path: Path, *, read_only: bool = False) -> None:
        self.path = path.resolve()
        self.read_only_reason = "It was opened read-only." if read_only else None
        self._edit = threading.RLock()
        self._listeners: list[Callable[[Change], None]] = []
        self._connection: sqlite3.Connection | None = None
        self._writer: WriterLock | None = None
        if not read_only:
            self._lock_or_explain()
        try:
            self.state = self._load(identity)
        except BaseException:
            self.close()
            raise

    @classmethod
    def open(cls, sequence: "Sequence", path: Path | None = None, *, read_only: bool = False) -> Self:
        """The project of a sequence, begun if there is none; by default at `default_path`.

        While another process has it open for writing, it opens read-only; see `writable` and `read_only_reason`.

        Raises:
            ProjectError: see the class.
        """
        if path is None:
            path = default_path(Path(sequence.path))
            if not read_only:
                with database.errors_explained(path):
                    path.parent.mkdir(parents=True, exist_ok=True)
        return cls(SequenceIdentity.of(sequence), path, read_only=read_only)

    @property
    def writable(self) -> bool:
        """Whether edits are taken."""
        return self._connection is not None

    def apply(self, name: str, edits: Edits, figures: Mapping[int, Figures] | None = None) -> Change | None:
        """Save one gesture as one step of undo. It is on disk when this returns.

        Args:
            name: for the history, say "Drag PSM1".
            edits: what changes; values that are equal to the present ones are left out.
            figures: frame -> figures of the frame with these edits; kept even if nothing else differs.

        Returns:
            What was saved; None if nothing differs.

        Raises:
            ProjectError: an edit does not fit the sequence, or could not be saved. Nothing is changed then.
        """
        with self._edit:
            state = self.state
            for key, value in edits.items():
                check_edit(state.identity, key, value)
            changed = {key: value for key, value in edits.items() if state.get(key) != value}
            if not changed:
                self.record_figures(figures or {}, state)
                return None
            step = Step(state.position + 1, _step_name(name), time.time())
            after = state.after(step, changed)
            known = _by_revision(after, figures or {})
            with self._transaction() as connection:
                journal.append(connection, step, changed)
                journal.write_figures(connection, known)
            return self._saved(after.with_figures(known), "apply", step, changed.keys())

    def undo(self) -> Change | None:
        """Take back the last step; None if there is none.

        Raises:
            ProjectError: it could not be saved.
        """
        with self._edit:
            return self.go_to(max(self.state.position - 1, 0))

    def redo(self) -> Change | None:
        """Do the step again that was undone last; None if there is none.

        Raises:
            ProjectError: it could not be saved.
        """
        with self._edit:
            return self.go_to(min(self.state.position + 1, len(self.state.steps)))

    def go_to(self, position: int) -> Change | None:
        """Undo or redo until so many steps are done; None if they already are.

        Raises:
            ProjectError: the history has no such position, or it could not be saved.
        """
        with self._edit:
            state = self.state
            if not 0 <= position <= len(state.steps):
                raise ProjectError(
                    f"the history has {counted(len(state.steps), 'step')}; position {position} is not among them."
                )
            if position == state.position:
                return None
            with self._transaction() as connection:
                entries = journal.move(connection, state.position, position)
            back = position < state.position
            step = state.steps[position if back else position - 1]
            moved = replace(state.with_entries(entries), position=position)
            return self._saved(moved, "undo" if back else "redo", step, entries.keys())

    def history(self) -> tuple[Step, ...]:
        """All steps, oldest first; those with a number above `state.position` are undone."""
        return self.state.steps

    def record_figures(self, figures: Mapping[int, Figures], state: ProjectState) -> None:
        """Save figures that were computed for frames as they were in `state`. Not a step of undo.

        They come back whenever undo or redo brings those frames back to that state.

        Raises:
            ProjectError: there is no such frame, or it could not be saved.
        """
        with self._edit:
            known = _by_revision(state, figures)
            # The state may be of a branch of the history that was dropped since.
            known = {
                key: value for key, value in known.items() if _step_at(state, key[1]) == _step_at(self.state, key[1])
            }
            if known:
                with self._transaction() as connection:
                    journal.write_figures(connection, known)
                self._saved(self.state.with_figures(known), "figures", frames=[frame for frame, _ in known])

    def log_export(self, format: str, path: Path, frames: int, settings: Mapping[str, Any]) -> None:
        """Save that an export was finished. Not a step of undo.

        Args:
            format: its name.
            path: the file or folder that was written.
            frames: how many frames it holds.
            settings: what JSON can hold.

        Raises:
            ProjectError: it could not be saved.
        """
        record = ExportRecord(time.time(), format, str(path), frames, json.dumps(settings, allow_nan=False))
        with self._edit:
            with self._transaction() as connection:
                journal.write_export(connection, record)
            self._saved(replace(self.state, exports=(*self.state.exports, record)), "export")

    def listen(self, listener: Callable[[Change], None]) -> Callable[[], None]:
        """Call `listener` after each save, in order, on the thread that saves; it should hand on and return.

        Returns:
            A function that ends this.
        """
        self._listeners.append(listener)

        def forget() -> None:
            with suppress(ValueError):
                self._listeners.remove(listener)

        return forget

    def close(self) -> None:
        """Let others write. The state can still be read."""
        with self._edit:
            if self._connection is not None:
                self._connection.close()
                self._connection = None
                self.read_only_reason = "It was closed."
            if self._writer is not None:
                self._writer.release()
                self._writer = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _lock_or_explain(self) -> None:
        lock_file = self.path.with_name(self.path.name + ".lock")
        with database.errors_explained(self.path):
            self._writer = WriterLock.acquire(lock_file)
        if self._writer is None:
            holder = WriterLock.holder(lock_file)
            self.read_only_reason = f"It is open for writing elsewhere ({holder}). Close it there, then open it again."

    def _load(self, identity: SequenceIdentity) -> ProjectState:
        if self._writer is not None and not self.path.exists():
            database.create(self.path, identity)
        # Everything is checked on a copy, so that a file that is refused stays as it is.
        with closing(database.snapshot(self.path)) as copy, database.errors_explained(self.path):
            state = journal.load(copy, self.path)
        difference = state.identity.difference(identity)
        if difference is not None:
            raise ProjectError(
                f"project {self.path} belongs to another sequence ({state.identity.name!r}, not {identity.name!r}): "
                f"{difference}. Nothing was changed. Open it with its own sequence, or name another project file."
            )
        if self._writer is not None:
            self._connection = database.connect(self.path)
        return state

    def _transaction(self) -> AbstractContextManager[sqlite3.Connection]:
        if self._connection is None:
            raise ProjectError(f"project {self.path} cannot be changed. {self.read_only_reason}")
        return database.transaction(self._connection, self.path)

    def _saved(
        self,
        state: ProjectState,
        action: Action,
        step: Step | None = None,
        keys: Collection[Key[Any]] = (),
        frames: Iterable[int] = (),
    ) -> Change:
        self.state = state
        touched = {*frames, *(key.frame for key in keys if key.frame != WHOLE_PROJECT)}
        change = Change(action, step, frozenset(keys), tuple(sorted(touched)))
        for listener in tuple(self._listeners):
            try:
                listener(change)
            except Exception:
                # The edit is saved, so it must not look as if it were not.
                logging.getLogger(__name__).exception("a listener of project %s failed", self.path)
        return change


def _step_name(name: str) -> str:
    text = " ".join(name.encode("utf-8", "replace").decode().split())
    if not 1 <= len(text) <= LONGEST_NAME:
        raise ProjectError(f"a step's name has {len(text)} characters, but must have 1 to {LONGEST_NAME}.")
    return text


def _by_revision(state: ProjectState, figures: Mapping[int, Figures]) -> dict[tuple[int, int], Figures]:
    for frame in figures:
        check_edit(state.identity, Key.review(frame), None)
    return {(frame, state.revision(frame)): value for frame, value in figures.items()}


def _step_at(state: ProjectState, number: int) -> tuple[Step, ...]:
    return state.steps[max(number - 1, 0) : number]
