"""Folders of images and videos: which frames they have, how these are called, and how large they are."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ...errors import SequenceError
from ...settings.importing import ImportOptions
from ..images import ImageFiles, bits_remark, image_remarks, is_deep
from ..video import SUFFIXES, Video
from ..video_index import index_video
from .cameras import calibration_of
from .found import FoundCamera, Note

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
_NUMBER = re.compile(r"^(?P<before>.*?)(?P<number>\d+)(?P<after>\D*)$")


@dataclass(frozen=True)
class Images:
    """The images of a camera."""

    path: Path
    """Folder or video."""
    pattern: str
    """Name of a frame's image in the folder; empty for a video."""
    ids: tuple[str, ...]
    """Of the frames; the numbers in the names, in their order."""
    size: tuple[int, int]
    """Width and height [px]."""
    times: Float[np.ndarray, " frames"] | None = None
    """Presentation times of a video [s]."""
    bits: int | None = None
    """Of the values of images with 16; None for 8."""
    remarks: tuple[str, ...] = ()
    """What is changed about stored images before they are used."""


def image_files(folder: Path) -> list[Path]:
    """Images directly in a folder, in no order, without hidden files (`._001.jpg` of macOS)."""
    try:
        files = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()]
        return [path for path in files if not path.name.startswith(".")]
    except (OSError, ValueError):  # a name that no file can have
        return []


def find_images(path: Path, only: str = "") -> Images:
    """The frames of a folder of images, or of a video.

    Args:
        path: folder or video file.
        only: keep files whose name ends with this, where a folder holds several kinds.

    Raises:
        SequenceError: nothing is there, names do not number the frames, or the first image cannot be read.
    """
    if path.is_file() and path.suffix.lower() in SUFFIXES:
        return _video(path)
    files = [file for file in image_files(path) if file.name.endswith(only)]
    if not files:
        raise SequenceError(f"{path} has no images ({', '.join(IMAGE_SUFFIXES)}) and is no video. Name another place.")
    pattern, ids = _numbered(files, path)
    source = ImageFiles(tuple(path / pattern.format(frame=name) for name in ids))
    first, remarks = source.read(0), (*image_remarks(source.files), *bits_remark(source.files))
    bits = source.bits() if is_deep(source.files) else None
    return Images(path, pattern, ids, (first.shape[1], first.shape[0]), None, bits, remarks)


def _numbered(files: list[Path], folder: Path) -> tuple[str, tuple[str, ...]]:
    """Pattern and ids of files that differ in one number."""
    kinds: dict[tuple[str, str], list[str]] = {}
    for file in files:
        match = _NUMBER.match(file.name.removesuffix(file.suffix))
        if match is not None:
            kinds.setdefault((match["before"], match["after"] + file.suffix), []).append(match["number"])
    if len(kinds) != 1:
        shown = ", ".join(sorted(file.name for file in files)[:3])
        raise SequenceError(
            f"the images in {folder} are not numbered in one way (say frame0001.png, frame0002.png): {shown} ... "
            "Rename them, or put those of each camera into a folder of its own."
        )
    ((before, after), numbers) = next(iter(kinds.items()))
    ids = tuple(sorted(numbers, key=lambda number: (int(number), number)))
    return f"{_literal(before)}{{frame}}{_literal(after)}", ids


def _literal(text: str) -> str:
    return text.replace("{", "{{").replace("}", "}}")


def _video(path: Path) -> Images:
    index = index_video(path)
    if not index.count:
        raise SequenceError(f"video {path} has no frames. Copy it again.")
    video = Video(path, (0,))
    first = video.read(0)
    ids = tuple(f"{number:06d}" for number in range(index.count))
    return Images(path, "", ids, (first.shape[1], first.shape[0]), index.timestamps, remarks=video.remarks())


def common_ids(kinds: Sequence[Images]) -> tuple[str, ...]:
    """Ids of the frames that every camera has, in the first one's order."""
    shared = set.intersection(*(set(each.ids) for each in kinds))
    return tuple(frame for frame in kinds[0].ids if frame in shared)


def cameras_of(
    images: dict[str, Images], options: ImportOptions, notes: list[Note], calibrations: dict[str, Path] | None = None
) -> tuple[FoundCamera, ...]:
    """Cameras with their images, each with the calibration that was given or found for it.

    Raises:
        SequenceError: a calibration file is not usable.
    """
    known = {**(calibrations or {}), **options.calibration}
    chosen = replace(options, calibration=known)
    cameras = []
    for name, each in images.items():
        notes.append(
            Note("found", f"camera {name}: {each.path}, {len(each.ids)} images, {each.size[0]} x {each.size[1]}.")
        )
        notes += [Note("guessed", f"{name}: {text}") for text in each.remarks]
        camera = FoundCamera(name, each.size, each.path, each.pattern, bits=each.bits)
        cameras.append(calibration_of(camera, chosen, notes))
    return tuple(cameras)
