"""What an edit may be about: a key names one value of the project, and says of which type it is."""

import operator
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from typing import Any, Generic, TypeVar

from ..errors import ProjectError
from .identity import SequenceIdentity
from .layers import IgnoreRegion, ImportedMask, Layer, MaskCorrection, PartLabels
from .values import (
    CorrectedIntrinsics,
    CorrectedTransform,
    FitVerdict,
    ImportedKeypoints,
    ImportedLabels,
    JointCorrection,
    Keyframe,
    Review,
    TimeOffset,
)

V_co = TypeVar("V_co", covariant=True)

WHOLE_PROJECT = -1
"""In place of a frame's index, where a value holds for all frames."""


class Kind(StrEnum):
    """What a value is."""

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
"""Kinds of what holds for all frames, and on which depends where their arms are."""
_OF_ARM = {Kind.JOINTS, Kind.BASE_FRAME}
_MARKS = {Kind.KEYFRAME, Kind.REVIEW, Kind.VERDICT}
_IMPORTED = {Kind.IMPORTED_MASK, Kind.IMPORTED_KEYPOINTS}
_PAINTED = {Kind.MASK_CORRECTION, Kind.IGNORE_REGION, Kind.PART_LABELS}
_OF_FRAME = {Kind.JOINTS, *_PAINTED, *_IMPORTED, *_MARKS}
_OF_NOBODY = {*_MARKS, Kind.TIME_OFFSET, Kind.IMPORTED_LABELS}


@dataclass(frozen=True)
class Key(Generic[V_co]):
    """The name of one value. Made by its static methods, which know the value's type."""

    kind: Kind
    frame: int
    """Index of the frame, or `WHOLE_PROJECT`."""
    name: str
    """Arm or camera, or nothing."""

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
        """Pixels where something hides the arms."""
        return Key(Kind.IGNORE_REGION, operator.index(frame), camera)

    @staticmethod
    def part_labels(frame: int, camera: str) -> "Key[PartLabels]":
        """Classes that a person gave to pixels."""
        return Key(Kind.PART_LABELS, operator.index(frame), camera)

    @staticmethod
    def imported_mask(frame: int, camera: str) -> "Key[ImportedMask]":
        """Labels that others gave to pixels."""
        return Key(Kind.IMPORTED_MASK, operator.index(frame), camera)

    @staticmethod
    def imported_keypoints(frame: int, camera: str) -> "Key[ImportedKeypoints]":
        """Points that others marked."""
        return Key(Kind.IMPORTED_KEYPOINTS, operator.index(frame), camera)

    @staticmethod
    def imported_labels() -> "Key[ImportedLabels]":
        """What the numbers in imported masks mean."""
        return Key(Kind.IMPORTED_LABELS, WHOLE_PROJECT, "")

    @staticmethod
    def keyframe(frame: int) -> "Key[Keyframe]":
        """Whether a person made the frame a keyframe, or made it none."""
        return Key(Kind.KEYFRAME, operator.index(frame), "")

    @staticmethod
    def review(frame: int) -> "Key[Review]":
        """Review state and note of a frame."""
        return Key(Kind.REVIEW, operator.index(frame), "")

    @staticmethod
    def verdict(frame: int) -> "Key[FitVerdict]":
        """What the image says of a frame's fit."""
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
        """How far the clocks of images and kinematics are apart, in all frames."""
        return Key(Kind.TIME_OFFSET, WHOLE_PROJECT, "")


Edits = Mapping[Key[Any], Any]
"""What one gesture changes: key -> new value, or None to go back to what the sequence says."""


def decode(kind: Kind, stored: str | bytes | None) -> Any:
    """The value that a project file keeps under a key of this kind.

    Raises:
        ValueError, TypeError, ProjectError: it is something else.
    """
    if stored is None:
        return None
    return _decoded_mark(kind, stored) if kind in _MARKS else VALUE_TYPES[kind].decode(stored)


@lru_cache(maxsize=1024)
def _decoded_mark(kind: Kind, stored: str | bytes) -> Any:
    """One object for all frames of which the same is said."""
    return VALUE_TYPES[kind].decode(stored)


def check_edit(identity: SequenceIdentity, key: Key[Any], value: object) -> None:
    """Check that a key names something of the sequence, and that the value fits it.

    Raises:
        ProjectError: it does not.
    """
    frames = len(identity.frame_ids)
    if key.kind in _OF_FRAME and not 0 <= key.frame < frames:
        raise ProjectError(f"the sequence has no frame number {key.frame}; its frames are 0 to {frames - 1}.")
    if key.kind not in _OF_FRAME and key.frame != WHOLE_PROJECT:
        raise ProjectError(f"{key.kind} holds for all frames, so it has no frame {key.frame}.")
    if key.kind in _OF_NOBODY:
        known = [""]
    else:
        known = list(identity.arms if key.kind in _OF_ARM else identity.cameras)
    if key.name not in known:
        what = "arm" if key.kind in _OF_ARM else "camera"
        raise ProjectError(f"the sequence has no {what} {key.name!r} for {key.kind}; there are: {', '.join(known)}.")
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
        raise ProjectError(f"the layer is {given} pixels, but images of camera {key.name!r} are {wanted}.")
