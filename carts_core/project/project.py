"""Open project with durable edits, undo and redo, and one writer at a time."""

import json
import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

from ..errors import ProjectError
from ..wording import counted
from . import database, journal
from .identity import SequenceIdentity, default_path
from .state import ExportRecord, ProjectState, Step, by_revision, step_at
from .store import Store, open_or_begin, read_project
from .values import WHOLE_PROJECT, Edits, Figures, FitVerdict, Key, ReviewState, check_edit

if TYPE_CHECKING:
    from ..recording import Sequence


Action = Literal["apply", "undo", "redo", "figures", "export"]


@dataclass(frozen=True)
class Change:
    """Notification of a saved change; the new state is `Project.state`."""

    action: Action
    step: Step | None
    """The step that was done or undone; the last of several steps that were done or undone together."""
    keys: frozenset[Key[Any]]
    """Keys whose values may have changed."""
    frames: tuple[int, ...]
    """Sorted indices of the affected frames; empty for values of the whole project."""


Listener = Callable[[Change], None]


MAX_NAME_LENGTH = 200
"""Maximum length of a step's name [characters]."""


class Project:
    """Project with the corrections of one sequence, stored in one file. Thread-safe.

    Attributes:
        state: current state, an immutable snapshot that is read without a lock.
        read_only_reason: reason why edits cannot be saved, as a sentence; None if the project is writable.

    Args:
        read_only: open without writing; later edits of other processes are not loaded.

    Raises:
        ProjectError: the file belongs to another sequence or to a newer version of carts, is not a project, does not
            exist (if read-only), or cannot be written (folder read-only, disk full). Nothing is changed in these cases.
    """

    def __init__(self, identity: SequenceIdentity, path: Path, *, read_only: bool = False) -> None:
        # Links in the path to the file's folder are allowed; the file itself must not be a link.
        self._path = path.parent.resolve() / path.name
        self.read_only_reason = "It was opened read-only." if read_only else None
        self._edit = threading.RLock()
        self._listeners: list[Listener] = []
        self._store: Store | None = None
        self._storage_failure: str | None = None
        """Incident of the closed store."""
        self.state = self._opened(identity)

    @classmethod
    def open(cls, sequence: "Sequence", path: Path | None = None, *, read_only: bool = False) -> Self:
        """Open the project of a sequence, by default at `default_path`; a missing project is created.

        A project that another process has open for writing is opened read-only; see `writable`. Errors as in the class.
        """
        if path is None:
            path = default_path(Path(sequence.path))
            if not read_only:
                with database.errors_explained(path):
                    path.parent.mkdir(parents=True, exist_ok=True)
        return cls(SequenceIdentity.of(sequence), path, read_only=read_only)

    @property
    def path(self) -> Path:
        """Path of the project file; changes after a rescue, see `storage_failure`."""
        return self._path if self._store is None else self._store.path

    @property
    def writable(self) -> bool:
        """Whether the project accepts edits."""
        return self._store is not None

    @property
    def storage_failure(self) -> str | None:
        """Message describing the failure of the opened file and where edits are now saved; None without a failure."""
        return self._storage_failure if self._store is None else self._store.storage_failure

    @property
    def safe(self) -> bool:
        """Whether all acknowledged edits are on disk, as of the last `check`."""
        return self._store is None or self._store.safe

    def check(self) -> None:
        """Check that the file is unchanged since the last write; otherwise save the project to another file, see
        `storage_failure`.

        Every edit includes this check.

        Raises:
            ProjectError: the file has changed, and the project could not be saved to another file.
        """
        with self._edit:
            if self._store is not None:
                self._store.check()

    def apply(self, name: str, edits: Edits, figures: Mapping[int, Figures] | None = None) -> Change | None:
        """Save edits as one undo step, synchronized to disk on return.

        Args:
            name: name in the history, such as "Drag PSM1"; shortened to `MAX_NAME_LENGTH` characters.
            edits: new values by key; see `ProjectState.changed` for omitted and additional edits.
            figures: frame -> quality figures with these edits, saved even without other changes.

        Returns:
            The saved change; None without a change.

        Raises:
            ProjectError: an edit does not fit the sequence, or could not be saved. In both cases nothing is changed.
        """
        with self._edit:
            state = self.state
            for key, value in edits.items():
                check_edit(state.identity, key, value)
            changed = state.changed(edits)
            if not changed:
                self.record_figures(figures or {}, state)
                return None
            title = " ".join(name.encode("utf-8", "replace").decode().split())
            if not title:
                raise ProjectError("a step has an empty name. Give a name.")
            # Step names contain names of arms, joints and frames, which may be long.
            title = title if len(title) <= MAX_NAME_LENGTH else f"{title[: MAX_NAME_LENGTH - 1]}…"
            step = Step(state.position + 1, title, time.time())
            after = state.after(step, changed)
            known = by_revision(after, figures or {})
            store = self._writer()
            script = journal.append(store.memory, step, changed, len(state.steps))
            store.commit(journal.add_figures(store.memory, script, known))
            return self._saved(after.with_figures(known), "apply", step, changed.keys())

    def undo(self) -> Change | None:
        """Undo the last step; None without a step to undo. `ProjectError` if the change could not be saved."""
        with self._edit:
            return self.go_to(max(self.state.position - 1, 0))

    def redo(self) -> Change | None:
        """Redo the last undone step; None without a step to redo. Errors as in `undo`."""
        with self._edit:
            return self.go_to(min(self.state.position + 1, len(self.state.steps)))

    def go_to(self, position: int) -> Change | None:
        """Undo or redo to a position of the history; None at the current position. `ProjectError` for a position that
        does not exist."""
        with self._edit:
            state = self.state
            if not 0 <= position <= len(state.steps):
                raise ProjectError(
                    f"the history has {counted(len(state.steps), 'step')}, so there is no position {position}."
                )
            if position == state.position:
                return None
            store = self._writer()
            script, entries = journal.move(store.memory, state.position, position)
            store.commit(script)
            back = position < state.position
            step = state.steps[position if back else position - 1]
            moved = replace(state.with_entries(entries), position=position)
            return self._saved(moved, "undo" if back else "redo", step, entries.keys())

    def reverting(self, number: int) -> tuple[Edits, Mapping[int, Figures]]:
        """Edits that undo a single step and keep all later steps, with figures as for `apply`.

        The project is not changed. A frame restored to its state before the step regains its verdict and figures.

        Raises:
            ProjectError: there is no such step, or a later step has changed the same keys.
        """
        with self._edit:
            state = self.state
            if not 1 <= number <= state.position:
                raise ProjectError(f"step {number} is not in effect; the last step in effect is {state.position}.")
            memory = self._writer().memory
            edits, later = journal.before(memory, number, state.position)
            if later is not None:
                raise ProjectError(
                    f"step {number} ({state.steps[number - 1].name}) cannot be reverted alone: step {later} "
                    f"({state.steps[later - 1].name}) has changed the same values since. Revert that step first."
                )
            _, entries = journal.move(memory, state.position, number - 1)
            verdicts, figures = state.regained(state.with_entries(entries), edits)
            return {**edits, **verdicts}, figures

    def accepted(self, frame: int) -> ProjectState | None:
        """State of a frame and of the calibration at the last acceptance of the frame.

        None if the frame was never accepted, or if the project is read-only and the frame is not accepted.
        """
        with self._edit:
            state = self.state
            if state.review(frame).state is ReviewState.ACCEPTED:
                return state
            step = None if self._store is None else journal.acceptance(self._store.memory, frame, state.position)
            if self._store is None or step is None:
                return None
            return state.with_entries(journal.move(self._store.memory, state.position, step)[1])

    def history(self) -> tuple[Step, ...]:
        """All steps, oldest first; those with a number above `state.position` are undone."""
        return self.state.steps

    def record_figures(self, figures: Mapping[int, Figures], state: ProjectState) -> None:
        """Save figures computed for frames of `state`; not an undo step.

        Undo and redo restore figures together with the state of the frames.

        Raises:
            ProjectError: a frame does not exist, or the quality figures could not be saved.
        """
        with self._edit:
            known = by_revision(state, figures)
            # The state may belong to a discarded branch of the history.
            known = {
                key: value for key, value in known.items() if step_at(state, key[1]) == step_at(self.state, key[1])
            }
            if known:
                store = self._writer()
                store.commit(journal.add_figures(store.memory, journal.Transaction(), known))
                self._saved(self.state.with_figures(known), "figures", frames=[frame for frame, _ in known])

    def record_verdict(self, frame: int, verdict: FitVerdict) -> None:
        """Save the verdict on the current fit of a frame; not an undo step. Errors as in `record_figures`."""
        key = Key.verdict(frame)
        with self._edit:
            check_edit(self.state.identity, key, verdict)
            entry = self.state.entry_at_last_change(key, verdict)
            store = self._writer()
            store.commit(journal.add_remark(store.memory, key, entry))
            self._saved(self.state.with_entries({key: entry}), "figures", frames=[frame])

    def log_export(self, format: str, path: Path, frames: int, settings: Mapping[str, Any]) -> None:
        """Log a finished export; not an undo step. `ProjectError` if the log entry could not be saved."""
        record = ExportRecord(time.time(), format, str(path), frames, json.dumps(settings, allow_nan=False))
        with self._edit:
            self._writer().commit(journal.add_export(record))
            self._saved(replace(self.state, exports=(*self.state.exports, record)), "export")

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call `listener` after each save, in order, on the saving thread, until the returned function is called."""
        self._listeners.append(listener)

        def remove() -> None:
            with suppress(ValueError):
                self._listeners.remove(listener)

        return remove

    def close(self) -> None:
        """Close the file, so that other programs can write to it; the state stays readable. `ProjectError` if saved
        edits are lost."""
        with self._edit:
            if self._store is not None:
                store, self._store = self._store, None
                self.read_only_reason = "It was closed."
                try:
                    store.close()
                finally:
                    self._path, self._storage_failure = store.path, store.storage_failure

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _opened(self, identity: SequenceIdentity) -> ProjectState:
        with database.errors_explained(self._path):
            if self.read_only_reason is not None:
                return read_project(self._path, identity)
            state, store = open_or_begin(self._path, identity)
        if isinstance(store, Store):
            self._store = store
        else:
            self.read_only_reason = store
        return state

    def _writer(self) -> Store:
        if self._store is None:
            raise ProjectError(f"project {self._path} cannot be changed. {self.read_only_reason}")
        return self._store

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
            except Exception:  # The edit has been saved.
                logging.getLogger(__name__).exception("a listener of project %s failed", self.path)
        return change


def read_state(path: Path) -> ProjectState:
    """Read the state of a project file of any sequence, even if it is open elsewhere; `ProjectError` if unreadable."""
    with database.errors_explained(path):
        return read_project(path, None)
