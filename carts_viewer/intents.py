"""What a person can ask for.

A control that streams values (a slider that is being dragged) gives its intents a key: a newer one replaces the older
one that nobody has looked at yet, so work never piles up and the last value is always the one that counts.
"""

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

from carts_core.project import ReviewState
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
class Nudge(Intent):
    """Move the chosen joint a little, either way."""

    by: float
    """[deg or mm]"""


@dataclass(frozen=True)
class ChooseJoint(Intent):
    """Choose the joint that `Nudge` moves; None for the next one."""

    joint: tuple[str, int] | None = None
    """Arm, and index of its joint."""


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


@dataclass(frozen=True)
class Annotation(Intent):
    """An intent about the project: its history, reviews and corrections between frames."""


@dataclass(frozen=True)
class Undo(Annotation):
    """Take back the last step, in whichever frame it was."""


@dataclass(frozen=True)
class Redo(Annotation):
    """Do the step again that was taken back last."""


@dataclass(frozen=True)
class GoToStep(Annotation):
    """Undo or redo until so many steps are done."""

    position: int


@dataclass(frozen=True)
class SetReview(Annotation):
    """Say what the shown frame is like."""

    state: ReviewState


@dataclass(frozen=True)
class SetNote(Annotation, Latest):
    """Write a note about the shown frame."""

    note: str


@dataclass(frozen=True)
class AcceptAndNext(Annotation):
    """Accept the shown frame, then show the next one that nobody has judged."""


@dataclass(frozen=True)
class ShowUnreviewed(Annotation):
    """Show the next frame that nobody has judged."""

    step: int = 1
    """1 forwards, -1 backwards."""


@dataclass(frozen=True)
class ShowWorse(Annotation):
    """Of the frames that are neither accepted nor rejected, show the one that comes next in order of badness."""

    step: int = 1
    """1 to the next one, which is less bad; -1 to one that is worse."""


@dataclass(frozen=True)
class CopyCorrection(Annotation):
    """Correct the shown frame by as much as the previous (-1) or the next one (1) is."""

    step: int


@dataclass(frozen=True)
class ShowKeypoints(Annotation):
    """Mark the keypoints in the picture, or not; None changes over."""

    on: bool | None = None


@dataclass(frozen=True)
class ChooseKeypoint(Annotation):
    """Choose the keypoint that `PointAt` moves."""

    label: str | None
    """None: whichever is nearest to where the picture is pressed."""


@dataclass(frozen=True)
class PointAt(Annotation, Latest):
    """The chosen keypoint is there in the shown camera's image; many of these in a drag, then `Released`."""

    u: float
    """Column [px]."""
    v: float
    """Row [px]."""


@dataclass(frozen=True)
class ForgetPins(Annotation):
    """Begin anew with saying where keypoints are; joints stay."""
