"""Readers of annotation formats: COCO, CVAT for images 1.1, SurgPose and folders of mask images."""

import math
import os
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Bool

from ...errors import SequenceError
from ...files.reading import VALUES, is_regular, parse_json, parse_xml, read_text
from ...model.camera import HALF_PIXEL
from ...wording import shown
from ..images import read_labels
from ..importing.found import well_formed
from .images import (
    BACKGROUND,
    MAX_IMAGES,
    MAX_KEYPOINTS,
    ForeignImage,
    Part,
    check_keypoints,
    few_enough,
    or_left_out,
)
from .shapes import check_shapes, check_size, checked_points, mask_of_polygon, mask_of_runs, runs_of_text

_MIN_VERTICES = 3
_EXPORT = "Export it again."


def read_coco(path: Path, content: Any, remarks: Counter[str]) -> Iterator[ForeignImage]:
    """Read the images of a COCO file; reasons for omitted annotations are added to `remarks`."""
    with well_formed(f"{path} is not a COCO file", _EXPORT):
        names = {int(entry["id"]): entry for entry in content["categories"]}
        marked: dict[int, list[dict[str, Any]]] = defaultdict(list)
        for annotation in content["annotations"]:
            marked[int(annotation["image_id"])].append(annotation)
        images = few_enough(content["images"])
        for absent in sorted(marked.keys() - {int(image["id"]) for image in images}):
            why = f"image {absent} is not in the file"
            remarks.update(f"{_annotation(annotation)} left out: {why}" for annotation in marked[absent])
    for image in images:
        yield _coco_image(path, image, marked[int(image["id"])], names, remarks)


def _size(image: Any) -> tuple[int, int]:
    """Height and width of an image [px]."""
    return check_size(int(image["height"]), int(image["width"]))


def _annotation(annotation: dict[str, Any]) -> str:
    return f"annotation {annotation.get('id', '(without id)')}"


def _coco_image(
    path: Path, image: Any, marked: list[dict[str, Any]], names: dict[int, Any], remarks: Counter[str]
) -> ForeignImage:
    where = f"{path}: image {image.get('file_name')!r}"
    with well_formed(f"{where} cannot be read", _EXPORT):
        size, name = _size(image), str(image["file_name"])
        check_shapes(len(marked))
    points: dict[str, tuple[float, float]] = {}
    usable = []
    for annotation in marked:
        with or_left_out(f"{_annotation(annotation)} of {name}", remarks):
            points |= _coco_keypoints(annotation, _category(annotation, names))
            usable.append(annotation)
    with well_formed(f"{where} cannot be read", "Export fewer."):
        check_keypoints(points)

    def parts(height: int, width: int) -> Iterator[Part]:
        for annotation in usable:
            mask, label = None, ""
            with or_left_out(f"{_annotation(annotation)} of {name}", remarks):
                mask = _coco_mask(annotation.get("segmentation"), height, width)
                label = str(_category(annotation, names)["name"])
            if mask is not None:
                yield label, mask

    return ForeignImage(name, parts, points, str(image.get("frame", "")), str(image.get("camera", "")), size)


def _category(annotation: dict[str, Any], names: dict[int, Any]) -> Any:
    if (number := int(annotation["category_id"])) not in names:
        raise ValueError(f"category {number} is not in the file")
    return names[number]


def _coco_mask(segmentation: Any, height: int, width: int) -> Bool[np.ndarray, "height width"] | None:
    if not segmentation:
        return None
    if isinstance(segmentation, dict):
        counts, size = segmentation["counts"], [int(side) for side in segmentation["size"]]
        if size != [height, width]:
            raise ValueError(f"a mask is {size[1]} x {size[0]} in an image of {width} x {height} pixels")
        runs = runs_of_text(counts) if isinstance(counts, str) else [int(run) for run in counts]
        return mask_of_runs(runs, height, width, by_columns=True)
    # Some tools write a single polygon without the enclosing list.
    polygons = [segmentation] if all(isinstance(value, int | float) for value in segmentation) else segmentation
    check_shapes(len(polygons))
    mask = np.zeros((height, width), bool)
    for polygon in polygons:
        if len(polygon) % 2 or len(polygon) < 2 * _MIN_VERTICES:
            raise ValueError(f"a polygon has {len(polygon)} numbers, but needs x and y of at least three vertices")
        mask |= mask_of_polygon(checked_points(polygon), height, width)
    return mask


def _coco_keypoints(annotation: dict[str, Any], category: Any) -> dict[str, tuple[float, float]]:
    values = np.asarray(annotation.get("keypoints") or [], np.float64)
    if values.size % 3:
        raise ValueError(f"its keypoints have {values.size} numbers, but need x, y and visibility for each")
    values = values.reshape(-1, 3)
    names = [str(name) for name in category.get("keypoints") or range(1, len(values) + 1)]
    if len(names) < len(values):
        raise ValueError(f"there are {len(values)} keypoints, but {len(names)} names")
    return {
        f"{category['name']}.{name}": (float(u), float(v))
        for name, (u, v, seen) in zip(names, values, strict=False)
        if seen > 0 and np.isfinite([u, v]).all()
    }


def read_cvat(path: Path, remarks: Counter[str]) -> Iterator[ForeignImage]:
    """Read the images of a CVAT file; reasons for omitted shapes are added to `remarks`."""
    with well_formed(f"{path} is not a CVAT file", _EXPORT):
        root = parse_xml(read_text(path, VALUES))
        if root.tag != "annotations" or root.find("image") is None:
            raise ValueError("there is no <image> in <annotations>; export as 'CVAT for images 1.1'")
        images = few_enough(root.findall("image"))
        name, times = Counter(image.get("name") for image in images).most_common(1)[0]
        if times > 1:
            raise ValueError(f"it contains image {shown(str(name))} {times} times")
    for image in images:
        yield _cvat_image(path, image, remarks)


def _cvat_image(path: Path, image: Element, remarks: Counter[str]) -> ForeignImage:
    name = image.get("name", "")
    with well_formed(f"{path}: image {name!r} cannot be read", _EXPORT):
        size, points = _size(image.attrib), dict(_cvat_keypoints(image))
        for shape in image:
            if shape.tag not in ("mask", "polygon", "points", "tag"):
                what = f"a {shape.tag} ({shape.get('label', 'no label')}) of {name}"
                remarks[f"{what}: only masks, polygons and points are read"] += 1
        check_shapes(len(image))
        check_keypoints(points)

    def parts(height: int, width: int) -> Iterator[Part]:
        shapes = [shape for shape in image if shape.tag in ("mask", "polygon")]
        for shape in sorted(shapes, key=lambda shape: int(shape.get("z_order", "0"))):
            mask = None
            with or_left_out(f"a {shape.tag} ({shape.get('label', 'no label')}) of {name}", remarks):
                mask = _cvat_mask(shape, height, width)
            if mask is not None:
                yield shape.get("label", "instrument"), mask

    return ForeignImage(name, parts, points, size=size)


def _cvat_mask(shape: Element, height: int, width: int) -> Bool[np.ndarray, "height width"]:
    if shape.tag == "polygon":
        return mask_of_polygon(_cvat_points(shape), height, width)
    left, top, wide, high = (int(shape.get(key, "")) for key in ("left", "top", "width", "height"))
    if left < 0 or top < 0 or wide < 1 or high < 1 or left + wide > width or top + high > height:
        raise ValueError(f"a mask of {wide} x {high} at {left}, {top} is not inside {width} x {height} pixels")
    runs = [int(run) for run in shape.get("rle", "").split(",")]
    mask = np.zeros((height, width), bool)
    mask[top : top + high, left : left + wide] = mask_of_runs(runs, high, wide, by_columns=False)
    return mask


def _cvat_points(shape: Element) -> np.ndarray:
    rows = [corner.split(",") for corner in shape.get("points", "").split(";")]
    return checked_points([[float(x), float(y)] for x, y in rows])


def _cvat_keypoints(image: Element) -> Iterator[tuple[str, tuple[float, float]]]:
    """Points by label; several points of one shape are numbered."""
    for shape in image.iter("points"):
        if shape.get("outside") == "1":
            continue
        points, label = _cvat_points(shape), shape.get("label", "point")
        for number, (u, v) in enumerate(points, start=1):
            yield (label if len(points) == 1 else f"{label}.{number}"), (float(u), float(v))


def read_surgpose(path: Path, content: Any, remarks: Counter[str]) -> Iterator[ForeignImage]:
    """Read the frames of a keypoint file; `remarks` stays unchanged."""
    del remarks
    with well_formed(f"{path} has no keypoints in the format of SurgPose", "Expected: {frame: {1: [x, y], ...}}."):
        if not isinstance(content, dict) or len(content) > MAX_IMAGES:
            raise ValueError("it has no frames, or too many")
        frames = {int(frame): dict(points or {}) for frame, points in content.items()}
        found = [(frame, _surgpose_points(points)) for frame, points in sorted(frames.items())]
    for frame, points in found:
        yield ForeignImage(f"{path.name} {frame}", keypoints=points, frame=str(frame), camera="")


def _surgpose_points(points: dict) -> dict[str, tuple[float, float]]:
    if len(points) > MAX_KEYPOINTS:
        raise ValueError(f"a frame has {len(points)} keypoints; {MAX_KEYPOINTS} are allowed")
    found = {}
    for name, place in points.items():
        if place is not None:
            u, v = (float(value) + HALF_PIXEL for value in place)
            if not (math.isfinite(u) and math.isfinite(v)):
                raise ValueError(f"keypoint {name} is at {place}")
            found[str(name)] = (u, v)
    return found


_SUFFIXES = (".png", ".bmp")
_OTHER_SUFFIXES = (".tif", ".tiff", ".jpg", ".jpeg")
"""Suffixes used only if a folder and its subfolders have no files of the preferred suffixes, since a folder with both
may contain images besides masks."""
_DEEPEST = 4
MEANINGS = ("labels.json", "mappings.json", "mapping.json", "instrument_type_mapping.json")
_TOOL = "_labels"
_INSTRUMENT = "instrument"
_MAX_UNNAMED = 32
"""Maximum number of unnamed values in an image; more are artefacts of interpolation."""
_SCENE_PARTS = ("instrument", "clasper", "wrist", "shaft")
"""Prefixes of EndoVis 2018 labels that belong to an instrument; all others are anatomy or thread."""


def read_mask_folder(path: Path, remarks: Counter[str], *, confined: bool = False) -> Iterator[ForeignImage]:
    """Read the mask images below a folder; files of the same name in sibling folders belong to the same frame.

    Args:
        remarks: counter of remarks on how files were interpreted, updated during decoding.
        confined: whether links are ignored, and names of values are not searched for above the folder.
    """
    files = mask_files(path, confined=confined)
    if not files:
        known = ", ".join((*_SUFFIXES, *_OTHER_SUFFIXES))
        raise SequenceError(f"{path} has no masks ({known}). Give the folder with the masks.")
    meanings: dict[Path, Any] = {}
    for file in files:
        above = _meaning_file(file, path if confined else path.parent, confined)
        if above is not None and above not in meanings:
            with well_formed(f"{above} cannot be read", "Correct it or remove it."):
                meanings[above] = parse_json(read_text(above, VALUES))
        meaning = None if above is None else meanings[above]
        parts = partial(_parts, file, meaning, remarks)
        yield ForeignImage(file.relative_to(path.parent).as_posix(), parts)


def mask_files(path: Path, *, confined: bool = False) -> list[Path]:
    """Image files below a folder of masks, sorted by frame."""
    # In an export of carts, the folder `links` has the finest labels.
    finest = path / "links" if (path / "labels.json").is_file() and (path / "links").is_dir() else path
    usable = [file for file in _files(finest) if not (confined and file.is_symlink())]
    return [file for file in usable if file.suffix.lower() in _SUFFIXES] or usable


def _files(folder: Path) -> list[Path]:
    found: list[Path] = []
    for place, folders, names in os.walk(folder):
        if len(Path(place).relative_to(folder).parts) >= _DEEPEST:
            folders.clear()
        chosen = [name for name in names if name.lower().endswith((*_SUFFIXES, *_OTHER_SUFFIXES))]
        found += [Path(place) / name for name in chosen if not name.startswith(".")]
        if len(found) > MAX_IMAGES:
            raise SequenceError(f"{folder} has more than {MAX_IMAGES} masks. Give a folder with fewer.")
    # Sorted by frame: each tool has its own sibling folder.
    files = [file for file in found if is_regular(file)]
    return sorted(files, key=lambda file: (file.stem, file.parent.parent.as_posix(), file.as_posix()))


def _meaning_file(file: Path, top: Path, confined: bool) -> Path | None:
    """File with the names of the values, in the mask's folder or a parent folder up to `top`."""
    for folder in file.parents:
        for name in MEANINGS:
            if is_regular(folder / name) and not (confined and (folder / name).is_symlink()):
                return folder / name
        if folder == top:
            break
    return None


def _parts(file: Path, meaning: Any, remarks: Counter[str], height: int, width: int) -> Iterator[Part]:
    del height, width
    image = read_labels(file)
    tool = next((part.removesuffix(_TOOL) for part in file.parts[::-1] if part.endswith(_TOOL)), "")
    if image.lossy and image.mask is None:
        raise SequenceError(
            f"{file} has several colours or grey values, which JPEG compression has changed. Save labels as PNG; JPEG "
            "is read only for masks in black and white."
        )
    yield "", np.zeros(image.colours.shape[:2], bool)
    with well_formed(f"the label names for the values in {file} cannot be read", "Correct them."):
        if isinstance(meaning, list):
            yield from _by_colour(image.colours, meaning, file)
            return
        names = _names(meaning, file.parent.name)
        remarks.update(image.remarks)
        if image.mask is not None and not names:
            if image.mask.any():
                yield tool or _INSTRUMENT, image.mask
        elif image.values is None:
            raise SequenceError(
                f"{file} has colours, but neither its folder nor those above have a labels.json that names them. Add "
                'one in the format of EndoVis 2018: [{"name": ..., "color": [r, g, b]}, ...].'
            )
        else:
            yield from _by_value(image.values, names, tool, file)


def _by_colour(image: np.ndarray, meaning: list[Any], file: Path) -> Iterator[Part]:
    """Labels of instruments, given entries with `name` and `color`."""
    rows = [(tuple(map(int, entry["color"])), str(entry["name"])) for entry in meaning]
    known = {r * 65536 + g * 256 + b: name for (r, g, b), name in (row for row in rows if len(row[0]) == 3)}
    code = image.astype(np.int64) @ (65536, 256, 1)
    values = [int(value) for value in np.unique(code)]
    if unknown := set(values) - known.keys():
        raise SequenceError(f"{file} has the colour #{min(unknown):06x}, which labels.json does not list. Add it.")
    for value in values:
        if known[value].lower().startswith(_SCENE_PARTS):
            yield known[value], code == value


def _by_value(image: np.ndarray, names: Mapping[int, str], tool: str, file: Path) -> Iterator[Part]:
    values = [int(value) for value in np.unique(image) if value]
    unknown = [value for value in values if value not in names]
    if len(unknown) > _MAX_UNNAMED:
        raise SequenceError(
            f"{file} has {len(unknown)} values without a name, {values[0]} to {values[-1]}, as after resizing with "
            "interpolation. Resize labels by nearest neighbour, or name each value in labels.json."
        )
    for value in values:
        name = names.get(value, f"label {value}")
        if name.lower() not in BACKGROUND:
            yield f"{tool}.{name}" if tool else name, image == value


def _names(meaning: Any, folder: str) -> dict[int, str]:
    """Grey value -> name, from a file with either values or names as keys."""
    if not isinstance(meaning, dict):
        return {}
    if isinstance(inner := meaning.get(folder), dict):
        meaning = inner
    names: dict[int, str] = {}
    for key, value in meaning.items():
        if str(key).isdecimal() and isinstance(value, str):
            names[int(key)] = value
        elif isinstance(value, int):
            names[value] = str(key)
    return {value: name for value, name in names.items() if value}
