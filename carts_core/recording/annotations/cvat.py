"""CVAT for images 1.1: masks, polygons and points."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Bool

from ...errors import SequenceError
from ...files.reading import VALUES, read_text
from ...wording import shown
from .found import MOST_IMAGES, MOST_KEYPOINTS, ForeignImage
from .rasters import mask_of_polygon, mask_of_runs

_LARGEST_SIDE = 16384
"""[px]"""


def is_cvat(path: Path) -> bool:
    """Whether a file can be one: it ends with .xml."""
    return path.suffix.lower() == ".xml"


def read_cvat(path: Path, remarks: Counter[str]) -> Iterator[ForeignImage]:
    """The images of a CVAT file.

    Args:
        path: of the file.
        remarks: shapes that are not usable are added, with the reason, and left out.

    Raises:
        SequenceError: it is not CVAT's.
    """
    try:
        text = read_text(path, VALUES)
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise ValueError("it declares a document type or entities")
        root = ElementTree.fromstring(text)
        if root.tag != "annotations" or root.find("image") is None:
            raise ValueError("there is no <image> in <annotations>; export as 'CVAT for images 1.1'")
        images = root.findall("image")
        if len(images) > MOST_IMAGES:
            raise ValueError(f"it has {len(images)} images; {MOST_IMAGES} are allowed")
        name, times = Counter(image.get("name") for image in images).most_common(1)[0]
        if times > 1:
            raise ValueError(f"it has image {shown(str(name))} {times} times")
    except (OSError, ValueError, RecursionError, ElementTree.ParseError) as error:
        raise SequenceError(f"{path} is not a CVAT file ({error}). Export it again.") from error
    for image in images:
        yield _image(path, image, remarks)


def _image(path: Path, image: Element, remarks: Counter[str]) -> ForeignImage:
    name = image.get("name", "")
    where = f"{path}: image {name!r}"
    try:
        height, width = int(image.get("height", "")), int(image.get("width", ""))
        if not (0 < height <= _LARGEST_SIDE and 0 < width <= _LARGEST_SIDE):
            raise ValueError(f"its size is {width} x {height}")
        points = dict(_keypoints(image))
        if len(points) > MOST_KEYPOINTS:
            raise ValueError(f"it has {len(points)} keypoints; {MOST_KEYPOINTS} are allowed")
    except (ValueError, TypeError) as error:
        raise SequenceError(f"{where} cannot be read ({error}). Export it again.") from error

    def parts() -> Iterator[tuple[str, Bool[np.ndarray, "height width"]]]:
        shapes = [shape for shape in image if shape.tag in ("mask", "polygon")]
        for shape in sorted(shapes, key=lambda shape: int(shape.get("z_order", "0"))):
            try:
                mask = _mask(shape, height, width)
            except (ValueError, TypeError) as error:
                remarks[f"a {shape.tag} ({shape.get('label', 'no label')}) of {name} left out: {error}"] += 1
                continue
            yield shape.get("label", "instrument"), mask

    return ForeignImage(name, parts, points)


def _mask(shape: Element, height: int, width: int) -> Bool[np.ndarray, "height width"]:
    if shape.tag == "polygon":
        return mask_of_polygon(_points(shape), height, width)
    left, top, wide, high = (int(shape.get(key, "")) for key in ("left", "top", "width", "height"))
    if left < 0 or top < 0 or wide < 1 or high < 1 or left + wide > width or top + high > height:
        raise ValueError(f"a mask of {wide} x {high} at {left}, {top} is not inside {width} x {height} pixels")
    runs = [int(run) for run in shape.get("rle", "").split(",")]
    mask = np.zeros((height, width), bool)
    mask[top : top + high, left : left + wide] = mask_of_runs(runs, high, wide, by_columns=False)
    return mask


def _points(shape: Element) -> np.ndarray:
    rows = [corner.split(",") for corner in shape.get("points", "").split(";")]
    points = np.array([[float(x), float(y)] for x, y in rows])
    if not np.isfinite(points).all() or np.abs(points).max() > 2 * _LARGEST_SIDE:
        raise ValueError("a point lies nowhere")
    return points


def _keypoints(image: Element) -> Iterator[tuple[str, tuple[float, float]]]:
    """Points with their labels; several of one shape are numbered."""
    for shape in image.iter("points"):
        if shape.get("outside") == "1":
            continue
        points, label = _points(shape), shape.get("label", "point")
        for number, (u, v) in enumerate(points, start=1):
            yield (label if len(points) == 1 else f"{label}.{number}"), (float(u), float(v))
