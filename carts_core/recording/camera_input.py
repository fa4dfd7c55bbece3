"""A camera of a sequence with its images, masks and background, as a `[[cameras]]` table describes them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ..errors import SequenceError
from ..files.reading import is_regular
from ..model.camera import Camera, implausible_intrinsics
from ..wording import closest
from .calibration import take_camera
from .camera_motion import take_camera_motion
from .frame_files import check_present, frame_files
from .frame_list import FrameList, numbers_of_frames
from .image_sources import BagImages, Cropped
from .images import DEPTHS, ImageFiles, ImageSource, mask_remarks
from .matching import PoseSamples
from .patterns import expand, is_glob, is_per_frame
from .rows import Rows
from .toml_table import TomlTable
from .video import SUFFIXES, Video


@dataclass(frozen=True)
class CameraInput:
    """A camera and the files that belong to it, by domain."""

    camera: Camera
    images: Mapping[str, ImageSource]
    masks: Mapping[str, tuple[Path | None, ...]]
    """Mask file of every frame, None for a frame that has none; empty when the sequence has no masks."""
    background: Mapping[str, Path]
    motion: PoseSamples | None
    """Of what carries it; None for a camera that stays."""

    def remarks(self) -> tuple[str, ...]:
        """What is changed about images and masks before they are used, and what is unusual about the calibration."""
        camera = self.camera
        files = {file: None for domain in self.masks.values() for file in domain if file is not None}
        found = [text for source in self.images.values() for text in _remarks_of(source)]
        found += mask_remarks(list(files))
        unusual = implausible_intrinsics(camera.width, camera.height, camera.intrinsics, camera.distortion)
        found += [f"its calibration has {unusual}. Check `size`, `K` and `distortion`."] if unusual else []
        return tuple(dict.fromkeys(f"{camera.name}: {text}" for text in found))


def take_camera_input(table: TomlTable, rows: Rows, domains: tuple[str, ...]) -> CameraInput:
    """The camera that one `[[cameras]]` table describes, every file of it present.

    Raises:
        SequenceError: a value is missing or wrong, or a file is missing.
    """
    camera, frames = take_camera(table), rows.frames
    motion = take_camera_motion(table, rows)
    images = {
        domain: _images(table, pattern, frames, domain, camera.name)
        for domain, pattern in _by_domain(table, "images", domains, required=True).items()
    }
    sparse = table.take("sparse_masks", bool, False)
    masks = {
        domain: _masks(table, pattern, frames, domain=domain, camera=camera.name, sparse=sparse)
        for domain, pattern in _by_domain(table, "masks", domains).items()
    }
    background: dict[str, Path] = {}
    for domain, pattern in _by_domain(table, "background", domains).items():
        path = table.path(expand(pattern, table.name("background"), domain=domain, camera=camera.name))
        if not is_regular(path):
            raise table.error("background", f"points at {path}, which is missing. Correct the path or remove the key.")
        background[domain] = path
    if background and motion is not None:
        raise table.error("background", "does not go with `motion`: it would be another one in every frame. Remove it.")
    table.finish()
    return CameraInput(camera, images, masks, background, motion)


def _remarks_of(source: ImageSource) -> tuple[str, ...]:
    try:
        return source.remarks()
    except SequenceError:  # It is an error where the image is used.
        return ()


def _by_domain(table: TomlTable, key: str, domains: tuple[str, ...], required: bool = False) -> dict[str, str]:
    """Pattern of every domain: text is for all domains, a table names them one by one."""
    value = table.take(key, (str, dict)) if required else table.take(key, (str, dict), {})
    if isinstance(value, str):
        if required and len(domains) > 1 and "{domain" not in value:
            raise table.error(
                key,
                f"is {value!r} for all {len(domains)} domains. Put {{domain}} into it, "
                "or give a table with one pattern per domain.",
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
    if len(crop) != 4 or not all(isinstance(value, int) and value >= 0 for value in crop) or min(crop[2:]) < 1:
        raise table.error("crop", f"is {crop!r}. Give [left, top, width, height] in whole pixels.")
    return Cropped(source, (crop[0], crop[1], crop[2], crop[3]))


def _whole_images(table: TomlTable, pattern: str, frames: FrameList, domain: str, camera: str) -> ImageSource:
    key = table.name("images")
    topic, numbers = table.take("topic", str, ""), frames.video_frames
    message_time, video_frame = table.take("message_time", str, ""), table.take("video_frame", str, "")
    bits = table.take("bits", int, None)
    if bits is not None and bits not in DEPTHS:
        raise table.error("bits", f"is {bits}. Give the bits of the images' values: {', '.join(map(str, DEPTHS))}.")
    deinterlace = table.take("deinterlace", bool, True)
    if topic:
        path = table.path(expand(pattern, key, domain=domain, camera=camera))
        return BagImages(path, topic, _message_times(table, message_time, frames))
    if video_frame:
        if frames.table is None:
            raise table.error("video_frame", "names a column, but [frames] has no table. Name the frames in a table.")
        numbers = numbers_of_frames(frames.table, video_frame, table.name("video_frame"))
    if not is_per_frame(pattern) and not is_glob(pattern):
        path = table.path(expand(pattern, key, domain=domain, camera=camera))
        if path.suffix.lower() not in SUFFIXES:
            raise table.error(
                "images",
                f"is {pattern!r}, which is the same for every frame. Put {{frame}} into it, "
                f"or name a video ({', '.join(SUFFIXES)}).",
            )
        return Video(path, numbers, deinterlace=deinterlace)
    files = frame_files(table.file.parent, pattern, key, frames, domain=domain, camera=camera)
    check_present(key, files, frames)
    return ImageFiles(files, bits)


def _message_times(table: TomlTable, column: str, frames: FrameList) -> tuple[int, ...]:
    if frames.table is None or not column:
        raise table.error("message_time", "is missing: with `topic`, name the column of the table with times [ns].")
    cells = frames.table.text(column, table.name("message_time"))
    for cell, line in zip(cells, frames.table.lines, strict=True):
        if not cell.isdecimal():
            raise SequenceError(f"{frames.table.path}, line {line}, column {column!r}: {cell!r} is no time [ns].")
    return tuple(map(int, cells))


def _masks(
    table: TomlTable, pattern: str, frames: FrameList, *, domain: str, camera: str, sparse: bool
) -> tuple[Path | None, ...]:
    key = table.name("masks")
    if not is_per_frame(pattern) and not is_glob(pattern):
        raise table.error("masks", f"is {pattern!r}, which is the same for every frame. Put {{frame}} into it.")
    files = frame_files(table.file.parent, pattern, key, frames, domain=domain, camera=camera)
    if sparse and any(is_regular(file) for file in files):
        return tuple(file if is_regular(file) else None for file in files)
    check_present(key, files, frames, " If only some frames have masks, set sparse_masks = true.")
    return files
