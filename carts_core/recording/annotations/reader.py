"""Annotations matched with the frames of a sequence."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import get_args

import cv2
import numpy as np
from jaxtyping import UInt8

from ...errors import SequenceError
from ...files import MARKER
from ...files.reading import is_regular
from ...model.camera import Camera
from ...settings import DrawnOn, FormatName
from ..image_sources import Cropped
from ..images import ImageFiles
from ..importing.cameras import side_of
from ..importing.found import read_json
from ..sequence import Sequence
from .frame_numbers import FrameNumbers
from .images import BACKGROUND, MAX_LABELS, Annotations, ForeignImage, FrameAnnotation
from .label_studio import file_of_address
from .recognition import AnnotationFormat, recognized

_INSIDE = {"annotations/instances_default.json", "annotations.xml"}
"""Files to read in the folder of an export."""
_UNDISTORTED = ("masks", "coco", "coco-keypoints", "bop", "yolo", "voc", "cvat", "datumaro")
"""Export formats whose labels refer to undistorted images; those of all others refer to recorded images."""
_RENDERED = "rendered"
"""Folder of an export in any format with masks of undistorted images."""
_LEVELS = 4
"""Number of folders, from that of the annotations upwards, in which the description of an export is looked for."""
_ROBOFLOW = re.compile(r"_(?:jpe?g|png|bmp|tiff?)\.rf\.[0-9A-Za-z]+$", re.IGNORECASE)
"""End that Roboflow adds to the name of an image, with digits that are not a frame number."""


def read_annotations(
    source: Path,
    sequence: Sequence,
    camera: str | None = None,
    *,
    format: AnnotationFormat | None = None,
    drawn_on: DrawnOn | None = None,
    confined: bool = False,
) -> Annotations:
    """Read masks and keypoints for the frames of a sequence.

    Frames are matched by their ids or by a number in image names (see `FrameNumbers`), cameras by their names or by
    left and right.
    Annotations drawn on recorded images of a camera with distortion are undistorted.

    Args:
        source: a file of COCO, CVAT, LabelMe, X-AnyLabeling or Label Studio, keypoints of SurgPose, a folder of LabelMe
            files, YOLO labels or mask images, or the folder of an export.
        sequence: sequence with the frames.
        camera: camera of the images, if their names do not contain it.
        format: format of the source, recognized by its content by default.
        drawn_on: images that the annotations were drawn on. By default undistorted ones in exports of carts in formats
            of annotation tools, otherwise recorded ones; a remark states the assumption.
        confined: whether links, and files next to the source, are ignored.

    Raises:
        SequenceError: the source has another format, several, or cannot be read; also raised while frames are iterated.
    """
    if camera is not None:
        sequence.recorded_camera(camera)
    if not source.exists():
        raise SequenceError(f"{source} is missing. Give the file or folder of the masks or keypoints.")
    place = next((source / name for name in sorted(_INSIDE) if (source / name).is_file()), source)
    remarks: Counter[str] = Counter()
    kind, images = recognized(place, format, remarks, confined=confined)
    labels: list[str] = []
    unknown: list[str] = []
    exported = None if drawn_on else _exported_on(place, confined)
    reader = _FrameReader(sequence, camera, source.name, labels, unknown, drawn_on, exported, remarks)
    return Annotations(kind, reader.frames(images), labels, unknown, remarks)


def find_frame(image: str, sequence: Sequence) -> tuple[int, str] | None:
    """Index of the frame and name of the camera of an image, given its name, path or address; None for other images."""
    matcher = _FrameReader(sequence, None, "", [], [])
    return matcher.place(ForeignImage(file_of_address(image)))


def _stem(image: ForeignImage) -> str:
    """Name of an image without folder, suffix and the end that Roboflow adds."""
    return _ROBOFLOW.sub("", PurePosixPath(image.name.replace("\\", "/")).stem)


def _name(image: ForeignImage, camera: str) -> str:
    """Given frame number of an image, or its name without that of its camera."""
    return image.frame or _stem(image).removeprefix(f"{camera}_").removesuffix(f"_{camera}")


def _is_video(sequence: Sequence, camera: str) -> bool:
    """Whether the images of a camera are decoded from a video or bag, whose frames are numbered by the program."""
    source = sequence.image_source(camera)
    while isinstance(source, Cropped):
        source = source.source
    return not isinstance(source, ImageFiles)


def _exported_on(place: Path, confined: bool) -> DrawnOn | None:
    """Images that the labels of an export of carts refer to; None if the annotations are not in an export."""
    place = place.absolute()
    for folder in (place, *place.parents)[:_LEVELS]:
        marker = folder / MARKER
        if not is_regular(marker) or (confined and marker.is_symlink()):
            continue
        try:
            content = read_json(marker)
        except SequenceError:
            return None
        format = content.get("format") if isinstance(content, dict) else None
        if format in _UNDISTORTED or _RENDERED in place.relative_to(folder).parts[:1]:
            return "undistorted"
        return "recorded" if format in get_args(FormatName) else None
    return None


class _FrameReader:
    """Converts annotated images of a source into annotations of the frames of a sequence."""

    def __init__(
        self,
        sequence: Sequence,
        camera: str | None,
        source: str,
        labels: list[str],
        unknown: list[str],
        drawn_on: DrawnOn | None = None,
        exported: DrawnOn | None = None,
        remarks: Counter[str] | None = None,
    ) -> None:
        self._sequence, self._camera, self._source = sequence, camera, source
        self._labels, self._unknown = labels, unknown
        self._drawn_on: DrawnOn | None = drawn_on
        self._exported: DrawnOn | None = exported
        self._remarks = Counter() if remarks is None else remarks
        self._cameras = [own.name for own in sequence.scene.cameras]
        self._ids = {frame_id: index for index, frame_id in enumerate(sequence.frame_ids)}
        self._numbers = {name: FrameNumbers(self._ids) for name in ([camera] if camera else self._cameras)}

    def frames(self, images: Iterable[ForeignImage]) -> Iterator[FrameAnnotation]:
        """One annotation per frame and camera; consecutive images of the same frame are merged."""
        at: tuple[int, str] | None = None
        joined: list[ForeignImage] = []
        done: set[tuple[int, str]] = set()
        images = [*images]  # Only all names together show which number is that of the frame.
        self._learn_names(images)
        for image in images:
            found = self.place(image)
            if found is None:
                self._unknown.append(image.name)
                continue
            if found != at and at is not None:
                yield self._joined(at, joined)
                done.add(at)
                joined = []
            if found in done:
                raise SequenceError(
                    f"{image.name} belongs to a frame that was already read. Name the images after their frames."
                )
            at, joined = found, [*joined, image]
        if at is not None:
            yield self._joined(at, joined)

    def place(self, image: ForeignImage) -> tuple[int, str] | None:
        """Frame and camera of an image; None if it does not match."""
        camera = self._camera_of(image)
        if camera is None:
            return None
        given = self._given(image)
        index = self._numbers[camera].find(_name(image, camera)) if given is None else given
        return None if index is None else (index, camera)

    def _given(self, image: ForeignImage) -> int | None:
        """Index of the frame whose id is given with an image or is its name."""
        return self._ids.get(image.frame, self._ids.get(_stem(image)))

    def _learn_names(self, images: Iterable[ForeignImage]) -> None:
        """Find out which number in the names of each camera's images is that of the frame."""
        names: dict[str, list[str]] = {}
        for image in images:
            if (camera := self._camera_of(image)) is not None and image.frame not in self._ids:
                names.setdefault(camera, []).append(_name(image, camera))
        for camera, own in names.items():
            numbers = self._numbers[camera]
            numbers.learn([name for name in own if name not in self._ids], self._remarks)
            if self._exported is None and _is_video(self._sequence, camera) and numbers.begin_at_one(own):
                self._remarks[
                    f"no image of camera {camera!r} has the number 0, but frames of its video are numbered from 0; if "
                    "the images were extracted with numbers from 1, as by ffmpeg, the annotations are one frame late: "
                    "rename the images, or extract them with -start_number 0"
                ] += 1

    def _camera_of(self, image: ForeignImage) -> str | None:
        if self._camera is not None or image.camera in self._cameras:
            return self._camera or image.camera
        path = PurePosixPath(image.name.replace("\\", "/"))
        for part in (path.stem, *path.parts[-2::-1], self._source):
            named = [name for name in self._cameras if part == name or part.startswith(f"{name}_")]
            named += [name for name in self._cameras if part.endswith(f"_{name}")]
            if named:
                return named[0]
        side = side_of(image.name) or side_of(self._source)
        if len(self._cameras) == 1:
            return self._cameras[0]
        return side if side in self._cameras else None

    def _joined(self, at: tuple[int, str], images: list[ForeignImage]) -> FrameAnnotation:
        index, name = at
        camera = self._sequence.recorded_camera(name)
        drawn_on = self._drawn_on or self._exported or "recorded"
        if self._drawn_on is None and any(camera.distortion):
            self._remarks[_assumption(name, self._exported)] += 1
        labels: UInt8[np.ndarray, "height width"] | None = None
        points: dict[str, tuple[float, float]] = {}
        for image in images:
            points |= image.keypoints
            if image.size is not None:
                _check_size(image.name, image.size, camera)
            for label, mask in image.parts(camera.height, camera.width):
                _check_size(image.name, mask.shape, camera)
                labels = np.zeros(mask.shape, np.uint8) if labels is None else labels
                if label.casefold() in BACKGROUND:
                    labels[mask] = 0
                    continue
                if label and label not in self._labels:
                    if len(self._labels) == MAX_LABELS:
                        raise SequenceError(f"there are more than {MAX_LABELS} labels, such as {label!r}. Merge some.")
                    self._labels.append(label)
                if label:
                    labels[mask] = self._labels.index(label) + 1
        if drawn_on == "recorded":
            labels = None if labels is None else camera.undistort(labels, cv2.INTER_NEAREST)
            points = _undistorted(points, camera)
        return FrameAnnotation(index, name, labels, points)


def _assumption(camera: str, exported: DrawnOn | None) -> str:
    """Remark on the images that annotations of a camera with distortion are assumed to be drawn on."""
    drawn_on, other = ("undistorted", "recorded") if exported == "undistorted" else ("recorded", "undistorted")
    source = ", as in this export" if exported else ""
    return (
        f"camera {camera!r} has distortion; its annotations are assumed to be drawn on {drawn_on} images{source}. If "
        f"they were drawn on {other} images{'' if exported else ', such as those in exports'}, import them with "
        f"carts import-masks --drawn-on {other}"
    )


def _check_size(name: str, size: tuple[int, ...], camera: Camera) -> None:
    """Check that an annotated image of a height and width [px] has the size of the camera's images."""
    if size != (camera.height, camera.width):
        raise SequenceError(
            f"{name} is {size[1]} x {size[0]} pixels, but images of camera {camera.name!r} are {camera.width} x "
            f"{camera.height}. Give masks of the size of the images."
        )


def _undistorted(points: dict[str, tuple[float, float]], camera: Camera) -> dict[str, tuple[float, float]]:
    if not points or not any(camera.distortion):
        return points
    straight = camera.undistort_points(np.array(list(points.values()), np.float64))
    return {name: (float(u), float(v)) for name, (u, v) in zip(points, straight, strict=True)}
