"""Intents: what a user, or the page, asks for.

A control that streams values, such as a slider that is being dragged, gives its intents a key: a newer intent
replaces a waiting one of the same key, so that work never piles up and the last value counts.
"""

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, Literal

from carts_core.export import FormatName, Parts
from carts_core.project import ReviewState
from carts_core.settings import Direction
from carts_viewer.choices import Against, Reach
from carts_viewer.picture.layers import Layer
from carts_viewer.picture.strokes import Stroke, Target, Tool


@dataclass(frozen=True)
class Intent:
    """A request of a user or of the page."""

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
    """A slider or field was released; the next edit is another step of undo."""


@dataclass(frozen=True)
class SetName(Latest):
    """Choose the name that stands in the history; empty for none."""

    name: str


@dataclass(frozen=True)
class DismissError(Latest):
    """Take the error message off the page."""


@dataclass(frozen=True)
class Browsing(Intent):
    """An intent about what is shown: frame, domain, camera, overlay, playing."""


@dataclass(frozen=True)
class ShowFrame(Browsing, Latest):
    """Show the frame of this index (0-based)."""

    index: int


@dataclass(frozen=True)
class MoveFrame(Browsing):
    """Show the frame that is `by` frames further."""

    by: int


@dataclass(frozen=True)
class Play(Browsing):
    """Start or stop playing; None changes over."""

    on: bool | None = None


@dataclass(frozen=True)
class SetSpeed(Browsing, Latest):
    """Frames per second while playing."""

    fps: float


@dataclass(frozen=True)
class SetTimeOffset(Browsing, Latest):
    """Set the time offset: time in the kinematics table minus time of the image [s]."""

    seconds: float


@dataclass(frozen=True)
class ShowDomain(Browsing, Latest):
    """Show the images of this domain; joints stay as they are."""

    domain: str


@dataclass(frozen=True)
class ShowCamera(Browsing, Latest):
    """Look through this camera; joints stay as they are."""

    camera: str


@dataclass(frozen=True)
class ShowBeside(Browsing):
    """Show the other cameras' images beside the active one's, or not; None changes over."""

    on: bool | None = None


@dataclass(frozen=True)
class SetReach(Browsing, Latest):
    """Set the range of the joints' sliders around the measured values."""

    reach: Reach


@dataclass(frozen=True)
class SetRange(Browsing, Latest):
    """Choose the part of the sequence from the first to the last of these frames (0-based); None: all of it."""

    frames: tuple[int, int] | None


@dataclass(frozen=True)
class MarkRange(Browsing):
    """Begin, or end, the chosen part of the sequence at the shown frame."""

    end: bool = False


@dataclass(frozen=True)
class CompareWith(Browsing, Latest):
    """Compare the pose with another one; None: with none."""

    against: Against | None


@dataclass(frozen=True)
class SetSwipe(Browsing, Latest):
    """Show the other pose up to this share of the picture's width, 0..1."""

    share: float


@dataclass(frozen=True)
class Peek(Browsing):
    """Show the other pose all over, or no more."""

    on: bool


@dataclass(frozen=True)
class ShowLayer(Browsing, Latest):
    """Draw this layer over the frame."""

    layer: Layer


@dataclass(frozen=True)
class SetOpacity(Browsing, Latest):
    """Opacity of the layer, 0..1."""

    opacity: float


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
    """Start of the drag [px]."""
    end: tuple[float, float]
    """Present position of the pointer [px]."""

    @property
    def key(self) -> Hashable:
        """One slot per gesture."""
        return (DragLink, self.gesture)


@dataclass(frozen=True)
class ChooseJoint(Posing):
    """Choose the joint that `Nudge` moves; None for the next one."""

    joint: tuple[str, int] | None = None
    """Arm, and index of its joint."""


@dataclass(frozen=True)
class Optimizing(Intent):
    """An intent about the optimizer of the shown frame."""


@dataclass(frozen=True)
class Run(Optimizing):
    """Optimize until it stops, or go on where it was paused."""


@dataclass(frozen=True)
class Pause(Optimizing):
    """Hold the optimizer after the current iteration."""


@dataclass(frozen=True)
class RunOrPause(Optimizing):
    """Run when not running, else pause."""


@dataclass(frozen=True)
class Step(Optimizing):
    """Do one iteration."""


@dataclass(frozen=True)
class Reset(Optimizing):
    """Go back to where the run started."""


@dataclass(frozen=True)
class Assess(Optimizing):
    """Assess the fit of the shown pose, without moving it."""


@dataclass(frozen=True)
class SetSetting(Optimizing):
    """Change one field of the optimizer's settings."""

    name: str
    value: Any

    @property
    def key(self) -> Hashable:
        """One slot per field."""
        return (SetSetting, self.name)


@dataclass(frozen=True)
class ResetSettings(Optimizing):
    """Set all settings of the chosen solver to those of a preset."""

    preset: str
    """One of `choices.PRESETS`."""


@dataclass(frozen=True)
class SetFreeJoint(Optimizing):
    """Let the optimizer move one joint, or not."""

    arm: str
    joint: str
    on: bool

    @property
    def key(self) -> Hashable:
        """One slot per joint."""
        return (SetFreeJoint, self.arm, self.joint)


@dataclass(frozen=True)
class SetFreeGroup(Optimizing):
    """Let the optimizer move base frames, extrinsics or intrinsics (`group`), or not."""

    group: str
    on: bool

    @property
    def key(self) -> Hashable:
        """One slot per group."""
        return (SetFreeGroup, self.group)


@dataclass(frozen=True)
class SetCameras(Optimizing, Latest):
    """Optimize in all cameras, or in the shown one."""

    every: bool


@dataclass(frozen=True)
class SetObserved(Optimizing, Latest):
    """Have runs fit predictions of the network, masks or both."""

    what: str
    """One of `choices.Observe`."""
    masks: str
    """One of `choices.Masks`."""


@dataclass(frozen=True)
class Painting(Intent):
    """An intent about painted layers and the tools for them."""


@dataclass(frozen=True)
class SetTool(Painting, Latest):
    """Take a tool."""

    tool: Tool


@dataclass(frozen=True)
class ToggleTool(Painting):
    """Take a tool or, if it is in hand, put it away."""

    tool: Tool


@dataclass(frozen=True)
class SetTarget(Painting, Latest):
    """Paint on this layer; None changes over."""

    target: Target | None = None


@dataclass(frozen=True)
class SetPaintClass(Painting, Latest):
    """Paint this class on the mask (`carts_core.model.parts.PartClass`); 0: any arm."""

    number: int


@dataclass(frozen=True)
class SetDiameter(Painting, Latest):
    """Make the brush this thick [px]."""

    diameter: float


@dataclass(frozen=True)
class ScaleBrush(Painting):
    """Make the brush thicker or thinner by a factor, by a pixel at least."""

    factor: float


@dataclass(frozen=True)
class Paint(Painting):
    """Apply a finished stroke."""

    client_id: int
    stroke: Stroke


@dataclass(frozen=True)
class NextObject(Painting):
    """The next click with the prompt is about something else."""


@dataclass(frozen=True)
class ClearLayer(Painting):
    """Remove what was painted on a layer of the shown frame and camera; None: the layer that is painted on."""

    target: Target | None = None


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
    """Set the review state of the shown frame."""

    state: ReviewState


@dataclass(frozen=True)
class SetNote(Annotation, Latest):
    """Write a note about the shown frame."""

    note: str


@dataclass(frozen=True)
class AcceptAndNext(Annotation):
    """Accept the shown frame, then show the next one without a review; within the range, where it lies there."""


@dataclass(frozen=True)
class ShowUnreviewed(Annotation):
    """Show the next frame without a review."""

    step: int = 1
    """1 forwards, -1 backwards."""


@dataclass(frozen=True)
class ShowWorse(Annotation):
    """Show the next worst frame that is neither accepted nor rejected."""

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
    """Remove the placed keypoints; joints stay."""


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


Frames = Literal["found", "unreviewed", "range", "all"]


@dataclass(frozen=True)
class Jobs(Intent):
    """An intent about jobs."""


@dataclass(frozen=True)
class OptimizeFrames(Jobs):
    """Run the optimizer on many frames, each alone, from where it is."""

    frames: Frames = "unreviewed"
    """Those that the filter finds, those without a review, those in the chosen range, or all."""


@dataclass(frozen=True)
class Calibrate(Jobs):
    """Fit base frames, and cameras where they are free, to some frames of the sequence together."""

    frames: int = 20
    """Number of frames, spread evenly."""


@dataclass(frozen=True)
class Adapt(Jobs):
    """Adapt the network to the recording."""

    minutes: int = 15
    """At most."""


@dataclass(frozen=True)
class UseNetwork(Jobs):
    """Use another network in all tabs."""

    name: str
    """One of `ViewState.networks`."""


@dataclass(frozen=True)
class AnswerNetwork(Jobs):
    """Accept or refuse the weights that are asked for (`ViewState.asked_network`)."""

    accepted: bool


@dataclass(frozen=True)
class AnswerJobs(Jobs):
    """Run or discard all jobs that are asked for (`JobState.ASKED`)."""

    accepted: bool


@dataclass(frozen=True)
class CancelJob(Jobs):
    """Stop a job, or take it out of the queue."""

    number: int


@dataclass(frozen=True)
class RepeatJob(Jobs):
    """Queue a job once more; one on many frames goes on where it was stopped."""

    number: int


@dataclass(frozen=True)
class ForgetJobs(Jobs):
    """Take all jobs that have ended off the list."""


@dataclass(frozen=True)
class Exporting(Intent):
    """An intent about files to take away."""


@dataclass(frozen=True)
class ExportMask(Intent):
    """Send this frame's mask, as a PNG, to the tab that asked."""

    client_id: int


@dataclass(frozen=True)
class Export(Exporting):
    """Write frames in a format into a new folder or file beside the project."""

    format: FormatName
    frames: str
    """Which ones, one of `exchange.FRAME_CHOICES`."""
    parts: Parts = "arms"
    """Granularity of the categories."""
    images: bool = False
    """Copy the images beside their labels; otherwise labels name those of the recording, where the format allows it."""
    shown_camera: bool = False
    """Only the camera that is shown, not all."""
    range: tuple[int, int] | None = None
    """First and last frame, both exported; None for the whole sequence."""


@dataclass(frozen=True)
class CancelExport(Exporting):
    """Stop the export that is going on; nothing of it is left."""


@dataclass(frozen=True)
class Download(Exporting):
    """Send what was exported last to the tab that asked."""

    client_id: int


@dataclass(frozen=True)
class ImportMasks(Intent):
    """Import masks and keypoints of a file or folder into the project, as one step of undo."""

    place: str
    """Path of the file or folder; relative to the sequence's folder, or absolute in an allowed one."""
    camera: str | None = None
    """Whose images they are; None: as the names of files say."""
    replace: bool = False
    """Whether layers that were imported before may be replaced."""


@dataclass(frozen=True)
class Finding(Intent):
    """An intent about the frame filter."""


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
    """Set the review state of all frames found, as one step of undo; notes stay."""

    state: ReviewState


@dataclass(frozen=True)
class ClearFilter(Finding):
    """Look for all frames again."""


@dataclass(frozen=True)
class Live(Intent):
    """An intent about live streams."""


@dataclass(frozen=True)
class StartLive(Live):
    """Show a stream, with the arms followed through it."""

    source: str
    """As `carts live --source`: `replay`, `socket:PORT` or `camera:NUMBER`."""
    joints_port: int | None = None
    """With a camera: port of 127.0.0.1 where joints come from."""
    repeat: bool = False
    """Whether a replay begins again when it ends."""
    rate: float | None = None
    """Frames per second of a replay; those of the recording's times if None."""
    record: bool = False
    """Whether what is seen is kept as a recording with its corrections."""


@dataclass(frozen=True)
class StopLive(Live):
    """Show the recording again."""
