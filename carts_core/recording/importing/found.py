"""Contents of a foreign recording before a sequence file is written, and the interface of their readers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from ...settings.interchange import ImportOptions

NoteKind = Literal["found", "guessed", "missing", "warning"]


def recording_name(path: Path) -> str:
    """What a recording is called by default: its folder's name, or its file's without the suffix."""
    path = path.absolute()
    return path.name if path.is_dir() else path.stem


@dataclass(frozen=True)
class Note:
    """A line of the report."""

    kind: NoteKind
    text: str
    """A sentence for people; guesses and what is missing say how to change it."""


@dataclass(frozen=True, eq=False)
class FoundCamera:
    """A camera and where its images lie."""

    name: str
    size: tuple[int, int]
    """Width and height of its images [px]."""
    images: Path
    """Folder, video or bag; absolute."""
    pattern: str = ""
    """Name of every frame's image below `images`; empty for a video or bag."""
    intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy [px], None where not known."""
    pixel_center: float = 0.0
    """Where the first pixel's centre is in these: 0 in OpenCV's convention, 0.5 in ours."""
    distortion: tuple[float, ...] = ()
    """OpenCV's coefficients."""
    T_camera_world: Float[np.ndarray, "4 4"] | None = None
    """[m]; None where not known. The world is the frame of the first camera."""
    rectification: Float[np.ndarray, "3 3"] | None = None
    """R of ROS: from the camera's frame to the common one of a rectified pair."""
    projection: Float[np.ndarray, "3 4"] | None = None
    """P of ROS [px], whose last column has the baseline."""
    masks: str = ""
    """Pattern of its masks, below `images.parent` or absolute; empty without masks."""
    sparse_masks: bool = False
    bits: int | None = None
    """Of the values of images with 16; None for 8."""
    crop: tuple[int, int, int, int] | None = None
    """Left, top, width, height of its part of each image [px]."""
    topic: str = ""
    """In a bag."""
    numbers: Int[np.ndarray, " frames"] | None = None
    """Frame of its video, or record time of its message [ns], for every frame; None where frames are counted."""


@dataclass(frozen=True, eq=False)
class FoundArm:
    """An arm and its joint positions."""

    name: str
    columns: tuple[str, ...] = ()
    """Joints of the robot that are measured."""
    values: Float[np.ndarray, "rows columns"] | None = None
    """[rad], [m]; None without kinematics."""
    times: Float[np.ndarray, " rows"] | None = None
    """In the recording's seconds, increasing; None where row n belongs to frame n."""
    robot: str = "builtin:psm_lnd"
    T_world_base: Float[np.ndarray, "4 4"] | None = None
    """[m]; None where not known."""
    base_from: str = ""
    """What it was taken from, for people."""
    fixed: tuple[str, ...] = ()
    """Further joints of the robot, which stay at 0."""
    beyond_limits: bool = False
    """Whether positions exceed the robot's limits all the same, so that the sequence file has to name their units."""


@dataclass(frozen=True, eq=False)
class FoundMotion:
    """Where what carries the cameras was over time."""

    times: Float[np.ndarray, " rows"]
    """In the recording's seconds, increasing."""
    Ts_world_mount: Float[np.ndarray, "rows 4 4"]
    """[m]"""


@dataclass(frozen=True, eq=False)
class FoundRecording:
    """All that a source holds."""

    kind: str
    """The source's name for people."""
    name: str
    cameras: tuple[FoundCamera, ...]
    arms: tuple[FoundArm, ...]
    frame_ids: tuple[str, ...]
    frame_times: Float[np.ndarray, " frames"] | None
    """In the recording's seconds; None where rows of the tables are frames."""
    notes: tuple[Note, ...] = ()
    time_offset: float = 0.0
    """Time in the kinematics minus time of the image [s]."""
    motion: FoundMotion | None = None
    """Of all cameras; None for cameras that stay."""
    domains: Mapping[str, str] = field(default_factory=dict)
    """Domain -> what stands for {domain} in patterns; empty for one domain."""


@dataclass(frozen=True)
class Source:
    """A kind of recording that can be imported."""

    name: str
    """As `--source` calls it."""
    label: str
    """For people."""
    looked_for: str
    """What shows that a folder or file is of this kind, for people."""
    detect: Callable[[Path], bool]
    """Whether a path is of this kind; quick, and without an error whatever the path is."""
    uses: tuple[str, ...]
    """Names of the `ImportOptions` that it uses beside those of arms, robots and calibrations, which all do."""
    read: Callable[[Path, ImportOptions], FoundRecording]
    """Everything that is found; raises a `CartsError` for what is damaged or contradicts itself."""
