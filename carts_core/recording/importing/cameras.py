"""Cameras of foreign recordings: folders of images, videos, and their calibrations."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ...errors import SequenceError
from ...model.camera import implausible_intrinsics, unusual_tangential
from ..image_sources import VIDEO_SUFFIXES
from ..images import ImageFiles, bits_remark, image_remarks, is_deep
from ..video import Video, index_video
from .calibrations import Calibration, calibration_from_info, read_calibration
from .found import FoundCamera, Import, PartError

_BASELINES = 1e-3, 0.1
"""Usual distances between the cameras of a stereo endoscope [m]."""
_SAME_SHAPE = 0.01
"""Maximum difference of aspect ratios due to rounding of image sizes [1]."""


def side_of(name: str) -> str | None:
    """Side of a camera, from the name of its topic or folder; None if it contains neither `left` nor `right`, nor a
    short form such as `l`."""
    words = re.split(r"[^a-z0-9]+", re.sub(r"([a-z])([A-Z])", r"\1_\2", name).lower())
    for side in ("left", "right"):
        short = (side, f"{side}s", f"{side}img", f"img{side}", f"camera{side[0]}", f"cam{side[0]}", f"l{side}")
        if any(word in short or word.startswith(side) for word in words):
            return side
    endings = {"l": "left", "r": "right"}
    found = [endings[word] for word in words if word in endings]
    return found[-1] if found else None


def camera_from_info(camera: FoundCamera, info: Any, job: Import) -> FoundCamera:
    """Copy of a camera with the calibration of a `sensor_msgs/CameraInfo`; unchanged if `info` is None or
    uncalibrated."""
    what = f"camera_info of {camera.name}"
    try:
        found = None if info is None else calibration_from_info(info)
    except ValueError as error:
        remedy = f"Give another one: --calibration {camera.name} FILE."
        raise PartError("calibration", f"{what} cannot be used: {error}.", remedy, about=camera.name) from error
    return camera if found is None else _calibrated(camera, found, what, job)


def is_rectified(camera: FoundCamera) -> bool:
    """Whether the names of a camera's images or topic indicate rectified images."""
    parts = [*camera.images.parts[-2:], *camera.topic.split("/")]
    words = {word for part in parts for word in re.split(r"[^a-z]+", part.lower())}
    return "rect" in words or any("rectified" in part.lower() for part in parts)


def sides_of(names: Sequence[str]) -> dict[str, str]:
    """Camera -> side. Of two cameras without a side in their names, the first is the left one; a single one is left."""
    known = {name: side_of(name) for name in names}
    paired = len(names) == 2 and not any(known.values())
    return {name: side or ("right" if paired and name == names[1] else "left") for name, side in known.items()}


def calibration_of(camera: FoundCamera, job: Import, side: str | None = None) -> FoundCamera:
    """Copy of a camera with the calibration given in the options; unchanged without one.

    Args:
        side: side of the camera in a pair; by default that of its name, or left.
    """
    path = job.options.calibration.get(camera.name)
    if path is None:
        if camera.intrinsics is not None:
            job.found("calibration from the recording.", camera.name)
        return camera
    job.found(f"calibration from {path}.", camera.name)
    named = side_of(camera.name)
    side = side or named or "left"
    if named is None and side == "right":
        job.guessed(f"it is taken for the right camera of {path.name}.", camera.name)
    if side_of(path.stem) not in (None, side):
        text, remedy = f"{path.name} has the name of the other camera.", f"Check --calibration {camera.name} FILE."
        job.warning(text, camera.name, remedy=remedy)
    try:
        found = read_calibration(path, side, camera.name)
    except SequenceError as error:
        raise PartError("calibration", f"camera {camera.name}: {error}", about=camera.name) from error
    return _calibrated(camera, found, str(path), job)


def _calibrated(camera: FoundCamera, found: Calibration, what: str, job: Import) -> FoundCamera:
    """Copy of a camera with a calibration, scaled to the size of its images."""
    for text in found.remarks:
        job.guessed(f"{what}: {text}", camera.name)
    intrinsics, distortion, R = found.intrinsics, found.distortion, found.R
    if is_rectified(camera) and found.P is None:
        text = f"the image names indicate rectified images, but {what} has no projection matrix P; K is used"
        job.warning(f"{text}.", camera.name)
    elif found.P is not None and is_rectified(camera):
        fx, _, cx, _, _, fy, cy, *_ = map(float, found.P.reshape(-1))
        intrinsics, distortion, R = (fx, fy, cx, cy), (), np.eye(3)
        job.guessed(f"the image names indicate rectified images; P of {what} is used.", camera.name)
    given = job.options.calibration_size.get(camera.name)
    size = found.size
    if given is not None:
        width, height = map(int, given.lower().split("x"))
        size = width, height
    calibrated = replace(
        camera,
        intrinsics=intrinsics,
        distortion=distortion,
        pixel_center=0.0,
        T_camera_world=found.T_right_left,
        rectification=R,
        projection=found.P,
    )
    return calibrated if size is None else _scaled(calibrated, size, what, job)


def _scaled(camera: FoundCamera, size: tuple[int, int], what: str, job: Import) -> FoundCamera:
    """Copy of a camera whose intrinsics, given for images of `size`, are scaled to its own images."""
    if size == camera.size or min(size) < 1 or camera.intrinsics is None:
        return camera
    x, y = camera.size[0] / size[0], camera.size[1] / size[1]
    if abs(x / y - 1) > _SAME_SHAPE:
        raise PartError(
            "calibration",
            f"{what} is for images of {size[0]} x {size[1]}, but those of {camera.name} are {camera.size[0]} x "
            f"{camera.size[1]}, which have another aspect ratio (cropped or rotated?).",
            f"Give the calibration of these images: --calibration {camera.name} FILE.",
            about=camera.name,
        )
    fx, fy, cx, cy = camera.intrinsics
    shift = 0.5 - camera.pixel_center
    intrinsics = (fx * x, fy * y, (cx + shift) * x - shift, (cy + shift) * y - shift)
    text = f"{what} is for images of {size[0]} x {size[1]}; it is scaled to {camera.size[0]} x {camera.size[1]}"
    job.guessed(f"{text}, assuming that the images were resized, not cropped.", camera.name)
    return replace(camera, intrinsics=intrinsics)


def check_intrinsics(camera: FoundCamera, job: Import) -> None:
    """Check that a calibration is plausible for the size of the images."""
    assert camera.intrinsics is not None
    fx, fy, cx, cy = camera.intrinsics
    shift = 0.5 - camera.pixel_center
    problem = implausible_intrinsics(*camera.size, (fx, fy, cx + shift, cy + shift), camera.distortion)
    if problem is None:
        if (tangential := unusual_tangential(camera.distortion)) is not None:
            job.warning(f"the calibration has {tangential}.", camera.name)
        return
    if camera.name in job.options.calibration_size and min(fx, fy) > 0:
        job.warning(f"the calibration has {problem}.", camera.name)
        return
    raise PartError(
        "calibration",
        f"the calibration of {camera.name} has {problem}. Give another calibration, or the size of the calibration "
        f"images, so that it can be scaled; if you give the size of these images ({camera.size[0]}x{camera.size[1]}), "
        "it is accepted unchanged.",
        f"Use --calibration {camera.name} FILE or --calibration-size {camera.name} WIDTHxHEIGHT.",
        about=camera.name,
    )


def placed_cameras(cameras: tuple[FoundCamera, ...], job: Import) -> tuple[FoundCamera, ...]:
    """Cameras with their poses; the world is the frame of the first camera, or of the left camera of a pair.

    If the pose of another camera is not given, it follows from the rectification of both cameras:
    T_right_left = R_right^T [I | t] R_left, with t from the last column of P. A camera of unknown pose gets the pose of
    the first camera, until hand-eye calibration estimates its pose.
    """
    first = next((camera for camera in cameras if camera.name == "left"), cameras[0])
    return tuple(camera if camera is first else _placed(camera, first, job) for camera in cameras)


def _placed(camera: FoundCamera, first: FoundCamera, job: Import) -> FoundCamera:
    if camera.T_camera_world is not None:
        baseline = float(np.linalg.norm(camera.T_camera_world[:3, 3]))
        job.found(f"{1e3 * baseline:.2f} mm from {first.name}, given by its calibration.", camera.name)
        if (first.name, camera.name) == ("left", "right") and not _BASELINES[0] <= baseline <= _BASELINES[1]:
            text = f"a baseline of {1e3 * baseline:.4g} mm is unusual for a stereo endoscope. Check its unit."
            job.warning(text, camera.name)
        return camera
    lacking = [each.name for each in (first, camera) if each.rectification is None or each.projection is None]
    if not lacking:
        T = _from_rectification(first, camera)
        angle = np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
        text = f"{1e3 * np.linalg.norm(T[:3, 3]):.2f} mm from {first.name}, rotated by {angle:.2f} deg"
        job.found(f"{text}, computed from the rectification of both cameras.", camera.name)
        return replace(camera, T_camera_world=T)
    why = "" if camera.intrinsics is None else f" ({' and '.join(lacking)}: no rectification and projection)"
    job.missing(
        f"no pose relative to {first.name}{why}; the pose of {first.name} is a placeholder.",
        camera.name,
        remedy=f"Give a stereo calibration (--calibration {camera.name} FILE), or click points (New recording, "
        "carts hand-eye).",
        placeholder="T_camera_world",
    )
    return camera


def _from_rectification(left: FoundCamera, right: FoundCamera) -> np.ndarray:
    """T_right_left [m] from ROS' P[:, 3]: (-fx * baseline, 0, 0), or (0, -fy * baseline, 0) for a vertical pair."""
    assert left.projection is not None and right.projection is not None
    assert left.rectification is not None and right.rectification is not None
    T = np.eye(4)
    shifts = [P[:2, 3] / P[[0, 1], [0, 1]] for P in (left.projection, right.projection)]
    T[:2, 3] = shifts[1] - shifts[0]
    if np.linalg.norm(T[:3, 3]) > 1.0:
        T[:3, 3] *= 1e-3  # The squares of the calibration board were given in millimetres.
    T[:3, :3] = right.rectification.T @ left.rectification
    T[:3, 3] = right.rectification.T @ T[:3, 3]
    return T


IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
_NUMBER = re.compile(r"^(?P<before>.*?)(?P<number>\d+)(?P<after>\D*)$")


@dataclass(frozen=True)
class Images:
    """Images of a camera."""

    path: Path
    """Folder or video file."""
    pattern: str
    """File name pattern of a frame in the folder; empty for a video."""
    ids: tuple[str, ...]
    """Ids of the frames, sorted: the numbers in the file names, or the frame numbers of a video."""
    size: tuple[int, int]
    """Width and height [px]."""
    times: Float[np.ndarray, " frames"] | None = None
    """Presentation times of a video [s]."""
    bits: int | None = None
    """Bit depth of 16-bit images; None for 8-bit images."""
    remarks: tuple[str, ...] = ()
    """Remarks on changes to stored images before they are used."""


def entries(folder: Path) -> list[Path]:
    """Entries of a folder by name, without hidden files (such as `._001.jpg` of macOS); empty for unreadable
    folders."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except (OSError, ValueError):  # `ValueError` is raised for invalid file names.
        return []


def subfolders(folder: Path) -> list[Path]:
    """Folders directly in a folder, by name."""
    return [path for path in entries(folder) if os.path.isdir(path)]


def files_with(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Files with these suffixes directly in a folder, by name."""
    return [path for path in entries(folder) if path.suffix.lower() in suffixes and os.path.isfile(path)]


def image_files(folder: Path) -> list[Path]:
    """Image files directly in a folder, by name."""
    return files_with(folder, IMAGE_SUFFIXES)


def find_images(path: Path, only: str = "") -> Images:
    """Find the frames of a video, or of a folder of images whose names end with `only`."""
    if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES:
        index = index_video(path)
        if not index.count:
            raise SequenceError(f"video {path} has no frames. Copy it again.")
        video = Video(path, (0,))
        first, ids = video.read(0), tuple(f"{number:06d}" for number in range(index.count))
        return Images(path, "", ids, (first.shape[1], first.shape[0]), index.timestamps, remarks=video.remarks())
    files = [file for file in image_files(path) if file.name.endswith(only)]
    if not files:
        kinds = ", ".join(IMAGE_SUFFIXES)
        raise SequenceError(f"{path} is neither a video nor a folder with images ({kinds}). Give another one.")
    pattern, ids = _numbered(files, path)
    source = ImageFiles(tuple(path / pattern.format(frame=name) for name in ids))
    first, remarks = source.read(0), (*image_remarks(source.files), *bits_remark(source.files))
    bits = source.bits() if is_deep(source.files) else None
    return Images(path, pattern, ids, (first.shape[1], first.shape[0]), None, bits, remarks)


def _numbered(files: list[Path], folder: Path) -> tuple[str, tuple[str, ...]]:
    """Find the pattern and the ids of file names that differ in one number."""
    kinds: dict[tuple[str, str], list[str]] = {}
    for file in files:
        match = _NUMBER.match(file.name.removesuffix(file.suffix))
        if match is not None:
            kinds.setdefault((match["before"], match["after"] + file.suffix), []).append(match["number"])
    if len(kinds) != 1:
        shown = ", ".join(sorted(file.name for file in files)[:3])
        raise SequenceError(
            f"the names of the images in {folder} must differ in one number only: {shown} ... Rename them (such as "
            "frame0001.png, frame0002.png), or put the images of each camera into a separate folder."
        )
    ((before, after), numbers) = next(iter(kinds.items()))
    ids = tuple(sorted(numbers, key=lambda number: (int(number), number)))
    before, after = (text.replace("{", "{{").replace("}", "}}") for text in (before, after))
    return f"{before}{{frame}}{after}", ids


def common_ids(images: Mapping[str, Images], path: Path) -> tuple[str, ...]:
    """Ids of the frames with an image of every camera, in the order of the first camera."""
    first, *others = images.values()
    shared = set(first.ids).intersection(*(each.ids for each in others))
    if not shared and first.ids:
        raise SequenceError(
            f"{path}: no frame has an image of every camera and domain. Number the images of all cameras in the same "
            "way, or import one camera."
        )
    return tuple(frame for frame in first.ids if frame in shared)


def united_ids(images: Mapping[str, Images], path: Path) -> tuple[str, ...]:
    """Ids of the frames with an image of any camera, in order; of videos, only those with an image of every camera."""
    shared = common_ids(images, path)
    if not all(each.pattern for each in images.values()):
        return shared
    every = {frame for each in images.values() for frame in each.ids}
    return tuple(sorted(every, key=lambda number: (int(number), number))) if all(map(str.isdecimal, every)) else shared


def cameras_of(
    images: Mapping[str, Images], job: Import, calibrations: Mapping[str, Path] | None = None
) -> tuple[FoundCamera, ...]:
    """Cameras with their images and their given or detected calibrations."""
    job = job.with_options(calibration={**(calibrations or {}), **job.options.calibration})
    cameras, sides = [], sides_of(tuple(images))
    for name, each in images.items():
        job.found(f"{each.path}, {len(each.ids)} images, {each.size[0]} x {each.size[1]}.", name)
        for text in each.remarks:
            job.guessed(text, name)
        camera = FoundCamera(name, each.size, each.path, each.pattern, bits=each.bits)
        cameras.append(calibration_of(camera, job, sides[name]))
    return tuple(cameras)
