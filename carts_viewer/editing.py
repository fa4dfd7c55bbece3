"""Edits by several users: drafts, undo steps, and the owners of steps.

A single open tab moves freely in the history, over steps of closed tabs too. With several open tabs, undo adds a step
that reverts the last step that is the user's own or has no owner, such as a step from before the viewer started; steps
of other users stay in effect.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from carts_core.errors import CartsError, ProjectError
from carts_core.project import Change, Edits, Figures, Kind, Project, ProjectState, Review, Step

MAX_NAME_LENGTH = 30
"""Maximum length of a user's name [characters]."""


@dataclass(eq=False)
class Person:
    """The user of one tab."""

    number: int
    """Number of the user, from 1 in order of arrival."""
    chosen: str = ""
    """Chosen name, or empty."""
    present: bool = True
    """Whether their tab is open."""
    index: int = 0
    """Index of the shown frame."""
    undone: list[int] = field(default_factory=list)
    """Numbers of the user's *Undo* steps, which redo reverts; the newest last."""

    @property
    def name(self) -> str:
        """Name that other users see."""
        return self.chosen or f"Tab {self.number}"


class People:
    """Users of a project and their steps in its history; used on the worker's thread only.

    Attributes:
        project: the project.
        persons: users in order of arrival.
    """

    def __init__(self, project: Project) -> None:
        self.project = project
        self.persons: list[Person] = []
        self._makers: dict[int, Person] = {}
        """Owner by step number, for steps since the viewer started."""
        self._reverted: set[int] = set()
        """Steps that undo skips: reverted steps, the steps that revert them, and steps that cannot be reverted."""

    def join(self) -> Person:
        """Add a user."""
        person = Person(max((person.number for person in self.persons), default=0) + 1)
        self.persons.append(person)
        return person

    def leave(self, person: Person) -> None:
        """Remove a user; their steps then have no owner."""
        self.persons.remove(person)
        self._makers = {number: maker for number, maker in self._makers.items() if maker is not person}

    @property
    def several(self) -> bool:
        """Whether several users are present."""
        return sum(person.present for person in self.persons) > 1

    def apply(
        self, person: Person, name: str, edits: Edits, figures: Mapping[int, Figures] | None = None
    ) -> Change | None:
        """Save a step of a user, with the user's name if the user has chosen one or several users are present.

        Errors as in `Project.apply`.
        """
        person.undone.clear()
        return self._apply(person, name, edits, figures)

    def claim(self, person: Person) -> None:
        """Assign the newest step to this user; undone steps that it replaced are forgotten."""
        number = self.project.state.position
        self._makers = {known: maker for known, maker in self._makers.items() if known < number} | {number: person}
        self._reverted = {known for known in self._reverted if known < number}
        for one in self.persons:
            one.undone = [known for known in one.undone if known < number]

    def can_undo(self, person: Person) -> bool:
        """Whether this user may have a step to undo."""
        return self.project.state.position > 0 and (not self.several or self._last(person) is not None)

    def can_redo(self, person: Person) -> bool:
        """Whether this user has a step to redo."""
        return bool(person.undone) or self._next_is_free(person)

    def undo(self, person: Person) -> Change | None:
        """Undo the user's last step; None if there is no step to undo.

        A later step without an owner is undone first.

        Raises:
            CartsError: a later step has changed the same values.
            ProjectError: the change could not be saved.
        """
        position, own = self.project.state.position, self._last(person)
        if not self.several and own in (None, position):
            return self.project.go_to(max(position - 1, 0))
        if own is None:
            return None
        try:
            edits, figures = self.project.reverting(own)
        except ProjectError as error:
            self._reverted.add(own)
            raise CartsError(f"{error} Undo again to revert your previous step.") from error
        change = self._revert(person, own, "Undo", edits, figures)
        person.undone.append(self.project.state.position)
        return change

    def redo(self, person: Person) -> Change | None:
        """Redo the last step that this user has undone; None if there is no such step. Errors as in `undo`."""
        if person.undone:
            number = person.undone[-1]
            person.undone.pop()
            change = self._revert(person, number, "Redo", *self.project.reverting(number))
            # A redone step can be undone again.
            self._reverted.discard(self.project.state.position)
            return change
        return self.project.go_to(self.project.state.position + 1) if self._next_is_free(person) else None

    def go_to(self, person: Person, position: int) -> Change | None:
        """Go to a position in the history.

        Raises:
            CartsError: steps of another present user would be undone or redone.
            ProjectError: the change could not be saved.
        """
        project = self.project
        between = range(min(position, project.state.position) + 1, max(position, project.state.position) + 1)
        others = [
            maker.name
            for number in between
            if (maker := self._makers.get(number)) is not None and maker is not person and maker.present
        ]
        if others:
            raise CartsError(
                f"This would affect steps of other active users: {', '.join(sorted(set(others)))}. Revert your own "
                "steps with Undo, or wait until they have left."
            )
        person.undone.clear()
        return project.go_to(position)

    def _last(self, person: Person) -> int | None:
        """Last step in effect of this user or without an owner; for a user alone also of users who are absent."""
        others = [one for one in self.persons if one is not person and (one.present or self.several)]
        done = range(self.project.state.position, 0, -1)
        return next((n for n in done if n not in self._reverted and self._maker(n) not in others), None)

    def _maker(self, number: int) -> Person | None:
        """Owner of a step; for steps from before the viewer started, the user whose name precedes that of the step."""
        if number in self._makers:
            return self._makers[number]
        name = self.project.state.steps[number - 1].name
        return next((one for one in self.persons if one.chosen and name.startswith(f"{one.chosen}: ")), None)

    def _next_is_free(self, person: Person) -> bool:
        """Whether the user may redo the next step of the history: it is their own, or no other user is present."""
        state = self.project.state
        if state.position == len(state.steps):
            return False
        maker = self._makers.get(state.position + 1)
        return maker is person or not self.several

    def _revert(
        self, person: Person, number: int, verb: str, edits: Edits, figures: Mapping[int, Figures]
    ) -> Change | None:
        name = self.project.state.steps[number - 1].name
        for known in ("Undo: ", "Redo: ", f"{person.name}: "):
            name = name.replace(known, "")
        change = self._apply(person, f"{verb}: {name}", edits, figures)
        self._reverted |= {number, self.project.state.position}
        return change

    def _apply(self, person: Person, name: str, edits: Edits, figures: Mapping[int, Figures] | None) -> Change | None:
        named = f"{person.name}: {name}" if person.chosen or self.several else name
        change = self.project.apply(named, edits, figures)
        if change is not None:
            self.claim(person)
        return change


MAX_DRAFT_SECONDS = 5.0
"""Time without a change after which a draft is saved [s]."""


class Editor:
    """Edits of one user in a project, with at most one draft (an unfinished gesture).

    Attributes:
        project: receives finished gestures.
        people: users of the project.
        person: the user.
    """

    def __init__(self, people: People, person: Person) -> None:
        self.project: Project = people.project
        self.people = people
        self.person = person
        self._name = ""
        self._gesture: object = None
        self._edits: Edits = {}
        self._changed_at = 0.0
        self._base = self.project.state
        """The saved state at the start of the draft."""
        self._view: tuple[ProjectState, ProjectState] | None = None
        """The saved state, and that state with the draft; None without a draft."""

    @property
    def view(self) -> ProjectState:
        """The project with the draft as its last step."""
        if self._view is None:
            return self.project.state
        if self._view[0] is not self.project.state:
            # Another user has saved edits since.
            self._lay_draft()
        return self._view[1]

    @property
    def unsaved(self) -> bool:
        """Whether there is a draft."""
        return self._view is not None

    @property
    def gesture(self) -> object:
        """Gesture of the draft; None if there is no draft."""
        return self._gesture

    @property
    def can_undo(self) -> bool:
        """Whether there may be a step to undo."""
        return self.unsaved or self.people.can_undo(self.person)

    @property
    def can_redo(self) -> bool:
        """Whether there is a step to redo."""
        return not self.unsaved and self.people.can_redo(self.person)

    def draft(self, name: str, edits: Edits, gesture: object) -> None:
        """Change the draft. Later edits of other users remain where the draft does not change the saved value.

        Args:
            name: name of the step that the draft becomes.
            edits: the changes; merged with earlier changes of the same gesture.
            gesture: identifies the draft; an earlier draft that could not be saved is merged into this one.
        """
        self._name, self._gesture = name, gesture
        if self._view is None:
            self._base = self.project.state
        self._edits = {**self._edits, **_rebased(edits, self.project.state, self._base)}
        self._changed_at = time.monotonic()
        self._lay_draft()

    def drop(self) -> None:
        """Discard the draft."""
        self._gesture, self._edits, self._view = None, {}, None

    def save(self, figures: dict[int, Figures] | None = None) -> None:
        """Save the draft as one undo step. In a read-only project it remains a draft.

        Raises:
            ProjectError: the draft could not be saved, and is kept.
        """
        if self._view is None or not self.project.writable:
            return
        # If the disk is full, the next attempt is made only after a pause.
        self._changed_at = time.monotonic()
        self.apply(self._name, _rebased(self._edits, self._base, self.project.state), figures)
        self.drop()

    def apply(self, name: str, edits: Edits, figures: Mapping[int, Figures] | None = None) -> Change | None:
        """Save edits as one undo step of this user, without a draft; errors are those of `Project.apply`."""
        return self.people.apply(self.person, name, edits, figures)

    def claim(self) -> None:
        """Assign the newest step of the project to this user."""
        self.people.claim(self.person)

    def overdue_in(self) -> float | None:
        """Time until the draft is saved even if its gesture does not end [s]; None if there is no draft to save."""
        if self._view is None or not self.project.writable:
            return None
        return max(0.0, self._changed_at + MAX_DRAFT_SECONDS - time.monotonic())

    def undo(self) -> Change | None:
        """Undo this user's last step, or drop a draft that cannot be saved.

        Raises:
            CartsError: a later step has changed the same values.
            ProjectError: the change could not be saved, or the project is read-only.
        """
        return None if self._dropped() else self.people.undo(self.person)

    def redo(self) -> Change | None:
        """Redo this user's last undone step; drafts and errors as in `undo`."""
        return None if self._dropped() else self.people.redo(self.person)

    def go_to(self, position: int) -> Change | None:
        """Undo or redo until this number of steps is in effect; drafts as in `undo`.

        Raises:
            CartsError: steps of another present user would be undone or redone.
            ProjectError: the change could not be saved, or the project is read-only.
        """
        if self._dropped():
            return None
        return self.people.go_to(self.person, min(max(position, 0), len(self.project.state.steps)))

    def _dropped(self) -> bool:
        """Drop a draft that cannot be saved; returns whether there was one."""
        if self._view is None or self.project.writable:
            return False
        self.drop()
        return True

    def _lay_draft(self) -> None:
        saved = self.project.state
        edits = _rebased(self._edits, self._base, saved)
        edits = {**edits, **saved.changed(edits)}
        self._view = saved, saved.after(Step(saved.position + 1, self._name, time.time()), edits)


def _rebased(edits: Edits, start: ProjectState, end: ProjectState) -> Edits:
    """Edits with values as in `start` replaced by those in `end`; state and note of a review are separate values."""
    if start is end:
        return edits
    rebased = dict(edits)
    for key, value in edits.items():
        if key.kind is Kind.REVIEW:
            own, old, new = value or Review(), start.review(key.frame), end.review(key.frame)
            state, note = own.state if own.state is not old.state else new.state, own.note
            review = Review(state, note if note != old.note else new.note)
            rebased[key] = None if review == Review() else review
        elif value == start.get(key):
            rebased[key] = end.get(key)
    return rebased
