"""The project: its history, reviews and corrections between frames."""

from dataclasses import dataclass

from carts_core.project import ReviewState
from carts_viewer.intents.base import Intent, Latest


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
    """Accept the shown frame, then show the next one that nobody has judged; within the range, where it lies there."""


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
    camera: str | None = None
    """In whose image; None: the shown one's."""


@dataclass(frozen=True)
class ForgetPins(Annotation):
    """Begin anew with saying where keypoints are; joints stay."""
