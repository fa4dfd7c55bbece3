"""Content of a foreign recording before a sequence file is written, and interface of the readers."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from ...errors import SequenceError
from ...files.reading import VALUES, is_regular, parse_json, read_text
from ...settings.interchange import ImportOptions

NoteKind = Literal["found", "guessed", "missing", "warning"]
Part = Literal["images", "calibration", "kinematics", "columns", "recording"]


def recording_name(path: Path) -> str:
    """Default name of a recording: the name of its folder, or of its file without the suffix."""
    path = path.absolute()
    return path.name if path.is_dir() else path.stem


MALFORMED = (OSError, RecursionError, ValueError, TypeError, KeyError, AttributeError, IndexError)
"""Exceptions raised for unreadable files and malformed values."""


def cause(error: Exception) -> str:
    """One-line description of a `MALFORMED` exception."""
    return f"{error} is missing" if isinstance(error, KeyError) else " ".join(str(error).split())


@contextmanager
def well_formed(requirement: str, remedy: str = "Copy it again.") -> Iterator[None]:
    """Convert `MALFORMED` exceptions in the block to `SequenceError` with the violated requirement, the cause and a
    remedy."""
    try:
        yield
    except MALFORMED as error:
        raise SequenceError(f"{requirement} ({cause(error)}). {remedy}") from error


def read_json(path: Path) -> Any:
    """Read a JSON file of a recording."""
    if not is_regular(path):
        raise SequenceError(f"{path} is missing. Correct the path.")
    with well_formed(f"{path} is not readable JSON"):
        return parse_json(read_text(path, VALUES))


class PartError(SequenceError):
    """Unusable part of a recording.

    Attributes:
        part: name of the part, or `recording`.
        problem: cause and remedy, without command-line options.
        about: name of the camera; empty for all.
        remedy: further sentence with command-line options.
    """

    def __init__(self, part: Part, problem: str, remedy: str = "", *, about: str = "") -> None:
        super().__init__(f"{problem} {remedy}" if remedy else problem)
        self.part: Part = part
        self.problem, self.about, self.remedy = problem, about, remedy


@dataclass(frozen=True)
class Note:
    """Line of the report; `str` includes the command-line options."""

    kind: NoteKind
    text: str
    """Sentences without command-line options."""
    about: str = ""
    """Name of the camera or arm; empty for the recording."""
    option: str = ""
    """Command-line option that changes a guess, such as `--units yaw UNIT`."""
    remedy: str = ""
    """Further sentence with command-line options."""
    placeholder: str = ""
    """Field of the camera or arm with a placeholder value, such as `T_world_base`."""

    def __str__(self) -> str:
        text = f"{self.text.removesuffix('.')} (change: {self.option})." if self.option else self.text
        return f"{self.about + ': ' if self.about else ''}{text}{' ' + self.remedy if self.remedy else ''}"


@dataclass(frozen=True)
class Import:
    """Import in progress: options, and notes of the report in chronological order."""

    options: ImportOptions
    notes: list[Note] = field(default_factory=list)

    def found(self, text: str, about: str = "", option: str = "", *, given: bool = True) -> None:
        """Add a note on a value of the recording; the value is a guess unless `given`."""
        self.notes.append(Note("found" if given else "guessed", text, about, option))

    def guessed(self, text: str, about: str = "", option: str = "") -> None:
        """Add a note on a guess."""
        self.found(text, about, option, given=False)

    def missing(self, text: str, about: str = "", *, remedy: str = "", placeholder: str = "") -> None:
        """Add a note on a missing value."""
        self.notes.append(Note("missing", text, about, "", remedy, placeholder))

    def warning(self, text: str, about: str = "", option: str = "", *, remedy: str = "") -> None:
        """Add a warning."""
        self.notes.append(Note("warning", text, about, option, remedy))

    def with_options(self, **changes: Any) -> "Import":
        """Copy of the import with other options."""
        return replace(self, options=replace(self.options, **changes))

    def arm_name(self, recorded: str) -> str | None:
        """Name of a recorded arm in the sequence; None if the arm is omitted."""
        names = {given: name for name, given in self.options.arms.items()}
        return names.get(recorded) if names else recorded

    def recording(
        self,
        kind: str,
        name: str,
        cameras: "Iterable[FoundCamera]",
        arms: "Iterable[FoundArm]",
        ids: tuple[str, ...],
        times: Float[np.ndarray, " frames"] | None,
        **further: Any,
    ) -> "FoundRecording":
        """Create the recording with the notes and the given time offset; `further` are other fields of
        `FoundRecording`."""
        further = {"time_offset": self.options.time_offset or 0.0, **further}
        return FoundRecording(kind, name, tuple(cameras), tuple(arms), ids, times, tuple(self.notes), **further)


@dataclass(frozen=True, eq=False)
class Track:
    """Time series: joint positions [rad], [m], poses x y z [m] with a quaternion x y z w, or transforms."""

    times: Float[np.ndarray, " rows"]
    """Times in the recording's clock, increasing [s]."""
    values: Float[np.ndarray, "rows ..."]


@dataclass(frozen=True, eq=False)
class FoundCamera:
    """Camera and the location of its images."""

    name: str
    size: tuple[int, int]
    """Width and height of its images [px]."""
    images: Path
    """Absolute path of the folder, video or bag."""
    pattern: str = ""
    """File name pattern of the frames in `images`; empty for a video or bag."""
    intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy [px]; None if not known."""
    pixel_center: float = 0.0
    """Coordinate of the first pixel's centre: 0 in OpenCV's convention, 0.5 in CaRTS."""
    distortion: tuple[float, ...] = ()
    """OpenCV's distortion coefficients."""
    T_camera_world: Float[np.ndarray, "4 4"] | None = None
    """Extrinsics [m]; None if unknown. The world is the frame of the left camera, else of the first camera."""
    rectification: Float[np.ndarray, "3 3"] | None = None
    """R of ROS: rotation from the camera's frame to the common frame of a rectified pair."""
    projection: Float[np.ndarray, "3 4"] | None = None
    """P of ROS [px]; its last column contains the baseline."""
    masks: str = ""
    """Absolute path of the masks, with a pattern of their file names; empty without masks."""
    sparse_masks: bool = False
    sparse_images: bool = False
    """Whether some frames have no image."""
    bits: int | None = None
    """Number of significant bits of images stored with 16 bits; None for 8-bit images."""
    crop: tuple[int, int, int, int] | None = None
    """Left, top, width and height of the camera's part of each image [px]; None for the whole image."""
    topic: str = ""
    """Topic in a bag; empty for other sources."""
    numbers: Int[np.ndarray, " frames"] | None = None
    """Video frame number or message record time [ns] of every frame; None for consecutive frames."""


@dataclass(frozen=True, eq=False)
class FoundArm:
    """Arm and its joint positions."""

    name: str
    columns: tuple[str, ...] = ()
    """Names of the measured joints."""
    values: Float[np.ndarray, "rows columns"] | None = None
    """Joint positions [rad], [m]; None without kinematics."""
    times: Float[np.ndarray, " rows"] | None = None
    """Times in the recording's clock, increasing [s]; None if row n belongs to frame n."""
    robot: str = "builtin:psm_lnd"
    T_world_base: Float[np.ndarray, "4 4"] | None = None
    """Base frame [m]; None if unknown."""
    base_from: str = ""
    """Source of the base frame, for the report."""
    time_offset: float = 0.0
    """Time offset in addition to that of the recording [s]."""
    beyond_limits: bool = False
    """Whether positions exceed the robot's limits, so that the sequence file must state their units."""


@dataclass(frozen=True, eq=False)
class FoundRecording:
    """Content of a recording, as found by a source."""

    kind: str
    """Kind of the recording as a noun phrase, such as "a ROS bag"."""
    name: str
    cameras: tuple[FoundCamera, ...]
    arms: tuple[FoundArm, ...]
    frame_ids: tuple[str, ...]
    frame_times: Float[np.ndarray, " frames"] | None
    """Times in the recording's clock [s]; None if rows of the tables are frames."""
    notes: tuple[Note, ...] = ()
    time_offset: float = 0.0
    """Kinematics time minus image time [s]."""
    motion: Track | None = None
    """T_world_mount [m] of the mount that carries all cameras; None for static cameras."""
    domains: Mapping[str, str] = field(default_factory=dict)
    """Domain -> value of {domain} in patterns; empty for a single domain."""
    path: Path | None = None
    """File or folder that was imported; None if not known."""


@dataclass(frozen=True)
class Source:
    """Supported recording format."""

    name: str
    """Value of `--source`."""
    label: str
    """Label of the format."""
    looked_for: str
    """Description of the files by which the format is detected."""
    detect: Callable[[Path], bool]
    """Function that tests whether a path has this format; fast, never raises."""
    uses: tuple[str, ...]
    """Names of the `ImportOptions` that the source uses, in addition to those of arms, robots and calibrations."""
    read: Callable[[Path, Import], FoundRecording]
    """Function that reads the recording; raises a `CartsError` for damaged or contradictory content."""
