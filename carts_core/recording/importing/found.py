"""Contents of a foreign recording before a sequence file is written, and the interface of their readers."""

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
    """Default name of a recording: its folder's name, or its file's without the suffix."""
    path = path.absolute()
    return path.name if path.is_dir() else path.stem


MALFORMED = (OSError, RecursionError, ValueError, TypeError, KeyError, AttributeError, IndexError)
"""Errors of files that cannot be read, and of values of a wrong form."""


def cause(error: Exception) -> str:
    """Cause of one of the `MALFORMED` errors, in one line."""
    return f"{error} is missing" if isinstance(error, KeyError) else " ".join(str(error).split())


@contextmanager
def well_formed(requirement: str, remedy: str = "Copy it again.") -> Iterator[None]:
    """Raise `SequenceError` for `MALFORMED` errors in the block: the violated requirement, the cause, and a remedy."""
    try:
        yield
    except MALFORMED as error:
        raise SequenceError(f"{requirement} ({cause(error)}). {remedy}") from error


def read_json(path: Path) -> Any:
    """Content of a JSON file of a recording."""
    if not is_regular(path):
        raise SequenceError(f"{path} is missing. Correct the path.")
    with well_formed(f"{path} is not readable JSON"):
        return parse_json(read_text(path, VALUES))


class PartError(SequenceError):
    """Unusable part of a recording.

    Attributes:
        part: the part; `recording` for the whole.
        problem: cause, and a remedy without options of the command line.
        about: name of the camera; empty for all.
        remedy: further sentence with options of the command line.
    """

    def __init__(self, part: Part, problem: str, remedy: str = "", *, about: str = "") -> None:
        super().__init__(f"{problem} {remedy}" if remedy else problem)
        self.part: Part = part
        self.problem, self.about, self.remedy = problem, about, remedy


@dataclass(frozen=True)
class Note:
    """A line of the report; `str` gives it with options of the command line."""

    kind: NoteKind
    text: str
    """Sentences without options of the command line."""
    about: str = ""
    """Name of the camera or arm; empty for the recording."""
    option: str = ""
    """Option of the command line that changes a guess, such as `--units yaw UNIT`."""
    remedy: str = ""
    """Further sentence with options of the command line."""
    placeholder: str = ""
    """Field of the camera or arm that has a placeholder, such as `T_world_base`."""

    def __str__(self) -> str:
        text = f"{self.text.removesuffix('.')} (change: {self.option})." if self.option else self.text
        return f"{self.about + ': ' if self.about else ''}{text}{' ' + self.remedy if self.remedy else ''}"


@dataclass(frozen=True)
class Import:
    """An import in progress: its options, and the notes of its report in the order in which they were made."""

    options: ImportOptions
    notes: list[Note] = field(default_factory=list)

    def found(self, text: str, about: str = "", option: str = "", *, given: bool = True) -> None:
        """Add a note on a value of the recording, or on a guess of a value that is not `given`."""
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
        """The same import with other options."""
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
        """The recording with the notes and the given time offset; `further` are other fields of `FoundRecording`."""
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
    """A camera and the location of its images."""

    name: str
    size: tuple[int, int]
    """Width and height of its images [px]."""
    images: Path
    """Folder, video or bag; absolute."""
    pattern: str = ""
    """File name pattern of a frame below `images`; empty for a video or bag."""
    intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy [px]; None if not known."""
    pixel_center: float = 0.0
    """Position of the first pixel's centre: 0 in OpenCV's convention, 0.5 in that of carts."""
    distortion: tuple[float, ...] = ()
    """OpenCV's distortion coefficients."""
    T_camera_world: Float[np.ndarray, "4 4"] | None = None
    """Extrinsics [m]; None if not known. The world is the frame of the first camera."""
    rectification: Float[np.ndarray, "3 3"] | None = None
    """R of ROS: from the camera's frame to the common frame of a rectified pair."""
    projection: Float[np.ndarray, "3 4"] | None = None
    """P of ROS [px]; its last column contains the baseline."""
    masks: str = ""
    """File name pattern of its masks, below `images.parent` or absolute; empty without masks."""
    sparse_masks: bool = False
    bits: int | None = None
    """Bit depth of images of 16 bits; None for 8."""
    crop: tuple[int, int, int, int] | None = None
    """Left, top, width, height of its part of each image [px]; None for the whole image."""
    topic: str = ""
    """Topic in a bag; empty for other sources."""
    numbers: Int[np.ndarray, " frames"] | None = None
    """Video frame number, or record time of the message [ns], of every frame; None if frames are numbered
    consecutively."""


@dataclass(frozen=True, eq=False)
class FoundArm:
    """An arm and its joint positions."""

    name: str
    columns: tuple[str, ...] = ()
    """Names of the measured joints."""
    values: Float[np.ndarray, "rows columns"] | None = None
    """Joint positions [rad], [m]; None without kinematics."""
    times: Float[np.ndarray, " rows"] | None = None
    """Times in the recording's clock, increasing [s]; None if row n belongs to frame n."""
    robot: str = "builtin:psm_lnd"
    T_world_base: Float[np.ndarray, "4 4"] | None = None
    """Base frame [m]; None if not known."""
    base_from: str = ""
    """Source of the base frame, for the report."""
    beyond_limits: bool = False
    """Whether positions exceed the robot's limits, so that the sequence file has to name their units."""


@dataclass(frozen=True, eq=False)
class FoundRecording:
    """Content of a recording, as found by a source."""

    kind: str
    """Name of the source."""
    name: str
    cameras: tuple[FoundCamera, ...]
    arms: tuple[FoundArm, ...]
    frame_ids: tuple[str, ...]
    frame_times: Float[np.ndarray, " frames"] | None
    """Times in the recording's clock [s]; None if rows of the tables are frames."""
    notes: tuple[Note, ...] = ()
    time_offset: float = 0.0
    """Time in the kinematics minus time of the image [s]."""
    motion: Track | None = None
    """T_world_mount [m] of the mount that carries all cameras; None for static cameras."""
    domains: Mapping[str, str] = field(default_factory=dict)
    """Domain -> value of {domain} in patterns; empty for one domain."""


@dataclass(frozen=True)
class Source:
    """A recording format that can be imported."""

    name: str
    """Value of `--source`."""
    label: str
    """Label of the format."""
    looked_for: str
    """Files by which the format is detected, as a phrase."""
    detect: Callable[[Path], bool]
    """Whether a path is of this format; quick, never raises."""
    uses: tuple[str, ...]
    """Names of the `ImportOptions` that it uses, besides those of arms, robots and calibrations, which all sources
    use."""
    read: Callable[[Path, Import], FoundRecording]
    """Reads the recording; raises a `CartsError` for damaged or contradictory content."""
