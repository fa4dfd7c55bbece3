"""Reader of LabelMe's JSON, one file per image, which X-AnyLabeling extends."""

import base64
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Bool

from ...wording import shown
from ..images import decode_mask
from ..importing.found import read_json, well_formed
from .images import ForeignImage, Part, check_keypoints, named_keypoints, or_left_out
from .shapes import check_shapes, check_size, checked_points, corners_of_box, mask_of_ellipse, mask_of_polygon

_POLYGONS = ("polygon", "oriented_rectangle", "rotation", "quadrilateral")
"""Shape types with a list of vertices; the last two are specific to X-AnyLabeling."""
_UNKNOWN = -1
"""Width and height that X-AnyLabeling writes for an image of unknown size."""
_BOX_TOLERANCE = 1
"""Maximum difference between the size of a stored mask and that of its box, whose last pixel some programs exclude
[px]."""


def is_labelme(content: Any) -> bool:
    """Whether parsed JSON is a file of LabelMe or X-AnyLabeling."""
    return isinstance(content, dict) and "imagePath" in content and isinstance(content.get("shapes"), list)


def is_xanylabeling(content: Any) -> bool:
    """Whether parsed JSON of LabelMe has the extensions of X-AnyLabeling."""
    shapes = [shape for shape in content["shapes"] if isinstance(shape, dict)]
    return "checked" in content or any({"kie_linking", "difficult", "attributes"} & shape.keys() for shape in shapes)


def read_labelme(files: Iterable[tuple[Path, str]], remarks: Counter[str]) -> Iterator[ForeignImage]:
    """Read files of LabelMe; reasons for omitted shapes are added to `remarks`.

    Args:
        files: path of each file, and its folder relative to the source.
    """
    for path, folder in files:
        content = read_json(path)
        if not is_labelme(content):
            remarks[f"{path.name} skipped: it is not a file of LabelMe"] += 1
            continue
        yield labelme_image(path, folder, content, remarks)


def labelme_image(path: Path, folder: str, content: Any, remarks: Counter[str]) -> ForeignImage:
    """Annotated image of a parsed file. `imagePath` is used as a name only, and never opened."""
    with well_formed(f"{path} cannot be read", "Save it again in LabelMe."):
        check_shapes(len(content["shapes"]))
        size = _size(content)
        given = PurePosixPath(str(content["imagePath"]).replace("\\", "/"))
        if given.stem != path.stem:
            remarks["the image named in the file (imagePath) is used, not the name of the file"] += 1
        name = "/".join(part for part in (*PurePosixPath(folder).parts, *given.parts) if part not in ("..", ".", "/"))
        points, areas = [], []
        for shape in content["shapes"]:
            what = f"a {_type(shape)} ({_label(shape)}) of {given.name}"
            with or_left_out(what, remarks):
                if _type(shape) == "point":
                    (position,) = checked_points(shape["points"])
                    points.append((_label(shape), shape.get("group_id"), (float(position[0]), float(position[1]))))
                elif _type(shape) in ("line", "linestrip"):
                    raise ValueError("lines have no area; draw polygons")
                else:
                    areas.append((what, shape))
        keypoints = named_keypoints(points)
        check_keypoints(keypoints)

    def parts(height: int, width: int) -> Iterator[Part]:
        for what, shape in areas:
            mask = None
            with or_left_out(what, remarks):
                mask = _mask(shape, height, width)
            if mask is not None:
                yield _label(shape), mask

    return ForeignImage(name, parts, keypoints, size=size)


def _size(content: Any) -> tuple[int, int] | None:
    """Height and width of the image [px]; None if the file does not state them."""
    given = content.get("imageHeight"), content.get("imageWidth")
    if any(side is None or side == _UNKNOWN for side in given):
        return None
    return check_size(*map(int, given))


def _type(shape: Any) -> str:
    return str(shape.get("shape_type") or "polygon")  # Early versions have polygons only, without a type.


def _label(shape: Any) -> str:
    return str(shape["label"])


def _mask(shape: dict[str, Any], height: int, width: int) -> Bool[np.ndarray, "height width"]:
    kind, points = _type(shape), checked_points(shape["points"])
    if kind == "mask":
        return _stored_mask(shape["mask"], points, height, width)
    if kind == "circle":
        (x, y), (edge_x, edge_y) = points
        radius = math.hypot(edge_x - x, edge_y - y)
        return mask_of_ellipse((x, y), (radius, radius), 0.0, height, width)
    if kind == "rectangle" and len(points) == 2:
        return mask_of_polygon(corners_of_box(points[0], points[1] - points[0]), height, width)
    if kind in (*_POLYGONS, "rectangle"):
        return mask_of_polygon(points, height, width)
    raise ValueError(f"shapes of the type {shown(kind)} are not supported")


def _stored_mask(text: Any, points: np.ndarray, height: int, width: int) -> Bool[np.ndarray, "height width"]:
    """Mask stored as a base64 PNG, whose first pixel is at the first corner of a box; pixels outside the image are
    omitted."""
    (left, top), (right, bottom) = points.astype(int)  # LabelMe also truncates.
    if not isinstance(text, str):
        raise ValueError("its mask is missing")
    wanted = (int(bottom - top + 1), int(right - left + 1))
    largest = min(height, wanted[0] + _BOX_TOLERANCE), min(width, wanted[1] + _BOX_TOLERANCE)
    stored = decode_mask(base64.b64decode(text, validate=True), "its mask", largest)
    if max(abs(have - want) for have, want in zip(stored.shape, wanted, strict=True)) > _BOX_TOLERANCE:
        raise ValueError(f"its mask is {stored.shape[1]} x {stored.shape[0]} in a box of {wanted[1]} x {wanted[0]}")
    mask = np.zeros((height, width), bool)
    rows = slice(max(0, top), min(height, top + stored.shape[0]))
    columns = slice(max(0, left), min(width, left + stored.shape[1]))
    if rows.start < rows.stop and columns.start < columns.stop:
        mask[rows, columns] = stored[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
    return mask
