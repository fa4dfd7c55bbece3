"""Immutable values of a project, and their keys."""

import json
import math
import operator
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import lru_cache
from typing import Any, Generic, Self, TypeVar

import numpy as np
from jaxtyping import Float

from ..errors import ProjectError, SettingsError
from ..model.camera import rigid_transform
from .identity import SequenceIdentity
from .layers import IgnoreRegion, ImportedMask, Layer, MaskCorrection, PartLabels

_Choice = TypeVar("_Choice", bound=StrEnum)

MAX_NOTE_LENGTH = 10_000
"""Maximum length of a note [characters]."""


class Source(StrEnum):
    """Origin of a value."""

    MEASURED = "measured"
    HAND = "hand"
    OPTIMIZER = "optimizer"
    PROPAGATED = "propagated"


@dataclass(frozen=True)
class Provenance:
    """Origin of a value, with settings and weights.

    Raises:
        ProjectError: a value of the optimizer lacks settings or a required hash, settings are not JSON, or a hash is
            invalid.
    """

    source: Source
    settings: str | None = None
    """Settings as JSON; required for values of the optimizer."""
    weights_sha256: str | None = None
    """SHA-256 of the network's weights; required for values of the optimizer, except for fits of masks without a
    network."""

    def __post_init__(self) -> None:
        _set(self, "source", _choice(Source, self.source, "provenance"))
        try:
            used = None if self.settings is None else json.loads(self.settings)
        except ValueError as error:
            raise ProjectError(f"settings are not valid JSON ({error}). Give the output of json.dumps.") from error
        masks_alone = isinstance(used, dict) and used.get("observe") == "masks"
        if self.source is Source.OPTIMIZER and (self.settings is None or not (self.weights_sha256 or masks_alone)):
            raise ProjectError("a value of an optimizer requires its settings and the hash of its weights. Give both.")
        if self.weights_sha256 is not None and not re.fullmatch("[0-9a-f]{64}", self.weights_sha256):
            raise ProjectError(f"{self.weights_sha256!r} is not a SHA-256 hash. Give 64 hexadecimal digits.")

    @staticmethod
    def made_by_optimizer(
        settings: Mapping[str, Any], weights_sha256: str | None, source: Source = Source.OPTIMIZER
    ) -> "Provenance":
        """Provenance of an optimizer's result.

        Args:
            settings: JSON-compatible values, such as a solver's settings converted by
                `carts_core.settings.serialization.to_plain`.
            weights_sha256: SHA-256 of the weights file; None if only masks were fitted (see `observe` in the settings).
            source: OPTIMIZER, or PROPAGATED for a frame solved between keyframes.
        """
        return Provenance(source, json.dumps(settings, sort_keys=True, allow_nan=False), weights_sha256)


class JsonValue:
    """Dataclass that is stored as JSON."""

    def encode(self) -> str:
        """Encode the value as JSON."""
        return json.dumps(asdict(self), allow_nan=False)  # pyright: ignore[reportArgumentType]

    @classmethod
    def decode(cls, text: str) -> Self:
        """Decode the result of `encode`; `ValueError`, `TypeError` or `ProjectError` for other texts."""
        values = json.loads(text)
        if "provenance" in values:
            values["provenance"] = _shared_provenance(**values["provenance"])
        return cls(**values)


@dataclass(frozen=True)
class JointCorrection(JsonValue):
    """Joint positions of one arm in one frame. All sequences of numbers are accepted, and stored as tuples.

    Raises:
        ProjectError: a joint position is not finite, a standard deviation is negative, or the lengths differ.
    """

    joint_positions: tuple[float, ...]
    """Joint positions in the order of `Robot.joint_names` [rad, m]."""
    provenance: Provenance
    standard_deviations: tuple[float | None, ...] | None = None
    """Standard deviation of each joint [rad, m], None if not determined; NaN and infinity become None."""

    def __post_init__(self) -> None:
        _set(self, "joint_positions", _finite(self.joint_positions, "joint positions"))
        if self.standard_deviations is not None:
            deviations = _deviations(self.standard_deviations)
            if len(deviations) != len(self.joint_positions):
                raise ProjectError(
                    f"{len(deviations)} standard deviations were given for {len(self.joint_positions)} joints. "
                    "Give one per joint."
                )
            _set(self, "standard_deviations", deviations)


@dataclass(frozen=True)
class CorrectedTransform(JsonValue):
    """Rigid transform of the calibration: `T_world_base` of an arm or `T_camera_world` of a camera."""

    transform: tuple[tuple[float, ...], ...]
    """Transform as 4 rows of 4 numbers [m]."""
    provenance: Provenance

    def __post_init__(self) -> None:
        try:
            rigid_transform(self.transform, "the corrected transform")
        except SettingsError as error:
            raise ProjectError(str(error)) from error
        # Stored without rounding.
        _set(self, "transform", tuple(tuple(float(value) for value in row) for row in self.transform))

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """Transform as a new 4 x 4 matrix [m]."""
        return np.array(self.transform)


@dataclass(frozen=True)
class CorrectedIntrinsics(JsonValue):
    """Intrinsics of a camera: four finite numbers, with positive focal lengths."""

    intrinsics: tuple[float, ...]
    """fx, fy, cx, cy [px]."""
    provenance: Provenance

    def __post_init__(self) -> None:
        values = _finite(self.intrinsics, "intrinsics")
        if len(values) != 4 or min(values[:2]) <= 0:
            raise ProjectError(f"intrinsics are {list(values)}. Give fx, fy, cx, cy [px] with positive fx and fy.")
        _set(self, "intrinsics", values)


@dataclass(frozen=True)
class TimeOffset(JsonValue):
    """Time offset (kinematics minus image) that overrides the sequence's time offset; see `TimeMatching`."""

    seconds: float
    """Time offset [s]."""

    def __post_init__(self) -> None:
        _set(self, "seconds", _finite([self.seconds], "the time offset")[0])


@dataclass(frozen=True)
class Keyframe(JsonValue):
    """User's choice whether a frame is a keyframe; see `ProjectState.is_keyframe`."""

    held: bool


class ReviewState(StrEnum):
    """Review state of a frame, set by the user or by the last run."""

    UNTOUCHED = "untouched"
    OPTIMIZED = "optimized"
    NEEDS_WORK = "needs work"
    ACCEPTED = "accepted"
    REJECTED = "rejected"


UNREVIEWED = frozenset({ReviewState.UNTOUCHED, ReviewState.OPTIMIZED})
"""States without a manual review."""


@dataclass(frozen=True)
class Review(JsonValue):
    """Review state of a frame, with a note of at most `MAX_NOTE_LENGTH` characters."""

    state: ReviewState = ReviewState.UNTOUCHED
    note: str = ""

    def __post_init__(self) -> None:
        _set(self, "state", _choice(ReviewState, self.state, "review state"))
        if not isinstance(self.note, str) or len(self.note) > MAX_NOTE_LENGTH:
            raise ProjectError(f"a note must have at most {MAX_NOTE_LENGTH} characters. Shorten it.")


@dataclass(frozen=True)
class Figures:
    """Quality of the fit of a frame; finite numbers."""

    loss: float | None = None
    """Loss of the optimizer [1]."""
    dice: float | None = None
    """Dice with the ground-truth mask, 0 to 1; None without ground truth."""

    def __post_init__(self) -> None:
        for name in ("loss", "dice"):
            value = getattr(self, name)
            if value is not None:
                _set(self, name, _finite([value], name)[0])


@lru_cache(maxsize=1024)
def _shared_provenance(source: str, settings: str | None, weights_sha256: str | None) -> Provenance:
    """Intern provenances: equal values share one object to save memory."""
    return Provenance(Source(source), settings, weights_sha256)


def _set(instance: object, name: str, value: object) -> None:
    """Set a field of a frozen dataclass during its construction."""
    object.__setattr__(instance, name, value)


def _choice(kind: type[_Choice], value: object, what: str) -> _Choice:
    try:
        return kind(value)
    except ValueError as error:
        raise ProjectError(f"{what} is {value!r}, but must be one of: {', '.join(kind)}.") from error


def _finite(values: Iterable[float], what: str) -> tuple[float, ...]:
    try:
        numbers = tuple(map(float, values))
    except (TypeError, ValueError) as error:
        raise ProjectError(f"{what} must be a list of numbers, not {values!r}.") from error
    # The sum is a fast test: it is not finite if a number is not finite, or if it overflows.
    if not math.isfinite(sum(numbers)) and not all(map(math.isfinite, numbers)):
        raise ProjectError(f"{what} are {list(numbers)}. Give finite numbers.")
    return numbers


def _deviations(values: Iterable[float | None]) -> tuple[float | None, ...]:
    given = tuple(values)
    try:
        if math.isfinite(sum(given)) and min(given, default=0.0) >= 0:  # pyright: ignore
            return tuple(map(float, given))  # pyright: ignore
    except TypeError:
        pass  # Unknown values.
    return tuple(_deviation(value) for value in given)


def _deviation(value: float | None) -> float | None:
    if value is None or not math.isfinite(value):
        return None
    if value < 0:
        raise ProjectError(f"a standard deviation is {value:g}. Give 0 or more [rad, m], or None.")
    return float(value)


@dataclass(frozen=True)
class ImportedLabels(JsonValue):
    """Label names of imported masks, at most 255."""

    names: tuple[str, ...]
    """Names of the labels, numbered from 1."""

    def __post_init__(self) -> None:
        _set(self, "names", tuple(self.names))
        if len(self.names) > 255 or not all(isinstance(name, str) and len(name) <= 1000 for name in self.names):
            raise ProjectError("imported labels: at most 255 names of at most 1000 characters are allowed.")


@dataclass(frozen=True)
class ImportedKeypoints(JsonValue):
    """Imported keypoints of a frame, with finite coordinates."""

    points: tuple[tuple[str, float, float], ...]
    """Name, column and row in the undistorted image [px]."""

    def __post_init__(self) -> None:
        points = []
        for point in self.points:
            if len(point) != 3 or not isinstance(point[0], str):
                raise ProjectError(f"an imported keypoint is {point!r}. Give a name, a column and a row.")
            place = float(point[1]), float(point[2])
            if not all(map(math.isfinite, place)):
                raise ProjectError(f"the imported keypoint {point[0]!r} is at {place}. Give finite numbers.")
            points.append((point[0], *place))
        _set(self, "points", tuple(points))


VERDICTS = ("good", "doubtful", "failed")
"""Names of verdicts, as in `carts_core.optimization.Verdict`."""
MAX_TEXT_LENGTH = 2_000
"""Maximum length of a text [characters]."""


@dataclass(frozen=True)
class FitVerdict(JsonValue):
    """Reliability of a frame's fit; see `ProjectState.verdict` for its lifetime."""

    verdict: str
    """One of `VERDICTS`."""
    reason: str = ""
    """Reason, as a sentence."""
    remedy: str = ""
    """Proposed remedy, as a sentence; empty if no remedy is needed."""
    failure: float = 0.0
    """Probability that the mask is wrong (Dice below 0.9) [1]."""
    cameras: tuple[tuple[str, float], ...] = ()
    """Camera and its probability of failure [1], if there are several cameras."""

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise ProjectError(f"a verdict is {self.verdict!r}, but must be one of: {', '.join(VERDICTS)}.")
        for text in (self.reason, self.remedy):
            if not isinstance(text, str) or len(text) > MAX_TEXT_LENGTH:
                raise ProjectError(f"reason and remedy must have at most {MAX_TEXT_LENGTH} characters. Shorten them.")
        _set(self, "cameras", tuple((str(name), value) for name, value in self.cameras))
        for value in (self.failure, *(value for _, value in self.cameras)):
            if not (isinstance(value, float | int) and 0.0 <= value <= 1.0):
                raise ProjectError(f"the probability of a failure is {value!r}. Give a number from 0 to 1.")


V_co = TypeVar("V_co", covariant=True)

WHOLE_PROJECT = -1
"""Frame index of values that apply to all frames."""


class Kind(StrEnum):
    """Kind of a value."""

    JOINTS = "joints"
    MASK_CORRECTION = "mask_correction"
    IGNORE_REGION = "ignore_region"
    PART_LABELS = "part_labels"
    BASE_FRAME = "base_frame"
    EXTRINSICS = "extrinsics"
    INTRINSICS = "intrinsics"
    TIME_OFFSET = "time_offset"
    KEYFRAME = "keyframe"
    REVIEW = "review"
    VERDICT = "verdict"
    IMPORTED_MASK = "imported_mask"
    IMPORTED_KEYPOINTS = "imported_keypoints"
    IMPORTED_LABELS = "imported_labels"


VALUE_TYPES: dict[Kind, type] = {
    Kind.JOINTS: JointCorrection,
    Kind.MASK_CORRECTION: MaskCorrection,
    Kind.IGNORE_REGION: IgnoreRegion,
    Kind.PART_LABELS: PartLabels,
    Kind.BASE_FRAME: CorrectedTransform,
    Kind.EXTRINSICS: CorrectedTransform,
    Kind.INTRINSICS: CorrectedIntrinsics,
    Kind.TIME_OFFSET: TimeOffset,
    Kind.KEYFRAME: Keyframe,
    Kind.REVIEW: Review,
    Kind.VERDICT: FitVerdict,
    Kind.IMPORTED_MASK: ImportedMask,
    Kind.IMPORTED_KEYPOINTS: ImportedKeypoints,
    Kind.IMPORTED_LABELS: ImportedLabels,
}
CALIBRATION = frozenset({Kind.BASE_FRAME, Kind.EXTRINSICS, Kind.INTRINSICS, Kind.TIME_OFFSET})
"""Kinds of values that apply to all frames and affect the rendered arms."""
_OF_ARM = {Kind.JOINTS, Kind.BASE_FRAME}
_MARKS = {Kind.KEYFRAME, Kind.REVIEW, Kind.VERDICT}
_IMPORTED = {Kind.IMPORTED_MASK, Kind.IMPORTED_KEYPOINTS}
_PAINTED = {Kind.MASK_CORRECTION, Kind.IGNORE_REGION, Kind.PART_LABELS}
_OF_FRAME = {Kind.JOINTS, *_PAINTED, *_IMPORTED, *_MARKS}
_OF_NOBODY = {*_MARKS, Kind.TIME_OFFSET, Kind.IMPORTED_LABELS}


@dataclass(frozen=True)
class Key(Generic[V_co]):
    """Key of one value, created by static methods that determine the value's type."""

    kind: Kind
    frame: int
    """Index of the frame, or `WHOLE_PROJECT`."""
    name: str
    """Arm or camera; empty for other values."""

    @staticmethod
    def joints(frame: int, arm: str) -> "Key[JointCorrection]":
        """Joint positions of an arm in a frame."""
        return Key(Kind.JOINTS, operator.index(frame), arm)

    @staticmethod
    def mask_correction(frame: int, camera: str) -> "Key[MaskCorrection]":
        """Pixels added to and removed from the rendered mask."""
        return Key(Kind.MASK_CORRECTION, operator.index(frame), camera)

    @staticmethod
    def ignore_region(frame: int, camera: str) -> "Key[IgnoreRegion]":
        """Pixels where the arms are occluded."""
        return Key(Kind.IGNORE_REGION, operator.index(frame), camera)

    @staticmethod
    def part_labels(frame: int, camera: str) -> "Key[PartLabels]":
        """Manually painted part classes."""
        return Key(Kind.PART_LABELS, operator.index(frame), camera)

    @staticmethod
    def imported_mask(frame: int, camera: str) -> "Key[ImportedMask]":
        """Imported labels of pixels."""
        return Key(Kind.IMPORTED_MASK, operator.index(frame), camera)

    @staticmethod
    def imported_keypoints(frame: int, camera: str) -> "Key[ImportedKeypoints]":
        """Imported keypoints."""
        return Key(Kind.IMPORTED_KEYPOINTS, operator.index(frame), camera)

    @staticmethod
    def imported_labels() -> "Key[ImportedLabels]":
        """Label names of imported masks."""
        return Key(Kind.IMPORTED_LABELS, WHOLE_PROJECT, "")

    @staticmethod
    def keyframe(frame: int) -> "Key[Keyframe]":
        """User's choice whether a frame is a keyframe."""
        return Key(Kind.KEYFRAME, operator.index(frame), "")

    @staticmethod
    def review(frame: int) -> "Key[Review]":
        """Review state and note of a frame."""
        return Key(Kind.REVIEW, operator.index(frame), "")

    @staticmethod
    def verdict(frame: int) -> "Key[FitVerdict]":
        """Verdict on a frame's fit."""
        return Key(Kind.VERDICT, operator.index(frame), "")

    @staticmethod
    def base_frame(arm: str) -> "Key[CorrectedTransform]":
        """`T_world_base` of an arm, in all frames."""
        return Key(Kind.BASE_FRAME, WHOLE_PROJECT, arm)

    @staticmethod
    def extrinsics(camera: str) -> "Key[CorrectedTransform]":
        """`T_camera_world` of a camera, in all frames."""
        return Key(Kind.EXTRINSICS, WHOLE_PROJECT, camera)

    @staticmethod
    def intrinsics(camera: str) -> "Key[CorrectedIntrinsics]":
        """Intrinsics of a camera, in all frames."""
        return Key(Kind.INTRINSICS, WHOLE_PROJECT, camera)

    @staticmethod
    def time_offset() -> "Key[TimeOffset]":
        """Time offset between images and kinematics, in all frames."""
        return Key(Kind.TIME_OFFSET, WHOLE_PROJECT, "")


Edits = Mapping[Key[Any], Any]
"""Edits of one step: key -> new value, or None to restore the value of the sequence."""


def decode(kind: Kind, stored: str | bytes | None) -> Any:
    """Decode a stored value of the given kind; `ValueError`, `TypeError` or `ProjectError` if it is invalid."""
    if stored is None:
        return None
    return _decoded_mark(kind, stored) if kind in _MARKS else VALUE_TYPES[kind].decode(stored)


@lru_cache(maxsize=1024)
def _decoded_mark(kind: Kind, stored: str | bytes) -> Any:
    """Decode and intern marks, so that equal values of many frames share one object."""
    return VALUE_TYPES[kind].decode(stored)


def check_edit(identity: SequenceIdentity, key: Key[Any], value: object) -> None:
    """Check that a key matches the sequence and the value matches the key; `ProjectError` otherwise."""
    frames = len(identity.frame_ids)
    if key.kind in _OF_FRAME and not 0 <= key.frame < frames:
        raise ProjectError(f"the sequence has no frame number {key.frame}; its frames are 0 to {frames - 1}.")
    if key.kind not in _OF_FRAME and key.frame != WHOLE_PROJECT:
        raise ProjectError(f"{key.kind} applies to all frames, so no frame can be given ({key.frame}).")
    if key.kind in _OF_NOBODY:
        if key.name:
            raise ProjectError(f"{key.kind} belongs to no arm or camera, so no name can be given ({key.name!r}).")
    elif key.name not in (known := identity.arms if key.kind in _OF_ARM else identity.cameras):
        what = "arm" if key.kind in _OF_ARM else "camera"
        there = f"its {what}s are: {', '.join(known)}"
        raise ProjectError(f"the sequence has no {what} {key.name!r} for {key.kind}; {there}.")
    if value is not None:
        _check_value(identity, key, value)


def _check_value(identity: SequenceIdentity, key: Key[Any], value: object) -> None:
    expected = VALUE_TYPES[key.kind]
    if not isinstance(value, expected):
        raise ProjectError(f"{key.kind} must be a {expected.__name__}, not a {type(value).__name__}.")
    if isinstance(value, JointCorrection) and len(value.joint_positions) != len(identity.arms[key.name]):
        raise ProjectError(
            f"arm {key.name!r} has {len(identity.arms[key.name])} joints ({', '.join(identity.arms[key.name])}), "
            f"but {len(value.joint_positions)} joint positions were given."
        )
    if isinstance(value, Layer) and value.size != identity.cameras[key.name]:
        given, wanted = (" x ".join(map(str, size)) for size in (value.size, identity.cameras[key.name]))
        raise ProjectError(f"the layer has {given} pixels, but images of camera {key.name!r} have {wanted}.")
