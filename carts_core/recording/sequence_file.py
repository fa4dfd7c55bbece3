"""Sequence files: reading and validation, and writing of a copy with another calibration."""

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from ..errors import RobotError, SequenceError, SettingsError
from ..files.reading import SEQUENCE, VALUES, is_regular, parse_json, read_text
from ..model.camera import (
    FARTHEST,
    HALF_PIXEL,
    PIXEL_CENTERS,
    Camera,
    implausible_intrinsics,
    pinhole_intrinsics,
    rigid_transform,
    unusual_tangential,
)
from ..model.instruments import SCHEME, robot_file
from ..model.robot import Robot
from ..model.scene import Arm, Light, Scene
from ..wording import closest, counted, listed, shown
from .frame_list import FrameList, check_present, escaped, expand, frame_files, is_glob, is_per_frame, numbers_of_frames
from .image_sources import VIDEO_SUFFIXES, BagImages, Cropped
from .images import DEPTHS, ImageFiles, ImageSource, mask_remarks
from .kinematics_table import take_joints
from .matching import Rows, Samples, TimeMatching, take_camera_motion, take_rows
from .toml_table import TomlTable, check_file_name, read_toml


def take_value(table: TomlTable, key: str, default: Any) -> Any:
    """Read the value of `key`; a string `file.json#a/b` refers to the value under `a`, `b` in that JSON file."""
    value = table.take(key, object, default)
    if not isinstance(value, str):
        return value
    file_name, mark, pointer = value.rpartition("#")
    if not mark or not pointer:
        raise table.error(
            key, f'is {shown(value)}. Write the numbers here, or "file.json#name" to read them from a file.'
        )
    path = table.path(file_name)
    try:
        found = parse_json(read_text(path, VALUES))
    except FileNotFoundError as error:
        raise table.error(key, f"points at {path}, which is missing. Correct the path.") from error
    except (OSError, ValueError) as error:
        raise table.error(key, f"points at {path}, which is not a readable JSON file: {error}.") from error
    for name in pointer.strip("/").split("/"):
        if isinstance(found, list) and name.isdigit() and int(name) < len(found):
            found = found[int(name)]
        elif isinstance(found, dict) and name in found:
            found = found[name]
        else:
            names = list(found) if isinstance(found, dict) else []
            raise table.error(
                key,
                f"points at {name!r}, which {path} does not have.{closest(name, names)} "
                f"It has: {listed(names) or 'no names'}.",
            )
    return found


def take_transform(table: TomlTable, key: str, default: Any) -> np.ndarray:
    """Read a rigid transform [4, 4], translation in [m]."""
    value = take_value(table, key, default)
    try:
        return rigid_transform(value, table.name(key))
    except SettingsError as error:
        raise SequenceError(str(error)) from error


def take_camera(table: TomlTable) -> Camera:
    """Read the camera of a `[[cameras]]` table."""
    name = table.take("name", str)
    size = take_value(table, "size", [])
    if not (isinstance(size, list) and len(size) == 2 and all(isinstance(value, int) and value > 0 for value in size)):
        raise table.error("size", f"is {shown(size)}. Give [width, height] in whole pixels, such as size = [640, 480].")
    width, height = size
    intrinsics = _take_intrinsics(table)
    distortion = take_value(table, "distortion", [])
    if not isinstance(distortion, list) or not all(_is_number(value) for value in distortion):
        raise table.error(
            "distortion", f"is {shown(distortion)}. Give a list of 0, 4, 5, 8, 12 or 14 numbers: k1 k2 p1 p2 k3 ..."
        )
    T_camera_world = take_transform(table, "T_camera_world", np.eye(4).tolist())
    try:
        return Camera(name, width, height, intrinsics, T_camera_world, tuple(float(value) for value in distortion))
    except SettingsError as error:
        raise SequenceError(f"{table.file}: {table.where}: {error}") from error


def _take_intrinsics(table: TomlTable) -> tuple[float, float, float, float]:
    K = take_value(table, "K", None)
    if isinstance(K, dict) and sorted(K) == ["cx", "cy", "fx", "fy"] and all(_is_number(value) for value in K.values()):
        fx, fy, cx, cy = (float(K[key]) for key in ("fx", "fy", "cx", "cy"))
    else:
        try:
            matrix = np.array(K, dtype=np.float64)
        except (TypeError, ValueError):
            matrix = np.empty(0)
        if matrix.shape != (3, 3):
            raise table.error(
                "K", f"is {shown(K)}. Give 3 rows of 3 numbers, or {{ fx = ..., fy = ..., cx = ..., cy = ... }}."
            )
        fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
        if not np.allclose(matrix, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], atol=1e-6 * abs(fx)):
            raise table.error(
                "K",
                f"is {shown(K)}, but must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], without skew and not transposed.",
            )
    center = table.take("pixel_center", float, HALF_PIXEL)
    if center not in PIXEL_CENTERS:
        raise table.error(
            "pixel_center", f"is {center!r}, but must be 0.5 (carts) or 0.0 (OpenCV, ROS, MATLAB minus 1)."
        )
    try:
        return pinhole_intrinsics((fx, fy, cx, cy), center, table.name("K"))
    except SettingsError as error:
        raise SequenceError(str(error)) from error


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@dataclass(frozen=True)
class CameraInput:
    """Camera with its images, masks and backgrounds by domain."""

    camera: Camera
    images: Mapping[str, ImageSource]
    masks: Mapping[str, tuple[Path | None, ...]]
    """Domain -> mask file of each frame, None for frames without a mask; empty for a camera without masks."""
    background: Mapping[str, Path]
    motion: Samples | None
    """Poses of the camera mount; None for a static camera."""
    missing: frozenset[int] = frozenset()
    """Frames without an image in some domain."""

    def select(self, kept: Sequence[int]) -> "CameraInput":
        """The camera with the images and masks of these frames."""
        return replace(
            self,
            images={domain: source.select(kept) for domain, source in self.images.items()},
            masks={domain: tuple(files[index] for index in kept) for domain, files in self.masks.items()},
            missing=frozenset(place for place, index in enumerate(kept) if index in self.missing),
        )

    def remarks(self) -> tuple[str, ...]:
        """Remarks on changes to images and masks before they are used, and on unusual calibrations."""
        camera = self.camera
        files = {file: None for domain in self.masks.values() for file in domain if file is not None}
        found: list[str] = []
        for source in self.images.values():
            with suppress(SequenceError):  # The error is raised when the image is read.
                found += source.remarks()
        found += mask_remarks(list(files))
        unusual = implausible_intrinsics(camera.width, camera.height, camera.intrinsics, camera.distortion)
        found += [f"its calibration has {unusual}. Check `size`, `K` and `distortion`."] if unusual else []
        tangential = unusual_tangential(camera.distortion)
        found += [f"its calibration has {tangential}."] if tangential else []
        return tuple(dict.fromkeys(f"{camera.name}: {text}" for text in found))


def take_camera_input(table: TomlTable, rows: Rows, domains: tuple[str, ...]) -> CameraInput:
    """Read a `[[cameras]]` table: camera, images, masks and motion; all files must exist."""
    camera, frames = take_camera(table), rows.frames
    motion = take_camera_motion(table, rows)
    patterns = _by_domain(table, "images", domains, required=True)
    images = {domain: _images(table, pattern, frames, domain, camera.name) for domain, pattern in patterns.items()}
    missing = frozenset(
        index for source in images.values() if isinstance(source, ImageFiles) for index in source.missing
    )
    if len(missing) == len(frames.frame_ids):
        raise table.error("sparse_images", "is true, but no frame has an image in all domains. Correct `images`.")
    patterns, sparse = _by_domain(table, "masks", domains), table.take("sparse_masks", bool, False)
    masks = {name: _masks(table, pattern, frames, name, camera.name, sparse) for name, pattern in patterns.items()}
    background: dict[str, Path] = {}
    for domain, pattern in _by_domain(table, "background", domains).items():
        path = _path(table, "background", pattern, domain, camera.name)
        if not is_regular(path):
            raise table.error("background", f"points at {path}, which is missing. Correct the path or remove the key.")
        background[domain] = path
    if background and motion is not None:
        raise table.error("background", "cannot be combined with `motion`: the background then differs between frames.")
    table.finish()
    return CameraInput(camera, images, masks, background, motion, missing)


def _path(table: TomlTable, key: str, pattern: str, domain: str, camera: str) -> Path:
    """Path from a pattern without frames."""
    return table.path(expand(pattern, table.name(key), domain=domain, camera=camera))


def _by_domain(table: TomlTable, key: str, domains: tuple[str, ...], required: bool = False) -> dict[str, str]:
    """Domain -> pattern. A string applies to all domains; a table has one pattern per domain."""
    value = table.take(key, (str, dict)) if required else table.take(key, (str, dict), {})
    if isinstance(value, str):
        if required and len(domains) > 1 and "{domain" not in value:
            raise table.error(
                key,
                f"is {value!r} for all {len(domains)} domains. Add {{domain}}, or give each one a pattern.",
            )
        return dict.fromkeys(domains, value)
    for domain, pattern in value.items():
        if domain not in domains:
            raise table.error(
                f"{key}.{domain}",
                f"is for an unknown domain.{closest(domain, domains)} "
                f"`domains` at the top of the file lists: {', '.join(domains)}.",
            )
        if not isinstance(pattern, str):
            raise table.error(f"{key}.{domain}", f"is {pattern!r}, but must be text.")
    if required and (missing := [domain for domain in domains if domain not in value]):
        raise table.error(key, f"is missing for: {', '.join(missing)}. Give every domain a pattern.")
    return dict(value)


def _images(table: TomlTable, pattern: str, frames: FrameList, domain: str, camera: str) -> ImageSource:
    source = _whole_images(table, pattern, frames, domain, camera)
    crop = table.take("crop", list, [])
    if not crop:
        return source
    if isinstance(source, ImageFiles) and source.missing:
        raise table.error("sparse_images", "cannot be combined with `crop`. Remove the frames without images.")
    if len(crop) != 4 or not all(isinstance(value, int) and value >= 0 for value in crop) or min(crop[2:]) < 1:
        raise table.error("crop", f"is {crop!r}. Give [left, top, width, height] in whole pixels.")
    return Cropped(source, (crop[0], crop[1], crop[2], crop[3]))


def _whole_images(table: TomlTable, pattern: str, frames: FrameList, domain: str, camera: str) -> ImageSource:
    key = table.name("images")
    topic, numbers = table.take("topic", str, ""), frames.video_frames
    message_time, video_frame = table.take("message_time", str, ""), table.take("video_frame", str, "")
    bits = table.take("bits", int, None)
    if bits is not None and bits not in DEPTHS:
        raise table.error("bits", f"is {bits}. Give the bit depth of the images: {', '.join(map(str, DEPTHS))}.")
    deinterlace, sparse = table.take("deinterlace", bool, True), table.take("sparse_images", bool, False)
    if topic:
        path = _path(table, "images", pattern, domain, camera)
        return BagImages(path, topic, _message_times(table, message_time, frames))
    if video_frame:
        if frames.table is None:
            raise table.error("video_frame", "names a column, but [frames] has no table. Name the frames in a table.")
        numbers = numbers_of_frames(frames.table, video_frame, table.name("video_frame"))
    if not is_per_frame(pattern) and not is_glob(pattern):
        path = _path(table, "images", pattern, domain, camera)
        if path.suffix.lower() not in VIDEO_SUFFIXES:
            raise table.error(
                "images",
                f"is {pattern!r}, which is the same for every frame. Add {{frame}}, or name a video "
                f"({', '.join(VIDEO_SUFFIXES)}).",
            )
        from .video import Video  # noqa: PLC0415  It imports PyAV.

        return Video(path, numbers, deinterlace=deinterlace)
    files = frame_files(table.file.parent, pattern, key, frames, domain=domain, camera=camera)
    if sparse:
        return ImageFiles(files, bits, frozenset(i for i, file in enumerate(files) if not is_regular(file)))
    check_present(key, files, frames, " If a camera has no image of some frames, set sparse_images = true.")
    return ImageFiles(files, bits)


def _message_times(table: TomlTable, column: str, frames: FrameList) -> tuple[int, ...]:
    if frames.table is None or not column:
        raise table.error("message_time", "is missing: with `topic`, name the column of the table with times [ns].")
    cells = frames.table.text(column, table.name("message_time"))
    for row, cell in enumerate(cells):
        if not cell.isdecimal():
            raise frames.table.error(f", column {column!r}: {cell!r} is not a time [ns].", row)
    return tuple(map(int, cells))


def _masks(
    table: TomlTable, pattern: str, frames: FrameList, domain: str, camera: str, sparse: bool
) -> tuple[Path | None, ...]:
    key = table.name("masks")
    if not is_per_frame(pattern) and not is_glob(pattern):
        raise table.error("masks", f"is {pattern!r}, which is the same for every frame. Add {{frame}}.")
    files = frame_files(table.file.parent, pattern, key, frames, domain=domain, camera=camera)
    if sparse and any(is_regular(file) for file in files):
        return tuple(file if is_regular(file) else None for file in files)
    check_present(key, files, frames, " If only some frames have masks, set sparse_masks = true.")
    return files


FORMAT = "carts-sequence/1"
"""Required value of the key `format`."""

_BRIGHTEST = 1e3
"""Maximum value of the numeric keys of `[light]`."""


@dataclass(frozen=True)
class ArmInput:
    """Arm and its joint positions."""

    arm: Arm
    measured_joints: tuple[str, ...]
    measured: Samples
    truth: Samples | None

    def without_time_offset(self) -> "ArmInput":
        """The arm with all rows in the clock of `[kinematics]`."""
        truth = None if self.truth is None else replace(self.truth, time_offset=0.0)
        return replace(self, measured=replace(self.measured, time_offset=0.0), truth=truth)


@dataclass(frozen=True)
class Description:
    """Checked content of a sequence file."""

    path: Path
    name: str
    scene: Scene
    domains: tuple[str, ...]
    frames: FrameList
    matching: TimeMatching | None
    """Matching of rows and frames by time; None if each row of the tables is a frame."""
    cameras: Mapping[str, CameraInput]
    arms: Mapping[str, ArmInput]
    remarks: tuple[str, ...] = ()
    """Remarks on changes to images and masks before they are used, on unusual calibrations, on robots, and on omitted
    frames."""
    recording: Path | None = None
    """File or folder of the foreign recording that was imported; None if not stated. It need not exist."""

    def has_missing_rows(self, matching: TimeMatching, arm_offsets: Mapping[str, float] | None = None) -> np.ndarray:
        """Whether a frame lacks rows of an arm or a moving camera; [frames].

        Args:
            matching: matching by time.
            arm_offsets: arm -> time offset [s], instead of its own.
        """
        samples = [camera.motion for camera in self.cameras.values()]
        for name, arm in self.arms.items():
            offset = (arm_offsets or {}).get(name, arm.measured.time_offset)
            samples += [one and replace(one, time_offset=offset) for one in (arm.measured, arm.truth)]
        return np.any([one.is_missing(self.frames, matching) for one in samples if one is not None], axis=0)


def read_description(path: Path, progress: Callable[[str], None] | None = None) -> Description:
    """Read a sequence file and the files it refers to, except images."""
    root = read_toml(path)
    root.take_choice("format", (FORMAT,), "(none)")
    name = root.take("name", str, path.stem)
    check_file_name(root, "name", "is", name)
    root.take("description", str, "")
    recording = root.take("recording", str, None)
    recording = None if recording is None else root.path(recording)
    domains = _take_domains(root)
    frames_section = root.take_table("frames") if "frames" in root else None
    rows = take_rows(root.take_table("kinematics"), frames_section)
    light = _take_light(root.take_table("light"))
    robots: dict[tuple[Path, str | None], Robot] = {}
    arms = [_take_arm(table, rows, robots, progress) for table in root.take_tables("arms")]
    cameras = [take_camera_input(table, rows, domains) for table in root.take_tables("cameras")]
    root.finish()
    scene = Scene(tuple(entry.arm for entry in arms), tuple(entry.camera for entry in cameras), light)
    remarks = tuple(remark for camera in cameras for remark in camera.remarks())
    remarks += tuple(dict.fromkeys(f"{robot.name}: {text}" for robot in robots.values() for text in robot.remarks))
    if progress is not None:
        for remark in remarks:
            progress(f"note: {remark}")
    by_name = {entry.camera.name: entry for entry in cameras}, {entry.arm.name: entry for entry in arms}
    found = Description(path, name, scene, domains, rows.frames, rows.matching, *by_name, remarks, recording)
    return _without_missing_rows(found)


def _without_missing_rows(found: Description) -> Description:
    """Description without the frames that lack rows, if they are to be left out."""
    if found.matching is None or found.matching.missing_rows == "error":
        return found
    missing = found.has_missing_rows(found.matching)
    if not missing.any():
        return found
    if missing.all():
        raise SequenceError(
            f"{found.path}: no frame has rows within {found.matching.max_gap:g} s. Correct `time_offset` in [frames]."
        )
    kept = np.flatnonzero(~missing).tolist()
    text = f"{int(missing.sum())} of {counted(len(missing), 'frame')} are left out: no rows at their times."
    return replace(
        found,
        frames=found.frames.select(kept),
        cameras={name: camera.select(kept) for name, camera in found.cameras.items()},
        remarks=(*found.remarks, text),
    )


def _take_domains(root: TomlTable) -> tuple[str, ...]:
    domains = root.take("domains", list, ["regular"])
    if not domains or not all(isinstance(domain, str) and domain for domain in domains):
        raise root.error("domains", f'is {shown(domains)}. Give names, such as domains = ["regular", "smoke"].')
    if len(set(domains)) < len(domains):
        raise root.error("domains", f"has a name twice: {', '.join(domains)}.")
    for domain in domains:
        check_file_name(root, "domains", "has", domain)
    return tuple(domains)


def _take_light(table: TomlTable) -> Light:
    values: dict[str, Any] = {}
    for setting in fields(Light):
        kind = list if setting.name == "position" else float
        value = table.take(setting.name, kind, None)
        if value is not None:
            values[setting.name] = tuple(value) if kind is list else float(value)
    table.finish()
    position = values.get("position", (0.0, 0.0, 0.0))
    if len(position) != 3 or not all(isinstance(value, int | float) and abs(value) <= FARTHEST for value in position):
        raise table.error("position", f"must be three numbers [m] of at most {FARTHEST:g}, in the camera frame.")
    for key, value in values.items():
        if key != "position" and not 0.0 <= value <= _BRIGHTEST:
            raise table.error(key, f"is {value:g}, but must be 0 to {_BRIGHTEST:g}.")
    return Light(**values)


def _take_arm(
    table: TomlTable, rows: Rows, robots: dict[tuple[Path, str | None], Robot], progress: Callable[[str], None] | None
) -> ArmInput:
    name = table.take("name", str)
    value = table.take("robot", str)
    try:
        urdf = robot_file(value) if value.startswith(SCHEME) else table.path(value)
    except RobotError as error:
        raise table.error("robot", f"is unknown: {error}") from error
    base_link = table.take("base_link", str, None)
    if (key := (urdf.resolve(), base_link)) not in robots:
        robots[key] = Robot.load(urdf, base_link=base_link, progress=progress)
    robot = robots[key]
    T_world_base = take_transform(table, "T_world_base", np.eye(4).tolist())
    columns = take_joints(table, robot)
    measured, truth = rows.measured_of(table, columns), rows.truth_of(table, columns)
    table.finish()
    return ArmInput(Arm(name, robot, T_world_base), columns.measured, measured, truth)


def calibrated_sequence_file(
    path: Path,
    folder: Path,
    before: Scene,
    after: Scene,
    command: str = "calibrate",
    time_offsets: Mapping[str, float] | None = None,
    *,
    omit: bool = False,
) -> str:
    """Content of a copy of a sequence file for another folder, with another calibration.

    Differences between the scenes are written as numbers. All other content is kept, including comments, and relative
    paths are adapted to the new folder.

    Args:
        before: the scene that `path` describes.
        after: the same scene with other base frames, extrinsics or intrinsics.
        command: the `carts` command that estimated them, for the heading.
        time_offsets: new values of `time_offset` [s]: of `[frames]` under the empty name, and of arms.
        omit: leave out frames without rows at these offsets.
    """
    document: dict[str, Any] = tomlkit.parse(read_text(path, SEQUENCE))
    source, target = path.parent.resolve(), folder.resolve()

    def relocate(value: str, pattern: bool) -> str:
        if os.path.isabs(value):
            return value
        text = escaped if pattern else str
        return Path(os.path.relpath(os.path.join(text(source), value), text(target))).as_posix()

    def move(table: dict[str, Any], *keys: str, patterns: bool = False) -> None:
        for key in keys:
            value = table.get(key)
            if isinstance(value, str):
                table[key] = relocate(value, patterns)
            elif isinstance(value, dict):
                # The value is a table of patterns by domain, or K as a table of numbers.
                for name, entry in value.items():
                    value[name] = relocate(entry, patterns) if isinstance(entry, str) else entry

    move(document, "recording")
    move(document["kinematics"], "table", "truth")
    move(document.get("frames", {}), "table", "video")
    offsets = time_offsets or {}
    if "" in offsets:
        document["frames"]["time_offset"] = offsets[""]
    if omit:
        document["frames"]["missing_rows"] = "omit"
    for table, old, new in zip(document["arms"], before.arms, after.arms, strict=True):
        move(table, "table", "truth", "T_world_base")
        if not table["robot"].startswith(SCHEME):
            move(table, "robot")
        if table["name"] in offsets:
            table["time_offset"] = offsets[table["name"]]
        if not np.array_equal(old.T_world_base, new.T_world_base):
            table["T_world_base"] = _matrix(new.T_world_base)
    for table, old, new in zip(document["cameras"], before.cameras, after.cameras, strict=True):
        move(table, "images", "masks", "background", patterns=True)
        move(table, "size", "K", "distortion", "T_camera_world")
        if isinstance(table.get("motion"), dict):
            move(table["motion"], "table")
        else:
            move(table, "motion")
        if not np.array_equal(old.T_camera_world, new.T_camera_world):
            table["T_camera_world"] = _matrix(new.T_camera_world)
        if old.intrinsics != new.intrinsics:
            table["K"] = dict(zip(("fx", "fy", "cx", "cy"), new.intrinsics, strict=True))
            table["pixel_center"] = HALF_PIXEL
    heading = f"# With the results of carts {command}. Other comments are from the original file."
    return f"{heading}\n{tomlkit.dumps(document)}"


def _matrix(values: np.ndarray) -> Any:
    # Adding 0 turns -0.0 into 0.0.
    return tomlkit.item((np.round(values, 12) + 0.0).tolist()).multiline(True)  # pyright: ignore
