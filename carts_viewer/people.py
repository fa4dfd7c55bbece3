"""Who works on the project at the same time, each in a tab of their own: whose step of the history is whose.

Somebody alone goes back and forth in the history as it is. Where several work at once, undo takes back one's own last
step, by a new step that leaves what the others have done as it is.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from carts_core.errors import CartsError, ProjectError
from carts_core.project import Change, Edits, Figures, Project

LONGEST_NAME = 30
"""Characters of a person's name."""


@dataclass(eq=False)
class Person:
    """Somebody who works in one tab."""

    number: int
    """From 1, in the order in which they came."""
    chosen: str = ""
    """The name that they have chosen; empty if none."""
    present: bool = True
    """Whether their tab is open."""
    index: int = 0
    """Of the frame that they are on."""
    undone: list[int] = field(default_factory=list)
    """Steps by which they took back others, which redo takes back in turn, the newest last."""

    @property
    def name(self) -> str:
        """What others call them."""
        return self.chosen or f"Tab {self.number}"


class People:
    """Everybody who works on a project, and their way into its history. Used on the worker's thread alone.

    Attributes:
        project: the project.
        persons: in the order in which they came.
    """

    def __init__(self, project: Project) -> None:
        self.project = project
        self.persons: list[Person] = []
        self._makers: dict[int, Person] = {}
        """By number of step, as far as it was made since the viewer started."""
        self._reverted: set[int] = set()
        """Steps that were taken back by a later one, and those later ones."""

    def join(self) -> Person:
        """Somebody new."""
        person = Person(max((person.number for person in self.persons), default=0) + 1)
        self.persons.append(person)
        return person

    def leave(self, person: Person) -> None:
        """Forget somebody; their steps are nobody's then."""
        self.persons.remove(person)
        self._makers = {number: maker for number, maker in self._makers.items() if maker is not person}

    @property
    def several(self) -> bool:
        """Whether more than one is at work."""
        return sum(person.present for person in self.persons) > 1

    def apply(
        self, person: Person, name: str, edits: Edits, figures: Mapping[int, Figures] | None = None
    ) -> Change | None:
        """Save a step of somebody's, with their name where they have one or are not alone; errors as `Project.apply`.

        Args:
            person: who.
            name: of the step.
            edits: what changes.
            figures: of frames with these edits.
        """
        person.undone.clear()
        return self._apply(person, name, edits, figures)

    def claim(self, person: Person) -> None:
        """The newest step, which was saved in no other name, is this person's."""
        self._makers[self.project.state.position] = person

    def can_undo(self, person: Person) -> bool:
        """Whether there may be something that this person can take back."""
        return self.project.state.position > 0 and (not self.several or self._own(person) is not None)

    def can_redo(self, person: Person) -> bool:
        """Whether there is something that this person can do again."""
        return bool(person.undone) or self._next_is_free(person)

    def undo(self, person: Person) -> Change | None:
        """Take back somebody's last step; None if there is none, nor any of nobody's.

        Raises:
            CartsError: others are at work, and there are only steps from before.
            ProjectError: it could not be saved, or somebody has changed the same since.
        """
        position, own = self.project.state.position, self._own(person)
        if not self.several and (own is None or own == position):
            return self.project.go_to(max(position - 1, 0))
        if own is None:
            if all(number in self._makers for number in range(1, position + 1)):
                return None
            raise CartsError(
                "No step of this tab is left to undo. While several tabs are open each takes back its own; steps from "
                "before are under History."
            )
        try:
            edits = self.project.reverting(own)
        except ProjectError as error:
            self._reverted.add(own)
            raise CartsError(f"{error} Undo again to go on with your step before it.") from error
        change = self._revert(person, own, "Undo", edits)
        person.undone.append(self.project.state.position)
        return change

    def redo(self, person: Person) -> Change | None:
        """Do again what somebody took back last; None if there is nothing. Errors as `undo`."""
        if person.undone:
            number = person.undone[-1]
            person.undone.pop()
            change = self._revert(person, number, "Redo", self.project.reverting(number))
            # What was done again can be taken back again.
            self._reverted.discard(self.project.state.position)
            return change
        return self.project.go_to(self.project.state.position + 1) if self._next_is_free(person) else None

    def go_to(self, person: Person, position: int) -> Change | None:
        """Go to a place in the history.

        Raises:
            CartsError: that would take back what somebody else at work has done.
            ProjectError: it could not be saved.
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
                f"Between here and there are steps of {', '.join(sorted(set(others)))}, who is at work now. Take back "
                "your own with Undo, or wait until you are alone."
            )
        person.undone.clear()
        return project.go_to(position)

    def _own(self, person: Person) -> int | None:
        """The last step of somebody's that is done and was not taken back; None if there is none."""
        position = self.project.state.position
        own = (n for n, maker in self._makers.items() if maker is person and n <= position and n not in self._reverted)
        return max(own, default=None)

    def _next_is_free(self, person: Person) -> bool:
        """Whether the step that was undone last is nobody else's at work."""
        state = self.project.state
        if state.position == len(state.steps):
            return False
        maker = self._makers.get(state.position + 1)
        return maker is person or not self.several

    def _revert(self, person: Person, number: int, verb: str, edits: Edits) -> Change | None:
        name = self.project.state.steps[number - 1].name
        for known in ("Undo: ", "Redo: ", f"{person.name}: "):
            name = name.replace(known, "")
        change = self._apply(person, f"{verb}: {name}", edits, None)
        self._reverted |= {number, self.project.state.position}
        return change

    def _apply(self, person: Person, name: str, edits: Edits, figures: Mapping[int, Figures] | None) -> Change | None:
        named = f"{person.name}: {name}" if person.chosen or self.several else name
        change = self.project.apply(named, edits, figures)
        if change is not None and change.step is not None:
            number = change.step.number
            if max(self._makers, default=0) >= number:
                # Steps that were undone are gone now.
                self._makers = {known: maker for known, maker in self._makers.items() if known < number}
                self._reverted = {known for known in self._reverted if known < number}
            self._makers[number] = person
        return change
