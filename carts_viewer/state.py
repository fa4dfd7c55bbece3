"""Immutable state of a tab, with the choices of its user; replaced by the worker and read by panels."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from carts_core.model.keypoints import Pin
from carts_core.model.scene import Arm, SceneState
from carts_core.optimization import FreeParameters, GivenMasks, Iterate, SolverSettings
from carts_core.project import FitVerdict, IgnoreRegion, Key, MaskCorrection, PartLabels, ProjectState, Review, Source
from carts_core.project.masks import project_masks
from carts_core.project.values import WHOLE_PROJECT
from carts_core.recording import Frame
from carts_core.recording import Sequence as Recording
from carts_core.settings import Direction, SolverName, SurfaceSolver
from carts_core.settings.stages import reduced

from .actions.frame_filter import FrameFilter
from .jobs.choices import Choices, Observed
from .jobs.job_list import Job
from .picture.layers import Layer
from .picture.strokes import Brush


class ComparedPose(StrEnum):
    """Pose of a comparison; the value is the label in the page."""

    MEASURED = "Measured"
    BEFORE_RUN = "Before the run"
    CURRENT = "Current"
    ACCEPTED = "Accepted"


class CompareMode(StrEnum):
    """Kind of a comparison; the value is the label in the page."""

    OUTLINES = "Outlines"
    SWIPE = "Swipe"
    PAINTED = "Painted mask"


@dataclass(frozen=True)
class Compare:
    """The comparison in the picture, and the share of the picture that shows its left side."""

    mode: CompareMode | None = None
    """None for no comparison, except while the key is pressed."""
    left: ComparedPose = ComparedPose.MEASURED
    right: ComparedPose = ComparedPose.CURRENT
    swipe: float = 0.5
    """Share of the picture's width, from the left, that shows the left side, 0..1."""
    peek: bool = False
    """Whether the key is pressed, so that the whole picture shows the left side."""

    @property
    def share(self) -> float:
        """Share of the picture's width that shows the left side, 0..1."""
        return 1.0 if self.peek else self.swipe if self.mode in (CompareMode.SWIPE, CompareMode.PAINTED) else 0.0


class Reach(StrEnum):
    """Range of the sliders around the measured values; the value is the label in the page."""

    NEAR = "± 5"
    FAR = "± 20"
    FULL = "Full range"

    @property
    def width(self) -> float:
        """Half width [deg] or [mm]."""
        return {Reach.NEAR: 5.0, Reach.FAR: 20.0, Reach.FULL: math.inf}[self]


@dataclass(frozen=True)
class JointRange:
    """Allowed range of a joint."""

    arm: str
    joint: str
    revolute: bool
    lower: float
    """Lower limit [rad or m]; without limits, the range is half a revolution or one metre to either side of zero."""
    upper: float

    @property
    def unit(self) -> str:
        """Unit in the page, ° or mm."""
        return "°" if self.revolute else "mm"

    def to_shown(self, value: float) -> float:
        """A joint position [rad, m] in the unit of the page [deg, mm]."""
        return math.degrees(value) if self.revolute else 1e3 * value

    def from_shown(self, shown: float) -> float:
        """A joint position [rad, m] from a value in the unit of the page [deg, mm]."""
        return math.radians(shown) if self.revolute else shown / 1e3


def joint_range(arm: Arm, joint: int) -> JointRange:
    """Range of the joint with this index."""
    lower, upper = (float(value) for value in arm.robot.joint_limits[joint])
    revolute = arm.robot.joint_types[joint] == "revolute"
    # A slider needs limits; the default is half a revolution or one metre to either side of zero.
    room = math.pi if revolute else 1.0
    return JointRange(
        arm.name,
        arm.robot.joint_names[joint],
        revolute,
        lower if math.isfinite(lower) else -room,
        upper if math.isfinite(upper) else room,
    )


@dataclass(frozen=True, eq=False)
class Target:
    """Target of a run: network predictions or masks. Masks of the project are those at the start of the run."""

    observed: Observed = field(default_factory=Observed)
    project: ProjectState | None = None
    """Project with the masks, if they are not those of the recording."""
    recording: Recording | None = None

    @staticmethod
    def of(observed: Observed, project: ProjectState, recording: Recording) -> "Target":
        """The chosen target, with the current masks of a project."""
        if observed.what == "network" or observed.masks == "recording":
            return Target(observed)
        return Target(observed, project, recording)

    def __reduce__(self) -> tuple[Any, ...]:
        return Target, (self.observed, self.project, self.recording)

    @cached_property
    def given(self) -> GivenMasks | None:
        """Imported or painted masks of the target; None without such masks."""
        if self.observed.masks == "recording" or self.project is None or self.recording is None:
            return None
        return project_masks(self.observed.masks, self.project, self.recording)

    def of_frame(self, index: int) -> "Target":
        """The target of one frame, with the values of this frame only."""
        if self.project is None:
            return self
        records = {place: self.project.records.get(place) for place in (index, WHOLE_PROJECT)}
        known = {place: record for place, record in records.items() if record is not None}
        return replace(self, project=replace(self.project, records=known, steps=(), exports=()))

    def ignored(
        self, regions: Mapping[str, IgnoreRegion], index: int, cameras: Sequence[str]
    ) -> dict[str, Bool[np.ndarray, "height width"]]:
        """Camera -> pixels of a frame that a fit ignores: ignore regions, and unlabelled pixels of given masks."""
        found = {name: region.region() for name, region in regions.items() if name in cameras}
        of_masks = {} if self.given is None else self.given.ignored(index)
        return {**found, **{name: mask | found.get(name, False) for name, mask in of_masks.items() if name in cameras}}

    def seen(self, recording: Recording, index: int, domain: str, cameras: Sequence[str]) -> list[str]:
        """Cameras with an image that can be compared in a frame; if only masks are fitted, those with a mask."""
        shown = [name for name in cameras if recording.with_image([index], [name])]
        if self.observed.what != "masks":
            return shown
        if self.given is not None:
            return [name for name in shown if self.given.available(index, name)]
        return [name for name in shown if recording.has_masks(name, domain, index)]

    def covers(self, recording: Recording, index: int, domain: str, cameras: Sequence[str]) -> bool:
        """Whether a frame has an image, and each of its images can be compared."""
        found = self.seen(recording, index, domain, cameras)
        return bool(found) and len(found) == sum(bool(recording.with_image([index], [name])) for name in cameras)


NETWORK = Target()
"""The network's predictions as target."""


@dataclass(frozen=True)
class Preset:
    """A named set of solver settings."""

    meaning: str
    """When to use the preset, as text for the user."""
    changes: Callable[[SurfaceSolver], dict[str, Any]]
    """Changes to the default settings of a solver of surface maps; other solvers have only the default preset."""


PRESETS = {
    "Default": Preset("Default settings.", lambda _: {}),
    "Quick": Preset("Smaller images: faster, less accurate.", lambda solver: {"stages": reduced(solver.stages, 0.75)}),
    "Far off": Preset("Measured joints with errors above 3 degrees.", lambda _: {"prior_deg": 6.0}),
    "Well calibrated": Preset("Measured joints accurate to about 1 degree.", lambda _: {"prior_deg": 1.0}),
    "Smoke and haze": Preset("Images are dehazed before comparison.", lambda _: {"dehaze": 1.0}),
}
"""Presets by name, the default first."""


@dataclass(frozen=True)
class ListedFrame:
    """A frame to inspect after sequence mode."""

    index: int
    reason: str
    """Text for the user."""
    taken: bool
    """Whether the solved pose is in the project; otherwise the frame is unchanged."""


@dataclass(frozen=True)
class SolveState:
    """Progress or result of sequence mode."""

    frames: range
    """All frames of the solve, including kept frames."""
    done: int = 0
    """Number of visited frames."""
    compared: int = 0
    """Number of frames that were compared with their previous poses, after all visits."""
    running: bool = True
    text: str = ""
    """Progress, as text for the user."""
    listed: tuple[ListedFrame, ...] = ()
    """Frames whose fit became worse or is doubtful."""
    base_frame_gain: float | None = None
    """At the end, the share of the residual that free base frames would explain [1]; None if unknown."""
    calibration: Any = None
    """Calibration of the project during the solve."""

    def suspicion(self, project: ProjectState) -> float | None:
        """`base_frame_gain`; None during a solve and after a change of the project's calibration."""
        same = project.records.get(WHOLE_PROJECT) is self.calibration
        return self.base_frame_gain if same and not self.running else None

    @property
    def progress(self) -> tuple[int, int]:
        """Completed and total steps; every frame is visited, then compared."""
        return self.done + self.compared, 2 * len(self.frames)


Frames = range
"""Indices of consecutive frames. An alias, since `ViewState` has a field `range`."""


class Phase(StrEnum):
    """Phase of the run."""

    IDLE = "idle"
    RUNNING = "running"
    PAUSED = "paused"


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose of arms and cameras in one frame, and its source."""

    scene: SceneState
    """Joint positions, base frames, extrinsics and intrinsics of the whole scene."""
    source: Source

    def equals(self, other: "Pose") -> bool:
        """Whether all values and the source are equal."""
        pairs = zip(_arrays(self.scene), _arrays(other.scene), strict=True)
        return self.source is other.source and all(np.array_equal(own, others) for own, others in pairs)


def _arrays(scene: SceneState) -> tuple[np.ndarray, ...]:
    return (*scene.joint_positions, scene.T_world_base, scene.T_camera_world, scene.intrinsics, scene.T_mount_world)


@dataclass(frozen=True)
class Scores:
    """Scores of a pose against ground truth; a score is None without ground truth."""

    dice: float | None = None
    """Dice overlap of the rendered mask and the ground truth in the shown camera, 0..1."""
    joint_degrees: float | None = None
    """Mean absolute error of the revolute joints [deg]."""
    cameras: Mapping[str, float] = field(default_factory=dict)
    """Camera -> Dice overlap, for cameras with a loaded image and a ground-truth mask, 0..1."""


@dataclass(frozen=True)
class Curves:
    """Curves of the current run, with one entry per iterate."""

    loss: tuple[float, ...] = ()
    stages: tuple[int, ...] = ()
    """The stage of each iterate; losses are comparable within a stage."""
    comparable: bool = False
    """Whether losses are comparable across stages, as after the end of the run."""
    scores: tuple[Scores, ...] = ()
    seconds: tuple[float, ...] = ()
    """Duration of each iteration [s]."""
    best: int = 0
    """Index of the best iterate so far. It may not have the lowest loss, since losses of different observations are
    not comparable."""


@dataclass(frozen=True, eq=False)
class Maps:
    """Maps of the optimizer at the shown pose, at its working resolution."""

    iterate: Iterate
    cameras: tuple[str, ...]
    """Cameras of the iterate's maps, in the same order."""
    of_run: bool = True
    """Whether a run produced the pose; otherwise the pose was only compared with the image."""


@dataclass(frozen=True)
class RefinedMasks:
    """Refined masks of the shown frame at a pose."""

    frame: Frame
    pose: SceneState
    ignored: Mapping[str, IgnoreRegion | None]
    """Camera -> ignored pixels, where the masks are as rendered."""
    masks: Mapping[str, Bool[np.ndarray, "height width"]]
    """Camera -> refined mask."""


@dataclass(frozen=True)
class RunState:
    """State of the run on the shown frame."""

    phase: Phase = Phase.IDLE
    curves: Curves = field(default_factory=Curves)
    reason: str | None = None
    """Termination reason of the run, as text for the user."""
    start: SceneState | None = None
    """Pose at the start of the run."""
    base_frame_gain: float | None = None
    """The share of the remaining residual that free base frames would explain [1]; None if unknown."""


@dataclass(frozen=True)
class ExportState:
    """The running or last export."""

    format: str
    """Name of the format, as text for the user."""
    frames: int
    """Number of exported frames."""
    done: int = 0
    total: int = 0
    """Number of steps; 0 until the first is done."""
    path: Path | None = None
    """Path of the finished export; None until then."""


@dataclass(frozen=True)
class LiveState:
    """A live stream, shown in place of the recording, or the result of the last stream."""

    source: str
    """Name of the source, as text for the user."""
    text: str = ""
    """Progress, as text for the user."""
    on: bool = True
    busy: bool = False
    """Whether no frame has arrived yet."""
    verdict: str = "lost"
    """Verdict on the shown frame: good, doubtful or lost."""
    age: float = 0.0
    """Latency of the shown result [s]."""
    current: bool = True
    """Whether the latency is at most two frame intervals of the stream."""
    silent: float = 0.0
    """Time without a new result [s]; 0 while results arrive."""


@dataclass(frozen=True)
class KeypointState:
    """Keypoints, and their clicked positions in the shown frame."""

    shown: bool = False
    """Whether keypoints are drawn in the picture."""
    chosen: str | None = None
    """Label of the keypoint that a click places; None for the nearest."""
    pins: tuple[Pin, ...] = ()
    residuals: tuple[float, ...] = ()
    """Distance of each pin from its keypoint in the shown pose [px]."""


@dataclass(frozen=True, eq=False)
class ViewState:
    """Complete state of a page."""

    index: int
    frame: Frame
    """The shown frame; holds at least the image of `camera`."""
    domain: str
    camera: str
    pose: Pose
    layer: Layer
    opacity: float
    settings: SolverSettings
    free: FreeParameters
    project: ProjectState
    """Saved state of the project, with the draft of an unsaved gesture."""
    unsaved: bool = False
    """Whether the last step of `project` is a gesture that is not saved yet."""
    solver: SolverName = SolverName.SURFACE
    """Name of the solver of `settings`."""
    settings_error: str | None = None
    """Reason why the last change of a setting was rejected."""
    settings_field: str | None = None
    """Name of that setting."""
    time_error: str | None = None
    """Reason why the typed time offset cannot be used."""
    observed: Observed = field(default_factory=Observed)
    """Target of runs."""
    every_camera: bool = True
    """Whether a run uses all cameras or only the shown camera."""
    compare: Compare = field(default_factory=Compare)
    """The comparison in the picture, if any."""
    filter: FrameFilter = field(default_factory=FrameFilter)
    """Filter of *Find*."""
    reach: Reach = Reach.NEAR
    """Range of the joint sliders."""
    range: tuple[int, int] | None = None
    """First and last frame of the part that is played, solved and optimized; None for the whole sequence."""
    beside: bool = True
    """Whether the images of the other cameras are shown beside that of the active camera."""
    playing: bool = False
    fps: float = 10.0
    run: RunState = field(default_factory=RunState)
    solve: SolveState | None = None
    """The running or last solve of many frames."""
    direction: Direction = "forward"
    """Direction in which many frames are solved."""
    joint: tuple[str, int] | None = None
    """The joint that keys move, as arm and index of the joint; None for the first."""
    keypoints: KeypointState = field(default_factory=KeypointState)
    brush: Brush = field(default_factory=Brush)
    loupe: bool = False
    """Whether the loupe is shown."""
    keys: Mapping[str, str] = field(default_factory=dict)
    """Keys that the user has changed, by action (`carts_viewer.actions.shortcuts`)."""
    maps: Maps | None = None
    """Maps of the shown pose, frame and domain; None until needed."""
    refined: RefinedMasks | None = None
    """Masks for the layer *Refined mask*; outdated after a change of frame or pose, see `refined_mask`."""
    scores: Scores | None = None
    """Scores of the shown pose; None until computed, after its picture was sent."""
    networks: tuple[str, ...] = ()
    """Networks to choose from: the initial network, and networks adapted to the recording."""
    network: str = ""
    """The network in use."""
    asked_network: str = ""
    """The chosen network if its weights are not accepted yet; otherwise empty."""
    problems: tuple[str, ...] = ()
    """Messages about damaged files beside the project."""
    unfamiliar: tuple[str, ...] = ()
    """Warnings that arms or images are outside the domain of the network."""
    jobs: tuple[Job, ...] = ()
    """Jobs, oldest first."""
    can_undo: bool = False
    """Whether this user may have a step to undo."""
    can_redo: bool = False
    """Whether this user has a step to redo."""
    name: str = ""
    """Name of this user."""
    others: tuple[tuple[str, int], ...] = ()
    """Names and frames of the other users who are present."""
    busy: str | None = None
    """Current preparation of the worker, as text for the user."""
    export: ExportState | None = None
    live: LiveState | None = None
    error: str | None = None
    notice: str | None = None
    """A message that is not an error."""
    importing: int | None = None
    """Number of images that the running import of masks has read; None without an import."""
    imported: str = ""
    """Summary of the last import of masks, as text for the user."""

    @property
    def choices(self) -> Choices:
        """Choices that jobs of this tab use."""
        return Choices(**{choice.name: getattr(self, choice.name) for choice in fields(Choices)})

    @property
    def part(self) -> Frames:
        """Frames of the range, or of the whole sequence."""
        first, last = self.range or (0, len(self.project.identity.frame_ids) - 1)
        return range(first, last + 1)

    @property
    def run_outdated(self) -> bool:
        """Whether the pose, or an input of the run, was changed since the last run."""
        return bool(self.run.curves.loss) and (self.maps is None or not self.maps.of_run)

    @property
    def verdict(self) -> FitVerdict | None:
        """Verdict on the shown pose; None if it was not assessed."""
        return None if self.streaming else self.project.verdict(self.index)

    @property
    def streaming(self) -> bool:
        """Whether frame and pose belong to a live stream, and thus are not in the project."""
        return self.live is not None and self.live.on

    @property
    def undoable(self) -> int:
        """Number of steps that can be undone."""
        return self.project.position

    @property
    def solving(self) -> bool:
        """Whether many frames are being solved now."""
        return self.solve is not None and self.solve.running

    @property
    def review(self) -> Review:
        """Review of the shown frame."""
        return self.project.review(self.index)

    @property
    def mask_correction(self) -> MaskCorrection | None:
        """Mask correction of the shown frame and camera."""
        return self.mask_correction_of(self.camera)

    def refined_mask(self, pose: SceneState, camera: str) -> Bool[np.ndarray, "height width"] | None:
        """Refined mask of the shown frame at a pose; None if it is not computed."""
        known = self.refined
        if known is None or known.frame is not self.frame or known.pose is not pose:
            return None
        return known.masks.get(camera) if known.ignored.get(camera) is self.ignore_region_of(camera) else None

    @property
    def ignore_region(self) -> IgnoreRegion | None:
        """The pixels of the shown frame and camera that the optimizer ignores."""
        return self.ignore_region_of(self.camera)

    def mask_correction_of(self, camera: str) -> MaskCorrection | None:
        """Mask correction of the shown frame in a camera."""
        return None if self.streaming else self.project.get(Key.mask_correction(self.index, camera))

    def part_labels_of(self, camera: str) -> PartLabels | None:
        """Painted part labels of the shown frame in a camera."""
        return None if self.streaming else self.project.get(Key.part_labels(self.index, camera))

    def ignore_region_of(self, camera: str) -> IgnoreRegion | None:
        """The pixels of the shown frame that the optimizer ignores in a camera."""
        return None if self.streaming else self.project.get(Key.ignore_region(self.index, camera))
