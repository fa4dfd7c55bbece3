"""Looking for frames, and saying something about all that were found."""

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

from carts_core.project import ReviewState
from carts_viewer.intents.base import Intent


@dataclass(frozen=True)
class Finding(Intent):
    """An intent about the frames that somebody looks for."""


@dataclass(frozen=True)
class SetFilter(Finding):
    """Change one condition; `FrameFilter` has their names."""

    name: str
    value: Any

    @property
    def key(self) -> Hashable:
        """One slot per condition."""
        return (SetFilter, self.name)


@dataclass(frozen=True)
class ShowFound(Finding):
    """Show the next frame that was found, or with -1 the one before."""

    step: int = 1


@dataclass(frozen=True)
class ReviewFound(Finding):
    """Say the same about all frames that were found, as one step of undo; notes stay."""

    state: ReviewState


@dataclass(frozen=True)
class ClearFilter(Finding):
    """Look for all frames again."""
