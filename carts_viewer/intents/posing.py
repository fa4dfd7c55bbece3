"""Moving the arms of the shown frame by hand."""

from collections.abc import Hashable
from dataclasses import dataclass

from carts_viewer.intents.base import Intent


@dataclass(frozen=True)
class Posing(Intent):
    """An intent that moves the arms of the shown frame by hand."""


@dataclass(frozen=True)
class SetJoint(Posing):
    """Put one joint to a value [rad or m]."""

    arm: str
    joint: int
    value: float

    @property
    def key(self) -> Hashable:
        """One slot per joint, so that two joints moved at once both arrive."""
        return (SetJoint, self.arm, self.joint)


@dataclass(frozen=True)
class BackToMeasured(Posing):
    """Forget this frame's corrections of one arm, or of all of them."""

    arm: str | None = None


@dataclass(frozen=True)
class Perturb(Posing):
    """Move every joint by this many degrees or millimetres, with random signs from the seed."""

    degrees: float
    seed: int


@dataclass(frozen=True)
class Nudge(Posing):
    """Move the chosen joint a little, either way."""

    by: float
    """[deg or mm]"""


@dataclass(frozen=True)
class DragLink(Posing):
    """Drag the link that was under the pointer when the gesture began."""

    gesture: float
    """The same as long as the pointer is down."""
    camera: str
    start: tuple[float, float]
    """Where the pointer took hold of the link [px]."""
    end: tuple[float, float]
    """Where the pointer is now [px]."""

    @property
    def key(self) -> Hashable:
        """Of one gesture only the newest place matters."""
        return (DragLink, self.gesture)


@dataclass(frozen=True)
class ChooseJoint(Posing):
    """Choose the joint that `Nudge` moves; None for the next one."""

    joint: tuple[str, int] | None = None
    """Arm, and index of its joint."""
