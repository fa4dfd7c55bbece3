"""What a person can ask for.

A control that streams values (a slider that is being dragged) gives its intents a key: a newer one replaces the older
one that nobody has looked at yet, so work never piles up and the last value is always the one that counts.
"""

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

from carts_viewer.layers import Layer


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
class ShowFrame(Latest):
    """Show the frame of this index (0-based)."""

    index: int


@dataclass(frozen=True)
class MoveFrame(Intent):
    """Show the frame that is `by` frames further."""

    by: int


@dataclass(frozen=True)
class Play(Intent):
    """Start or stop playing; None changes over."""

    on: bool | None = None


@dataclass(frozen=True)
class SetSpeed(Latest):
    """Frames per second while playing."""

    fps: float


@dataclass(frozen=True)
class ShowDomain(Latest):
    """Show the images of this domain; joints stay as they are."""

    domain: str


@dataclass(frozen=True)
class ShowCamera(Latest):
    """Look through this camera; joints stay as they are."""

    camera: str


@dataclass(frozen=True)
class ShowLayer(Latest):
    """Draw this layer over the frame."""

    layer: Layer


@dataclass(frozen=True)
class SetOpacity(Latest):
    """Opacity of the layer, 0..1."""

    opacity: float


@dataclass(frozen=True)
class SetJoint(Intent):
    """Put one joint to a value [rad or m]."""

    arm: str
    joint: int
    value: float

    @property
    def key(self) -> Hashable:
        """One slot per joint, so that two joints moved at once both arrive."""
        return (SetJoint, self.arm, self.joint)


@dataclass(frozen=True)
class Released(Latest):
    """The slider or field was let go of; what comes next is another step of undo."""


@dataclass(frozen=True)
class BackToMeasured(Intent):
    """Forget this frame's corrections of one arm, or of all of them."""

    arm: str | None = None


@dataclass(frozen=True)
class Perturb(Intent):
    """Move every joint by this many degrees or millimetres, with random signs from the seed."""

    degrees: float
    seed: int


@dataclass(frozen=True)
class Undo(Intent):
    """Take back the last change of the pose."""


@dataclass(frozen=True)
class Run(Intent):
    """Optimize until it stops, or go on where it was paused."""


@dataclass(frozen=True)
class Pause(Intent):
    """Hold the optimizer after the current iteration."""


@dataclass(frozen=True)
class RunOrPause(Intent):
    """Run when not running, else pause."""


@dataclass(frozen=True)
class Step(Intent):
    """Do one iteration."""


@dataclass(frozen=True)
class Reset(Intent):
    """Go back to where the run started."""


@dataclass(frozen=True)
class SetSetting(Intent):
    """Change one field of the optimizer's settings."""

    name: str
    value: Any

    @property
    def key(self) -> Hashable:
        """One slot per field."""
        return (SetSetting, self.name)


@dataclass(frozen=True)
class SetFreeJoint(Intent):
    """Let the optimizer move one joint, or not."""

    arm: str
    joint: str
    on: bool

    @property
    def key(self) -> Hashable:
        """One slot per joint."""
        return (SetFreeJoint, self.arm, self.joint)


@dataclass(frozen=True)
class SetFreeGroup(Intent):
    """Let the optimizer move base frames, extrinsics or intrinsics (`group`), or not."""

    group: str
    on: bool

    @property
    def key(self) -> Hashable:
        """One slot per group."""
        return (SetFreeGroup, self.group)


@dataclass(frozen=True)
class SetCameras(Latest):
    """Optimize in all cameras, or in the shown one."""

    every: bool


@dataclass(frozen=True)
class ExportMask(Intent):
    """Send this frame's mask, as a PNG, to the tab that asked."""

    client_id: int


@dataclass(frozen=True)
class ExportAll(Intent):
    """Send all masks and the kinematics, as a zip, to the tab that asked."""

    client_id: int


@dataclass(frozen=True)
class CancelExport(Intent):
    """Stop the export that is going on."""


@dataclass(frozen=True)
class DismissError(Latest):
    """Take the error message off the page."""


@dataclass(frozen=True)
class Refresh(Latest):
    """Bring all widgets up to date."""


@dataclass(frozen=True)
class Drawn(Latest):
    """A tab has drawn the newest overlay; wakes the worker, which may send the next."""
