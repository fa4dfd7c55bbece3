"""COCO: instances with polygons or run lengths, and keypoints."""

from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from ...errors import SequenceError
from ...files.reading import VALUES, parse_json, read_text
from .found import MOST_IMAGES, MOST_KEYPOINTS, ForeignImage
from .rasters import mask_of_polygon, mask_of_runs, runs_of_text

_LARGEST_SIDE = 16384
"""[px]"""
_FEWEST_CORNERS = 3


def is_coco(path: Path) -> bool:
    """Whether a file can be one: it ends with .json."""
    return path.suffix.lower() == ".json"


def read_coco(path: Path, remarks: Counter[str]) -> Iterator[ForeignImage]:
    """The images of a COCO file.

    Args:
        path: of the file.
        remarks: annotations that are not usable are added, with the reason, and left out.

    Raises:
        SequenceError: it is not COCO.
    """
    try:
        content = parse_json(read_text(path, VALUES))
        names = {int(entry["id"]): entry for entry in content["categories"]}
        marked: dict[int, list[dict[str, Any]]] = defaultdict(list)
        for annotation in content["annotations"]:
            marked[int(annotation["image_id"])].append(annotation)
        images = list(content["images"])
        if len(images) > MOST_IMAGES:
            raise ValueError(f"it has {len(images)} images; {MOST_IMAGES} are allowed")
        for absent in sorted(marked.keys() - {int(image["id"]) for image in images}):
            why = f"image {absent} is not in the file"
            remarks.update(_left_out(annotation, why) for annotation in marked[absent])
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise SequenceError(f"{path} is not a COCO file ({_why(error)}). Export it again.") from error
    for image in images:
        yield _image(path, image, marked[int(image["id"])], names, remarks)


def _left_out(annotation: dict[str, Any], why: str) -> str:
    return f"annotation {annotation.get('id', '(without id)')} left out: {why}"


def _image(
    path: Path, image: Any, marked: list[dict[str, Any]], names: dict[int, Any], remarks: Counter[str]
) -> ForeignImage:
    where = f"{path}: image {image.get('file_name')!r}"
    try:
        size = int(image["height"]), int(image["width"])
        if not all(0 < side <= _LARGEST_SIDE for side in size):
            raise ValueError(f"its size is {size[1]} x {size[0]}")
        name = str(image["file_name"])
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise SequenceError(f"{where} cannot be read ({_why(error)}). Export it again.") from error
    points: dict[str, tuple[float, float]] = {}
    usable = []
    for annotation in marked:
        try:
            points |= _keypoints(annotation, _category(annotation, names))
            usable.append(annotation)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            remarks[_left_out(annotation, f"{name}: {_why(error)}")] += 1
    if len(points) > MOST_KEYPOINTS:
        raise SequenceError(f"{where} has {len(points)} keypoints; {MOST_KEYPOINTS} are allowed. Export fewer.")

    def parts() -> Iterator[tuple[str, Bool[np.ndarray, "height width"]]]:
        for annotation in usable:
            try:
                mask = _mask(annotation.get("segmentation"), *size)
                label = str(_category(annotation, names)["name"])
            except (ValueError, TypeError, KeyError, AttributeError, IndexError) as error:
                remarks[_left_out(annotation, f"{name}: {_why(error)}")] += 1
                continue
            if mask is not None:
                yield label, mask

    return ForeignImage(name, parts, points, str(image.get("frame", "")), str(image.get("camera", "")))


def _category(annotation: dict[str, Any], names: dict[int, Any]) -> Any:
    if (number := int(annotation["category_id"])) not in names:
        raise ValueError(f"category {number} is not in the file")
    return names[number]


def _mask(segmentation: Any, height: int, width: int) -> Bool[np.ndarray, "height width"] | None:
    if not segmentation:
        return None
    if isinstance(segmentation, dict):
        counts, size = segmentation["counts"], [int(side) for side in segmentation["size"]]
        if size != [height, width]:
            raise ValueError(f"a mask is {size[1]} x {size[0]} in an image of {width} x {height} pixels")
        runs = runs_of_text(counts) if isinstance(counts, str) else [int(run) for run in counts]
        return mask_of_runs(runs, height, width, by_columns=True)
    # Some tools write the only polygon without a list around it.
    polygons = [segmentation] if all(isinstance(value, int | float) for value in segmentation) else segmentation
    mask = np.zeros((height, width), bool)
    for polygon in polygons:
        if len(polygon) % 2 or len(polygon) < 2 * _FEWEST_CORNERS:
            raise ValueError(f"a polygon has {len(polygon)} numbers, which are not x and y of three or more corners")
        points = np.asarray(polygon, np.float64).reshape(-1, 2)
        if not np.isfinite(points).all() or np.abs(points).max() > 2 * _LARGEST_SIDE:
            raise ValueError("a corner of a polygon lies nowhere")
        mask |= mask_of_polygon(points, height, width)
    return mask


def _keypoints(annotation: dict[str, Any], category: Any) -> dict[str, tuple[float, float]]:
    values = np.asarray(annotation.get("keypoints") or [], np.float64)
    if values.size % 3:
        raise ValueError(f"its keypoints have {values.size} numbers, which are not x, y and visibility of each")
    values = values.reshape(-1, 3)
    names = [str(name) for name in category.get("keypoints") or range(1, len(values) + 1)]
    if len(names) < len(values):
        raise ValueError(f"{len(values)} keypoints have {len(names)} names")
    return {
        f"{category['name']}.{name}": (float(u), float(v))
        for name, (u, v, seen) in zip(names, values, strict=False)
        if seen > 0 and np.isfinite([u, v]).all()
    }


def _why(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else str(error)
