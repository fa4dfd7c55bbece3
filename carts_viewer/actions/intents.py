"""Intents: requests of a user or of the page.

Intents of a control that streams values, such as a slider that is being dragged, have a key. A newer intent replaces a
pending one with the same key, so that the queue stays short and the last value is used.
"""

from collections.abc import Hashable
from typing import Any, ClassVar, Literal

from carts_core.export import FormatName, Parts
from carts_core.project import ReviewState
from carts_core.settings import AnnotationFormat, Direction, Masks
from carts_viewer.picture.layers import Layer
from carts_viewer.picture.strokes import Stroke, Target, Tool
from carts_viewer.state import ComparedPose, CompareMode, Reach
from carts_viewer.transport.events import Event


class Intent(Event):
    """A request of a user or of the page."""

    keyed_by: ClassVar[tuple[str, ...] | None] = None
    """Fields that form the key together with the class; None for no key."""

    @property
    def key(self) -> Hashable | None:
        """Key by which a newer intent replaces a pending one; None for intents that are never replaced."""
        if not self.keyed_by:
            return None if self.keyed_by is None else type(self)
        return (type(self), *(getattr(self, name) for name in self.keyed_by))


class Latest(Intent):
    """An intent that replaces all pending intents of its class."""

    keyed_by = ()


class Refresh(Latest):
    """Update all widgets."""


class Drawn(Latest):
    """Report that a tab has drawn a picture, so that the worker may send the next one."""

    picture: int
    """Number of the picture."""


class Released(Latest):
    """Report that a slider or field was released; the next edit starts a new undo step."""


class SetName(Latest):
    """Set the user's name in the history; empty for none."""

    name: str


class SetKeys(Latest):
    """Set the keys that the user has changed (`carts_viewer.actions.shortcuts`)."""

    keys: dict[str, str]
    """Name of an action -> its key."""


class DismissError(Latest):
    """Remove the error message from the page."""


class ShowFrame(Latest):
    """Show the frame of this index (0-based)."""

    index: int


class MoveFrame(Intent):
    """Show the frame that is `by` frames after the shown frame."""

    by: int


class Play(Intent):
    """Start or stop playback; None toggles it."""

    on: bool | None = None


class SetSpeed(Latest):
    """Set the playback speed [frames/s]."""

    fps: float


class SetTimeOffset(Latest):
    """Set the time offset: time in the kinematics table minus time of the image [s]."""

    seconds: float


class ShowDomain(Latest):
    """Show the images of this domain; joints do not change."""

    domain: str


class ShowCamera(Latest):
    """Show this camera; joints do not change."""

    camera: str


class ShowBeside(Intent):
    """Show or hide the images of the other cameras; None toggles them."""

    on: bool | None = None


class SetReach(Latest):
    """Set the range of the joint sliders around the measured values."""

    reach: Reach


class SetRange(Latest):
    """Set the first and last frame of the range (0-based); None for the whole sequence."""

    frames: tuple[int, int] | None


class MarkRange(Intent):
    """Set the start or the end of the range to the shown frame."""

    end: bool = False


class CompareWith(Latest):
    """Choose the comparison in the picture; the poses are those of a swipe."""

    mode: CompareMode | None
    """None for no comparison."""
    left: ComparedPose = ComparedPose.MEASURED
    right: ComparedPose = ComparedPose.CURRENT


class SetSwipe(Latest):
    """Set the share of the picture's width that shows the left side of a comparison, 0..1."""

    share: float


class Peek(Intent):
    """Start or stop showing the compared pose in the whole image."""

    on: bool


class ShowLayer(Latest):
    """Choose the layer that is drawn over the frame."""

    layer: Layer


class SetOpacity(Latest):
    """Set the opacity of the layer, 0..1."""

    opacity: float


class SetJoint(Intent):
    """Set one joint [rad or m]."""

    keyed_by = ("arm", "joint")
    arm: str
    joint: int
    value: float


class BackToMeasured(Intent):
    """Reset this frame's joints of one arm, or of all arms, to the measured values."""

    arm: str | None = None


class Perturb(Intent):
    """Offset every measured joint by `degrees` [deg] or as many millimetres; `seed` determines the random signs."""

    degrees: float
    seed: int


class Nudge(Intent):
    """Move the chosen joint by a small step."""

    by: float
    """Step [deg or mm]."""


class DragLink(Intent):
    """Drag the link that was under the pointer when the gesture began."""

    keyed_by = ("gesture",)
    gesture: float
    """Identifier of the gesture; constant while the pointer is down."""
    camera: str
    start: tuple[float, float]
    """Start of the drag [px]."""
    end: tuple[float, float]
    """Current position of the pointer [px]."""


class ChooseJoint(Intent):
    """Choose the joint that `Nudge` moves; None for the next joint."""

    joint: tuple[str, int] | None = None
    """Arm and index of the joint."""


class Optimizing(Intent):
    """An intent about the optimizer of the shown frame."""


class Run(Optimizing):
    """Start or resume the optimizer."""


class Pause(Optimizing):
    """Pause the optimizer after the current iteration."""


class RunOrPause(Optimizing):
    """Run or pause the optimizer."""


class Step(Optimizing):
    """Perform one iteration."""


class Reset(Optimizing):
    """Reset the frame to the start of the run."""


class Assess(Optimizing):
    """Assess the fit of the shown pose, without moving it."""


class SetSetting(Optimizing):
    """Change one field of the optimizer's settings."""

    keyed_by = ("name",)
    name: str
    value: Any


class ResetSettings(Optimizing):
    """Set all settings of the chosen solver to those of a preset."""

    preset: str
    """One of `state.PRESETS`."""


class SetFreeJoint(Optimizing):
    """Set whether the optimizer may move one joint."""

    keyed_by = ("arm", "joint")
    arm: str
    joint: str
    on: bool


class SetFreeGroup(Optimizing):
    """Set whether the optimizer may move base frames, extrinsics or intrinsics (`group`)."""

    keyed_by = ("group",)
    group: str
    on: bool


class SetCameras(Optimizing, Latest):
    """Set whether runs use all cameras or only the shown camera."""

    every: bool


class SetObserved(Optimizing, Latest):
    """Set the target of runs: predictions of the network, masks or both."""

    what: str
    """One of `jobs.choices.Observe`."""
    masks: str
    """One of `state.Masks`."""


class SetTool(Latest):
    """Select a tool."""

    tool: Tool


class ToggleTool(Intent):
    """Select a tool; deselect it if it is selected."""

    tool: Tool


class ShowLoupe(Intent):
    """Show or hide the loupe; None toggles it."""

    on: bool | None = None


class SetTarget(Latest):
    """Choose the painted layer; None toggles it.

    If the ignore region is chosen and the selected tool does not paint, the brush is selected as well.
    """

    target: Target | None = None


class SetPaintClass(Latest):
    """Choose the class that is painted on the mask (`carts_core.model.parts.PartClass`); 0 for any arm."""

    number: int


class SetDiameter(Latest):
    """Set the diameter of the brush [px]."""

    diameter: float


class ScaleBrush(Intent):
    """Scale the diameter of the brush by a factor; it changes by at least one pixel."""

    factor: float


class Paint(Intent):
    """Apply a finished stroke."""

    client_id: int
    stroke: Stroke


class NextObject(Intent):
    """Let the next prompt start a new object."""


class ClearLayer(Intent):
    """Clear a painted layer of the shown frame and camera; None for the chosen layer."""

    target: Target | None = None


class Undo(Intent):
    """Undo the last step, in any frame."""


class Redo(Intent):
    """Redo the last undone step."""


class GoToStep(Intent):
    """Undo or redo until this number of steps is in effect."""

    position: int


class SetReview(Intent):
    """Set the review state of the shown frame."""

    state: ReviewState


class SetNote(Latest):
    """Set the note of the shown frame."""

    note: str


class AcceptAndNext(Intent):
    """Accept the shown frame, then show the next unreviewed frame, within the range if the shown frame lies in it."""


class ShowUnreviewed(Intent):
    """Show the next frame without a review."""

    step: int = 1
    """1 forwards, -1 backwards."""


class ShowWorst(Intent):
    """Show the next frame in order of fit quality, among those neither accepted nor rejected."""

    step: int = 1
    """1 for the next better frame, -1 for the next worse."""


class CopyCorrection(Intent):
    """Copy the correction of the previous (-1) or next (1) frame to the shown frame."""

    step: int


class ShowKeypoints(Intent):
    """Show or hide the keypoints; None toggles them."""

    on: bool | None = None


class ChooseKeypoint(Intent):
    """Choose the keypoint that `PointAt` places."""

    label: str | None
    """Label of the keypoint; None for the keypoint nearest to the pointer."""


class PointAt(Latest):
    """Place the chosen keypoint in an image; repeated during a drag, and followed by `Released`."""

    u: float
    """Column [px]."""
    v: float
    """Row [px]."""
    camera: str | None = None
    """Camera of the image; None for the shown one."""


class RemovePins(Intent):
    """Remove the placed keypoints; the pose is kept."""


class SequenceIntent(Intent):
    """An intent about sequence mode."""


class SetKeyframe(Intent):
    """Mark or unmark the shown frame as a keyframe; None toggles it."""

    on: bool | None = None


class Solve(SequenceIntent):
    """Solve many frames together; kept frames (keyframes, accepted frames) do not change."""

    whole: bool = False
    """Whether to solve all frames instead of those between the kept frames around the shown one."""


class StopSolving(SequenceIntent):
    """Stop solving, and save the solved frames."""


class SetDirection(Intent):
    """Set the direction in which frames are solved."""

    direction: Direction


class TakeSolved(SequenceIntent):
    """Apply the solved pose of a frame that fits worse than before; None for all listed frames."""

    index: int | None = None


class DiscardSolved(SequenceIntent):
    """Discard the solved poses of all listed frames."""


Frames = Literal["found", "unreviewed", "range", "all"]


class Jobs(Intent):
    """An intent about jobs."""


class OptimizeFrames(Jobs):
    """Run the optimizer on many frames individually, each from its current pose."""

    frames: Frames = "unreviewed"
    """Frames that match the filter, frames without a review, frames in the range, or all frames."""


class Calibrate(Jobs):
    """Fit the free calibration parameters, by default the base frames, jointly to several frames of the sequence."""

    frames: int = 20
    """Number of frames, spread evenly."""


class Adapt(Jobs):
    """Adapt the network to the recording."""

    minutes: int = 15
    """Processor time limit [min]."""


class UseNetwork(Jobs):
    """Use another network in all tabs."""

    name: str
    """One of `ViewState.networks`."""


class AnswerNetwork(Jobs):
    """Accept or refuse weights that need confirmation (`ViewState.asked_network`)."""

    accepted: bool


class AnswerJobs(Jobs):
    """Run or discard all jobs that need confirmation (`JobState.ASKED`)."""

    accepted: bool


class CancelJob(Jobs):
    """Stop a job, or remove it from the queue."""

    number: int


class RepeatJob(Jobs):
    """Queue a job again; a job on many frames resumes where it stopped."""

    number: int


class RemoveEndedJobs(Jobs):
    """Remove ended jobs from the list."""


class Exporting(Intent):
    """An intent about exports."""


class ExportMask(Intent):
    """Send the mask of the shown frame as a PNG file to the requesting tab."""

    client_id: int


class Export(Exporting):
    """Export frames to a new folder or file beside the project."""

    format: FormatName
    frames: str
    """Frames to write, one of `import_export.FRAME_CHOICES`."""
    parts: Parts = "arms"
    """Granularity of the categories."""
    images: bool = False
    """Whether to copy images; otherwise labels refer to the recording's images, if the format allows it."""
    shown_camera: bool = False
    """Whether to export only the shown camera."""
    range: tuple[int, int] | None = None
    """First and last frame of the range to which the export is limited; None for the whole sequence."""
    masks: Masks = "auto"
    """Which masks are refined, if the format allows it."""


class CancelExport(Exporting):
    """Cancel the running export; its files are removed."""


class Download(Intent):
    """Send the last export to the requesting tab."""

    client_id: int


class ImportMasks(Intent):
    """Import masks and keypoints from a file or folder into the project, as one undo step."""

    path: str
    """Path of the file or folder, relative to the sequence's folder, or absolute in an allowed folder."""
    camera: str | None = None
    """Camera of the masks; None to infer it from the file names."""
    format: AnnotationFormat | None = None
    """Format of the source; None to recognize it by content."""
    replace: bool = False
    """Whether previously imported layers may be replaced."""


class CancelImport(Intent):
    """Cancel the running import; the project is unchanged."""


class SetFilter(Intent):
    """Set one condition of the frame filter, named as in `FrameFilter`."""

    keyed_by = ("name",)
    name: str
    value: Any


class ShowMatching(Intent):
    """Show the next frame that matches the filter."""

    step: int = 1
    """1 forwards, -1 backwards."""


class ReviewMatching(Intent):
    """Set the review state of all frames that match the filter, as one undo step; notes are kept."""

    state: ReviewState


class ReviewFrames(Intent):
    """Set the review state of these frames, as one undo step; notes are kept."""

    frames: list[int]
    """Indices of frames; invalid indices are ignored."""
    state: ReviewState


class ClearFilter(Intent):
    """Clear all conditions of the filter."""


class StartLive(Intent):
    """Show a live stream with tracked arms."""

    source: str
    """As in `carts live --source`: `replay`, `socket:PORT` or `camera:NUMBER`."""
    joints_port: int | None = None
    """With a camera: port on 127.0.0.1 that receives joint positions."""
    repeat: bool = False
    """Whether a replay is repeated endlessly."""
    rate: float | None = None
    """Frame rate of a replay [frames/s]; None for that of the recording."""
    record: bool = False
    """Whether frames and corrections are recorded."""


class StopLive(Intent):
    """Show the recording again."""
