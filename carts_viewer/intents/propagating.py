"""Keyframes, and solving the frames between them."""

from dataclasses import dataclass

from carts_core.settings import Direction
from carts_viewer.intents.base import Intent


@dataclass(frozen=True)
class Propagating(Intent):
    """An intent about keyframes and what follows from them."""


@dataclass(frozen=True)
class Marking(Intent):
    """An intent about how the shown frame takes part in solving many, and how that begins."""


@dataclass(frozen=True)
class HoldKeyframe(Marking):
    """Make the shown frame a keyframe, or none; None changes over."""

    on: bool | None = None


@dataclass(frozen=True)
class Solve(Propagating):
    """Solve many frames together; those that are kept (keyframes, accepted frames) stay as they are."""

    whole: bool = False
    """All frames of the sequence, not only those between the kept frames around the shown one."""


@dataclass(frozen=True)
class StopSolving(Propagating):
    """Stop, and keep the frames that are solved."""


@dataclass(frozen=True)
class SetDirection(Marking):
    """Choose where solving begins: at the first frame, or at the last one."""

    direction: Direction


@dataclass(frozen=True)
class TakeSolved(Propagating):
    """Take what was solved of a frame that was kept as it was, because it fits worse; None: of all of them."""

    index: int | None = None


@dataclass(frozen=True)
class DropSolved(Propagating):
    """Leave the listed frames as they are, and forget the list."""
