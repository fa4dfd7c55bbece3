"""Annotated images of a source, and the annotations of frames."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, UInt8

from ...errors import SequenceError
from ..importing.found import MALFORMED, cause

MAX_LABELS = 255
"""Maximum number of labels of a layer, limited by its 8-bit pixels."""
MAX_IMAGES = 100_000
"""Maximum number of images of a source."""
MAX_KEYPOINTS = 200
"""Maximum number of keypoints of an image."""
BACKGROUND = ("background", "background-tissue", "_background_")
"""Names of labels of unlabelled pixels."""

Part = tuple[str, Bool[np.ndarray, "height width"]]
"""Label and its pixels."""
Keypoints = Mapping[str, tuple[float, float]]
"""Name -> column and row [px]."""


@dataclass(frozen=True)
class ForeignImage:
    """An annotated image of a source."""

    name: str
    """File name in the source."""
    parts: Callable[[int, int], Iterable[Part]] = lambda height, width: ()
    """Labels and their pixels, decoded on demand, given height and width of the camera's images; later parts cover
    earlier ones. A part with an empty label labels no pixels; an image without parts has no mask."""
    keypoints: Keypoints = field(default_factory=dict)
    """Name -> column and row [px], from the upper left corner of the image."""
    frame: str = ""
    """Id of the frame; empty if the source does not give it."""
    camera: str = ""
    """Name of the camera; empty if the source does not give it."""
    size: tuple[int, int] | None = None
    """Height and width [px]; None if the source does not give them."""


@dataclass(frozen=True, eq=False)
class FrameAnnotation:
    """Annotations of one frame in one camera."""

    frame: int
    """Index in the sequence."""
    camera: str
    labels: UInt8[np.ndarray, "height width"] | None
    """Label of each pixel of the undistorted image, from 1; 0 elsewhere. None without masks."""
    keypoints: Keypoints
    """Name -> column and row in the undistorted image [px]."""


@dataclass(frozen=True, eq=False)
class Annotations:
    """Annotations of a source for a sequence. Frames are decoded during the iteration, which is possible once."""

    kind: str
    """Name of the source's format."""
    frames: Iterator[FrameAnnotation]
    label_names: list[str]
    """Names of the labels from 1; complete after the iteration."""
    unknown: list[str]
    """Names of images without a matching frame; complete after the iteration."""
    remarks: Counter[str] = field(default_factory=Counter)
    """Remarks on how masks were interpreted and why annotations were omitted, with their counts; complete after the
    iteration."""


T = TypeVar("T")


def few_enough(images: Iterable[T]) -> list[T]:
    """List of the images of a source; `ValueError` if there are too many."""
    images = list(images)
    if len(images) > MAX_IMAGES:
        raise ValueError(f"it has {len(images)} images; at most {MAX_IMAGES} are allowed")
    return images


def check_keypoints(keypoints: Mapping[str, Any]) -> None:
    """Check the number of keypoints of an image; `ValueError` if there are too many."""
    if len(keypoints) > MAX_KEYPOINTS:
        raise ValueError(f"the image has {len(keypoints)} keypoints; at most {MAX_KEYPOINTS} are allowed")


@contextmanager
def or_left_out(what: str, remarks: Counter[str]) -> Iterator[None]:
    """Convert an exception of a malformed annotation to a remark, so that the other annotations are read."""
    try:
        yield
    except (*MALFORMED, SequenceError) as error:
        remarks[f"{what} left out: {cause(error)}"] += 1


def named_keypoints(points: Iterable[tuple[str, Any, tuple[float, float]]]) -> dict[str, tuple[float, float]]:
    """Keypoints by name, from triples of label, group and position [px]. A label that occurs several times is followed
    by its groups if they differ, otherwise by numbers from 1."""
    by_label: dict[str, list[tuple[Any, tuple[float, float]]]] = {}
    for label, group, position in points:
        by_label.setdefault(label, []).append((group, position))
    found: dict[str, tuple[float, float]] = {}
    for label, members in by_label.items():
        groups = [str(group) for group, _ in members if group is not None]
        suffixes = groups if len(set(groups)) == len(members) else [str(n) for n in range(1, len(members) + 1)]
        for suffix, (_, position) in zip(suffixes, members, strict=True):
            found[label if len(members) == 1 else f"{label}.{suffix}"] = position
    return found
