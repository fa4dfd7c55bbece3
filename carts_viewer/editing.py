"""Edits on their way into the project: what is still under somebody's hand, and what is saved."""

import time
from collections.abc import Mapping

from carts_core.project import Change, Edits, Figures, Project, ProjectState, Step
from carts_viewer.people import People, Person

LONGEST_DRAFT = 5.0
"""After this long without a change, an edit counts as finished even if nobody said so [s]."""


class Editor:
    """The project as one person edits it, and at most one draft: a gesture of theirs that is not finished.

    Attributes:
        project: where finished gestures go.
        people: everybody who edits it.
        person: who edits here.
    """

    def __init__(self, people: People, person: Person) -> None:
        self.project: Project = people.project
        self.people = people
        self.person = person
        self._name = ""
        self._gesture: object = None
        self._edits: Edits = {}
        self._changed_at = 0.0
        self._view: tuple[ProjectState, ProjectState] | None = None
        """The saved state, and that state with the draft; None without a draft."""

    @property
    def view(self) -> ProjectState:
        """The project as this person's page shows it, the draft included as its last step."""
        if self._view is None:
            return self.project.state
        if self._view[0] is not self.project.state:
            # Somebody else has saved something meanwhile.
            self._lay_draft()
        return self._view[1]

    @property
    def unsaved(self) -> bool:
        """Whether there is a draft."""
        return self._view is not None

    @property
    def gesture(self) -> object:
        """Of the draft; None without one."""
        return self._gesture

    @property
    def can_undo(self) -> bool:
        """Whether there may be something to take back."""
        return self.unsaved or self.people.can_undo(self.person)

    @property
    def can_redo(self) -> bool:
        """Whether there is something to do again."""
        return not self.unsaved and self.people.can_redo(self.person)

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
        self._lay_draft()

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
        self.apply(self._name, self._edits, figures)
        self.drop()

    def apply(self, name: str, edits: Edits, figures: Mapping[int, Figures] | None = None) -> Change | None:
        """Save edits as one step of undo of this person's, without a draft; errors as `Project.apply`."""
        return self.people.apply(self.person, name, edits, figures)

    def claim(self) -> None:
        """The newest step of the project is this person's."""
        self.people.claim(self.person)

    def overdue_in(self) -> float | None:
        """How long until the draft should be saved even if its gesture does not end [s]; None without one."""
        if self._view is None or not self.project.writable:
            return None
        return max(0.0, self._changed_at + LONGEST_DRAFT - time.monotonic())

    def undo(self) -> Change | None:
        """Take back this person's last step. A draft that cannot be saved is dropped, as undo would.

        Raises:
            ProjectError: it could not be saved, the project is read-only, or somebody has changed the same since.
        """
        return None if self._dropped() else self.people.undo(self.person)

    def redo(self) -> Change | None:
        """Do again what this person took back last; drafts and errors as `undo`."""
        return None if self._dropped() else self.people.redo(self.person)

    def go_to(self, position: int) -> Change | None:
        """Undo or redo until so many steps are done; drafts as `undo`.

        Raises:
            CartsError: steps of somebody else who is at work are in between.
            ProjectError: it could not be saved, or the project is read-only.
        """
        if self._dropped():
            return None
        return self.people.go_to(self.person, min(max(position, 0), len(self.project.state.steps)))

    def _dropped(self) -> bool:
        """Drop a draft that cannot be saved; whether there was one."""
        if self._view is None or self.project.writable:
            return False
        self.drop()
        return True

    def _lay_draft(self) -> None:
        saved = self.project.state
        edits = {**self._edits, **saved.changed(self._edits)}
        self._view = saved, saved.after(Step(saved.position + 1, self._name, time.time()), edits)
