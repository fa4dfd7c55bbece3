"""Settings of imports and exports."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from ..errors import SettingsError

Clock = Literal["s", "ms", "us", "ns"]
AngleUnit = Literal["rad", "deg", "percent"]
LengthUnit = Literal["m", "dm", "cm", "mm"]
Axes = Literal["opencv", "dvrk"]
"""Camera axes: x right, y down (OpenCV), or x left, y up (dVRK); z is the viewing direction in both."""

AnnotationFormat = Literal["coco", "cvat", "label-studio", "labelme", "masks", "surgpose", "yolo"]
"""Formats of imported annotations; X-AnyLabeling is an extension of LabelMe, and `masks` a folder of mask images."""
ANNOTATION_FORMATS: dict[AnnotationFormat, str] = {
    "coco": "COCO",
    "cvat": "CVAT for images",
    "label-studio": "Label Studio",
    "labelme": "LabelMe",
    "masks": "a folder of masks",
    "surgpose": "keypoints of SurgPose",
    "yolo": "YOLO",
}
"""Format -> name in texts."""

DrawnOn = Literal["recorded", "undistorted"]
"""Images that annotations were drawn on: recorded ones, with the camera's distortion, or undistorted ones."""

NO_TABLE = Path("none")
"""Value of `kinematics` for images without joint data."""
SECONDS: Mapping[Clock, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


@dataclass(frozen=True)
class ImportOptions:
    """Options of an import, for information that is missing from the recording."""

    source: str | None = None
    """Source format (listed by `carts import` without arguments); detected by default."""
    images: Mapping[str, str] = field(default_factory=dict)
    """Camera -> images: a folder, a video, or a topic of the bag."""
    calibration: Mapping[str, Path] = field(default_factory=dict)
    """Camera -> calibration file (ROS, OpenCV or Kalibr YAML, JSON, MATLAB .mat)."""
    calibration_size: Mapping[str, str] = field(default_factory=dict)
    """Camera -> size of the images used for calibration, such as 640x480, if the calibration file does not contain
    it."""
    kinematics: Path | None = None
    """Table of joint positions or tip poses (CSV, Parquet, NPY); `none` to import only images."""
    columns: Mapping[str, str] = field(default_factory=dict)
    """Joint, `time` or `frame` -> column of the table."""
    angle_unit: AngleUnit | None = None
    """Unit of angles; `percent` is -100 to 100 over the range of each joint."""
    length_unit: LengthUnit | None = None
    """Unit of lengths."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Joint -> unit, if it differs from the unit of the other joints."""
    flip: tuple[str, ...] = ()
    """Joints with inverted sign."""
    clock: Clock | None = None
    """Unit of the table's times."""
    time_offset: float | None = None
    """Kinematics time minus image time [s]; by default estimated from the motion in the images where possible."""
    arm_time_offset: Mapping[str, float] = field(default_factory=dict)
    """Arm -> time offset in addition to that of all tables [s]."""
    frame_rate: float | None = None
    """Frame rate of images without times, or replacement of a video's constant rate [1/s]."""
    row_rate: float | None = None
    """Rate of table rows without times [1/s]; the first row is assigned to the first image, up to the time offset."""
    arms: Mapping[str, str] = field(default_factory=dict)
    """Arm -> name in the recording; other arms are not imported."""
    robot: Mapping[str, str] = field(default_factory=dict)
    """Arm -> robot: a URDF, or `builtin:NAME`; `builtin:psm_lnd` by default."""
    wrist_length: float | None = None
    """Distance between the wrist pitch and yaw axes [m], for inverse kinematics; by default that of the instrument
    identified from the recording, else 0.0091."""
    tool_point: float | None = None
    """Distance along the tool from the dVRK's tip frame to the point described by tip poses [m]; estimated by
    default."""
    base: Mapping[str, Path] = field(default_factory=dict)
    """Arm -> registration, configuration or set-up joint file of the dVRK that contains its base frame."""
    axes: Axes | None = None
    """Camera axes in these files, if not stated there."""

    def __post_init__(self) -> None:
        for camera, size in self.calibration_size.items():
            if not re.fullmatch(r"[1-9]\d{0,5}[xX][1-9]\d{0,5}", size):
                raise SettingsError(
                    f"calibration_size of {camera} is {size!r}; give width and height, such as 640x480."
                )
        offsets = [(f"arm_time_offset of {arm}", seconds) for arm, seconds in self.arm_time_offset.items()]
        for name, value in (("time_offset", self.time_offset), *offsets):
            if value is not None and not math.isfinite(value):
                raise SettingsError(f"{name} is {value}; give a finite number.")
        for name, rate, largest in (("frame_rate", self.frame_rate, 1e3), ("row_rate", self.row_rate, 1e4)):
            if rate is not None and not 0.01 <= rate <= largest:
                raise SettingsError(f"{name} is {rate:g}; allowed: 0.01 to {largest:g} per second.")
        for joint, unit in self.units.items():
            if unit not in (*get_args(AngleUnit), *get_args(LengthUnit)):
                allowed = ", ".join((*get_args(AngleUnit), *get_args(LengthUnit)))
                raise SettingsError(f"the unit of {joint} is {unit!r}; allowed: {allowed}.")


FormatName = Literal[
    "masks",
    "coco",
    "coco-keypoints",
    "bop",
    "yolo",
    "voc",
    "cvat",
    "datumaro",
    "csv",
    "npz",
    "json",
    "dvrk",
    "dvrk-2.3",
    "dvrk-suj",
    "video",
    "rosbag2",
    "lerobot",
    "surgsync",
    "recorded-csv",
]
"""Names of the export formats."""

Parts = Literal["arms", "parts", "links"]
"""Categories: one per arm, per part (shaft, wrist, jaws), or per link."""

Masks = Literal["auto", "refined", "rendered"]
"""Masks of an export: rendered at the corrected pose, or refined near their outline by the network; `auto` refines the
masks of frames with the verdict *good*."""

Images = Literal["named", "copied", "none"]
"""Images of an export: `named` refers to the recording's files, `copied` writes byte-identical copies, `none` writes no
images."""
