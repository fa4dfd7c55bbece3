"""Reader of Label Studio's JSON export: polygons, rectangles, ellipses, brush masks and keypoints of images."""

import math
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

import numpy as np
from jaxtyping import Bool, UInt8

from ...wording import listed, shown
from ..importing.found import well_formed
from .images import ForeignImage, Part, check_keypoints, few_enough, named_keypoints, or_left_out
from .shapes import check_shapes, check_size, checked_points, corners_of_box, mask_of_ellipse, mask_of_polygon

MAX_BRUSH_RUNS = 1_000_000
"""Maximum number of runs of a brush mask."""
_IMAGE = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".gif")
_UPLOAD_PREFIX = re.compile(r"[0-9a-f]{8}-(?=.)")
"""Prefix of the names of uploaded files."""
_CHANNELS, _WORD_BITS, _HEADER_BITS = 4, 8, 53
"""Brush masks encode red, green, blue and opacity of each pixel, in words of eight bits. The header contains the number
of words (32 bits), the bits per word minus one (5 bits), and four bit lengths of counts minus one (4 bits each)."""
_LENGTH_BITS = 0x237F
"""The four bit lengths of counts (3, 4, 8 and 16) minus one, as written by Label Studio."""
_LONGEST, _RUN_BITS, _REPEATED_LONG = 2**16, 27, 0b111 << 24
"""Maximum number of words of a run with a 16-bit count, bits of such a run, and its prefix: repeated, fourth length."""


def is_label_studio(content: Any) -> bool:
    """Whether parsed JSON is an export of Label Studio, or a single task of one."""
    tasks = content if isinstance(content, list) else [content]
    return bool(tasks) and all(
        isinstance(task, dict) and isinstance(task.get("data"), dict) and {"annotations", "predictions"} & task.keys()
        for task in tasks[:100]
    )


def is_minimal(content: Any) -> bool:
    """Whether parsed JSON is an export as JSON-MIN, which lacks the names of the controls."""
    return (
        isinstance(content, list)
        and bool(content)
        and all(isinstance(task, dict) and {"annotation_id", "annotator"} <= task.keys() for task in content[:100])
    )


def read_label_studio(path: Path, content: Any, remarks: Counter[str]) -> Iterator[ForeignImage]:
    """Read the images of an export; reasons for omitted regions are added to `remarks`."""
    with well_formed(f"{path} is not an export of Label Studio", "Export it as JSON."):
        tasks = few_enough(content if isinstance(content, list) else [content])
        images: list[tuple[str, Any]] = []
        for task in tasks:
            images += _images_of_task(task, remarks)
        few_enough(images)
    for name, regions in images:
        with well_formed(f"{path}: image {shown(name)} cannot be read", "Export it again."):
            image = _image(name, regions, remarks)
        yield image


def _images_of_task(task: Any, remarks: Counter[str]) -> list[tuple[str, Any]]:
    """Name of each image of a task, and its regions."""
    what = f"task {task.get('id', '(without id)')}"
    annotation = _chosen(task, what, remarks)
    if annotation is None:
        return []
    regions: dict[str, list[Any]] = {}
    for region in annotation["result"]:
        if isinstance(region, dict) and "to_name" in region and isinstance(region.get("value"), dict):
            regions.setdefault(str(region["to_name"]), []).append(region)
    found = []
    for control, own in regions.items():
        with or_left_out(f"{what}, image {shown(control)},", remarks):
            found.append((_image_name(task["data"], control), own))
    return found


def _chosen(task: Any, what: str, remarks: Counter[str]) -> Any:
    """The annotation of a task to read: the ground truth, otherwise the newest; None without annotations."""
    submitted = [each for each in task.get("annotations") or [] if not each.get("was_cancelled")]
    if not submitted:
        if task.get("predictions"):
            remarks["tasks that have only predictions are left out; accept them in Label Studio"] += 1
        return None
    truths = [each for each in submitted if each.get("ground_truth")]
    if len(submitted) > 1:
        which = "the ground truth" if len(truths) == 1 else "the newest"
        remarks[f"{what} has {len(submitted)} annotations; {which} is used"] += 1
    return max(truths or submitted, key=lambda each: str(each.get("updated_at") or each.get("created_at") or ""))


def _image_name(data: dict[str, Any], control: str) -> str:
    """Name of the image of a control (`<Image name=...>`), from the fields of its task."""
    names = {key: file_of_address(value) for key, value in data.items() if isinstance(value, str)}
    images = {key: name for key, name in names.items() if name.lower().endswith(_IMAGE)}
    chosen = next((key for key in (control, "image") if key in images), None)
    if len(images) == 1:
        chosen = next(iter(images))
    elif control not in images and len(images) > 1:
        raise ValueError(
            f"its task has image fields {listed(images, 4)}, but none has the name of its Image tag; rename one"
        )
    if chosen is None:
        raise ValueError(f"its task has no image file in the fields {listed(data, 4)}")
    return images[chosen]


def file_of_address(address: str) -> str:
    """Path of the file in a URL or path, without the prefix that Label Studio adds to uploads; addresses of local
    files have the path in their query."""
    try:
        parts = urlsplit(address)
    except ValueError:
        return ""
    path = parse_qs(parts.query).get("d", [unquote(parts.path)])[0].replace("\\", "/")
    folder, _, name = path.rpartition("/")
    uploaded = "upload" in folder.split("/") or not folder
    name = _UPLOAD_PREFIX.sub("", name, count=1) if uploaded else name
    return "/".join(part for part in (*folder.split("/"), name) if part not in ("", ".", ".."))


def _image(name: str, regions: list[Any], remarks: Counter[str]) -> ForeignImage:
    check_shapes(len(regions))
    labels: dict[str, str] = {}
    """Region -> label; controls without labels have them in another result of the same region."""
    for region in regions:
        own = [values for key, values in region["value"].items() if key.endswith("labels") and values]
        if own and isinstance(own[0], list):
            labels.setdefault(_region(region), str(own[0][0]))
    shapes, points, sizes, done = [], [], set(), set()
    for region in regions:
        value, kind = region["value"], str(region.get("type", "")).removesuffix("labels") or "labels"
        if not _GEOMETRY & value.keys() or (_region(region), *sorted(value.keys() & _GEOMETRY)) in done:
            continue
        if region.get("id") is not None:
            done.add((_region(region), *sorted(value.keys() & _GEOMETRY)))
        label = labels.get(_region(region), "instrument")
        what = f"a {kind} ({label}) of {name}"
        with or_left_out(what, remarks):
            if region.get("image_rotation"):
                raise ValueError(f"the image was rotated by {region['image_rotation']} degrees while it was annotated")
            size = check_size(int(region["original_height"]), int(region["original_width"]))
            sizes.add(size)
            if {"x", "y"} <= value.keys() and not {"height", "radiusX"} & value.keys():
                (position,) = _pixels([[value["x"], value["y"]]], size)
                points.append((label, None, (float(position[0]), float(position[1]))))
            else:
                shapes.append((what, label, value))
    if len(sizes) > 1:
        raise ValueError(f"its regions have {len(sizes)} image sizes")
    keypoints = named_keypoints(points)
    check_keypoints(keypoints)

    def parts(height: int, width: int) -> Iterator[Part]:
        for what, label, value in shapes:
            mask = None
            with or_left_out(what, remarks):
                mask = _mask(value, height, width)
            if mask is not None:
                yield label, mask

    return ForeignImage(name, parts, keypoints, size=next(iter(sizes), None))


_GEOMETRY = {"points", "rle", "x", "y", "imageDataURL"}


def _region(region: Any) -> str:
    return str(region["id"]) if region.get("id") is not None else f"(without id) {id(region)}"


def _pixels(values: Any, size: tuple[int, int]) -> np.ndarray:
    """Points [px] from percentages of the image's width and height."""
    return checked_points(np.asarray(values, np.float64) * (size[1] / 100, size[0] / 100))


def _mask(value: dict[str, Any], height: int, width: int) -> Bool[np.ndarray, "height width"]:
    if "rle" in value:
        return opacity_of_brush(value["rle"], height, width) > 0
    size, angle = (height, width), math.radians(float(value.get("rotation") or 0))
    if "points" in value:
        if value.get("closed") is False:
            raise ValueError("it is not closed")
        return mask_of_polygon(_pixels(value["points"], size), height, width)
    if "radiusX" in value:
        centre, radii = _pixels([[value["x"], value["y"]], [value["radiusX"], value["radiusY"]]], size)
        return mask_of_ellipse(centre, radii, angle, height, width)
    if "height" in value:
        corner, extent = _pixels([[value["x"], value["y"]], [value["width"], value["height"]]], size)
        return mask_of_polygon(corners_of_box(corner, extent, angle), height, width)
    raise ValueError("its type is not supported; draw polygons, rectangles, ellipses or brush masks")


def brush_of_mask(mask: Bool[np.ndarray, "height width"]) -> list[int]:
    """Bytes of the run-length encoding of a brush mask, as Label Studio stores them; masked pixels are opaque."""
    words = np.repeat(mask.ravel(), _CHANNELS)
    starts = np.flatnonzero(np.diff(words, prepend=~words[:1]))
    # Runs are divided, since a length has 16 bits at most.
    starts = np.union1d(starts, np.arange(0, len(words), _LONGEST))
    lengths = np.diff(starts, append=len(words))
    runs = _REPEATED_LONG | (lengths - 1) << _WORD_BITS | np.where(words[starts], 255, 0)
    head = (len(words) << 5 | _WORD_BITS - 1) << 16 | _LENGTH_BITS
    bits = [int(bit) for bit in f"{head:0{_HEADER_BITS}b}"]
    body = runs[:, None] >> np.arange(_RUN_BITS - 1, -1, -1) & 1
    return np.packbits(np.concatenate([bits, body.ravel()]).astype(np.uint8)).tolist()


def opacity_of_brush(codes: Any, height: int, width: int) -> UInt8[np.ndarray, "height width"]:
    """Opacity of each pixel of a brush mask, from the bytes of its run-length encoding; `ValueError` for encodings that
    do not have the size of the image, are truncated, or have too many runs."""
    if not isinstance(codes, list):
        raise ValueError("its run lengths are not a list of bytes")
    content = bytes(codes)
    total = _CHANNELS * height * width
    head = int.from_bytes(content[:7].ljust(7, b"\0"), "big") >> 3
    count, bits, sizes = head >> 21, (head >> 16 & 31) + 1, [(head >> shift & 15) + 1 for shift in (12, 8, 4, 0)]
    if count != total:
        raise ValueError(f"the run lengths have {count} values, not four for each of {width} x {height} pixels")
    if bits != _WORD_BITS:
        raise ValueError(f"its values have {bits} bits instead of {_WORD_BITS}")
    padded = content + bytes(8)
    values = np.empty(total, np.uint8)
    place, filled, runs = _HEADER_BITS, 0, 0
    while filled < total:
        runs += 1
        if runs > MAX_BRUSH_RUNS:
            raise ValueError(f"it has more than {MAX_BRUSH_RUNS} runs")
        window = int.from_bytes(padded[place >> 3 : (place >> 3) + 8], "big") >> (24 - (place & 7)) & (1 << 40) - 1
        repeated, length = window >> 39, sizes[window >> 37 & 3]
        end = filled + 1 + (window >> (37 - length) & (1 << length) - 1)
        if repeated:
            values[filled:end] = window >> (37 - length - _WORD_BITS) & 0xFF
        place += 3 + length + _WORD_BITS * (1 if repeated else end - filled)
        if end > total or place > 8 * len(content):
            raise ValueError("the run lengths do not cover the image exactly")
        if not repeated:
            first, shift = place - _WORD_BITS * (end - filled), place & 7
            words = np.frombuffer(padded, np.uint8, end - filled + 1, first >> 3).astype(np.uint16)
            values[filled:end] = (words[:-1] << shift | words[1:] >> (8 - shift)) & 0xFF
        filled = end
    return values.reshape(height, width, _CHANNELS)[..., 3]
