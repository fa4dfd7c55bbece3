"""Edits on their way into the project: what is still under somebody's hand, and what is saved."""

import time

from carts_core.project import Change, Edits, Figures, Project, ProjectState, Step

LONGEST_DRAFT = 5.0
"""After this long without a change, an edit counts as finished even if nobody said so [s]."""


class Editor:
    """The project and at most one draft: a gesture that is not finished, shown as if it were saved already.

    Attributes:
        project: where finished gestures go.
    """

    def __init__(self, project: Project) -> None:
        self.project = project
        self._name = ""
        self._gesture: object = None
        self._edits: Edits = {}
        self._changed_at = 0.0
        self._view: ProjectState | None = None

    @property
    def view(self) -> ProjectState:
        """The project as the page shows it, the draft included as its last step."""
        return self._view or self.project.state

    @property
    def unsaved(self) -> bool:
        """Whether there is a draft."""
        return self._view is not None

    @property
    def gesture(self) -> object:
        """Of the draft; None without one."""
        return self._gesture

    def draft(self, name: str, edits: Edits, gesture: object) -> None:
        """Change the draft.

        Args:
            name: of the step that it will be.
            edits: what changes; added to what the same gesture changed before.
            gesture: tells drafts apart; an earlier one that could not be saved becomes part of this one.
        """
        self._name, self._gesture = name, gesture
        self._edits = {**self._edits, **edits}
        self._changed_at = time.monotonic()
        saved = self.project.state
        self._view = saved.after(Step(saved.position + 1, name, time.time()), self._edits)

    def drop(self) -> None:
        """Forget the draft."""
        self._gesture, self._edits, self._view = None, {}, None

    def save(self, figures: dict[int, Figures] | None = None) -> None:
        """Save the draft as one step of undo. In a project that takes no edits it stays a draft.

        Raises:
            ProjectError: it could not be saved; it is still there.
        """
        if self._view is None or not self.project.writable:
            return
        # Not tried again at once when the disk is full.
        self._changed_at = time.monotonic()
        self.project.apply(self._name, self._edits, figures)
        self.drop()

    def overdue_in(self) -> float | None:
        """How long until the draft should be saved even if its gesture does not end [s]; None without one."""
        if self._view is None or not self.project.writable:
            return None
        return max(0.0, self._changed_at + LONGEST_DRAFT - time.monotonic())

    def go_to(self, position: int) -> Change | None:
        """Undo or redo until so many steps are done. A draft that cannot be saved is dropped, as undo would.

        Raises:
            ProjectError: it could not be saved, or the project is read-only.
        """
        if self._view is not None and not self.project.writable:
            self.drop()
            return None
        return self.project.go_to(min(max(position, 0), len(self.project.state.steps)))
