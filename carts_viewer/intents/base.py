"""What every intent is, and the few that are about no part in particular."""

from collections.abc import Hashable
from dataclasses import dataclass


@dataclass(frozen=True)
class Intent:
    """One thing that a person, or the page, asks for."""

    @property
    def key(self) -> Hashable | None:
        """Intents of the same key replace one another while they wait; None is never replaced."""
        return None


@dataclass(frozen=True)
class Latest(Intent):
    """An intent of which only the newest matters."""

    @property
    def key(self) -> Hashable:
        """The intent's own type."""
        return type(self)


@dataclass(frozen=True)
class Refresh(Latest):
    """Bring all widgets up to date."""


@dataclass(frozen=True)
class Drawn(Latest):
    """A tab has drawn the newest overlay; wakes the worker, which may send the next."""


@dataclass(frozen=True)
class Released(Latest):
    """The slider or field was let go of; what comes next is another step of undo."""


@dataclass(frozen=True)
class SetName(Latest):
    """Choose the name that stands in the history; empty for none."""

    name: str


@dataclass(frozen=True)
class DismissError(Latest):
    """Take the error message off the page."""
