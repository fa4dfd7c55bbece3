"""Annotation formats: PNG masks, COCO instances and keypoints, CVAT, Datumaro, Pascal VOC and YOLO."""

import json
from collections.abc import Callable, Iterable, Mapping
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Bool, UInt8
from numpy import ndarray
from PIL import Image

from ..errors import CartsError
from ..files import OutputPath, output_stream, write_bytes, write_text
from ..model.keypoints import Keypoint, keypoints, project_keypoints
from ..settings import Parts
from .dataset import Category, Dataset, Monitor, View
from .encodings import bounding_box, coco_rle, label_png, mask_png, polygons, row_runs

_KINDS: tuple[Parts, ...] = ("arms", "parts", "links")


def write_masks(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write PNG masks into `binary`, `arms`, `parts` and `links`; `labels.json` maps pixel values to categories."""
    for view in dataset.views(monitor):
        if dataset.images == "copied":
            dataset.write_image_as(view, folder / "images", view.name)
        write_bytes(folder / "binary" / f"{view.name}.png", mask_png(view.link_ids >= 0))
        for kind in _KINDS:
            write_bytes(folder / kind / f"{view.name}.png", label_png(dataset.label_image(view, kind)))
    meaning = {"binary": {0: "background", 255: "arm"}}
    for kind in _KINDS:
        meaning[kind] = {0: "background"} | {category.id: category.name for category in dataset.categories_of(kind)}
    write_text(folder / "labels.json", json.dumps(meaning, indent=1, ensure_ascii=False))


Annotation = dict[str, Any]


def write_coco(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write the dataset in COCO format, with lossless masks."""

    def annotations(view: View) -> Iterable[Annotation]:
        for category, mask in dataset.instances(view):
            yield mask_annotation(view, category.id, mask)

    categories = [{"id": c.id, "name": c.name, "supercategory": c.arm} for c in dataset.categories]
    write_annotations(dataset, folder, monitor, "instances", categories, annotations)


def mask_annotation(view: View, category_id: int, mask: Bool[ndarray, "height width"]) -> Annotation:
    """Annotation of an object in a view, without its id; the box of an invisible object is empty."""
    return {
        "image_id": view.id,
        "category_id": category_id,
        "segmentation": coco_rle(mask),
        "area": int(mask.sum()),
        "bbox": list(bounding_box(mask)) if mask.any() else [0, 0, 0, 0],
        "iscrowd": 0,
    }


def write_annotations(
    dataset: Dataset,
    folder: OutputPath,
    monitor: Monitor,
    kind: str,
    categories: list[dict[str, Any]],
    annotate: Callable[[View], Iterable[Annotation]],
) -> None:
    """Write images and a COCO annotation file with the name that CVAT and Datumaro expect.

    Args:
        kind: `instances` or `person_keypoints`, the prefix of COCO's file names.
        categories: categories in COCO format.
        annotate: returns the annotations of a view, without ids.
    """
    images, annotations = [], []
    for view in dataset.views(monitor):
        images.append(
            {
                "id": view.id,
                "file_name": dataset.write_image(view, folder / "images"),
                "width": view.camera.width,
                "height": view.camera.height,
                "frame": view.frame.frame_id,
                "camera": view.camera.name,
                "source": view.frame.source,
                **({"painted": True} if view.painted else {}),
            }
        )
        for annotation in annotate(view):
            annotations.append({"id": len(annotations) + 1, **annotation})
    content = {
        "info": {"description": dataset.sequence.name, "image_folder": str(dataset.image_folder)},
        "licenses": [],
        "images": images,
        "annotations": annotations,
        "categories": categories,
    }
    write_text(folder / "annotations" / f"{kind}_default.json", json.dumps(content, ensure_ascii=False))


_OUTSIDE, _HIDDEN, _VISIBLE = 0, 1, 2
"""Visibility flags of COCO: not labelled, labelled but not visible, labelled and visible."""


def write_coco_keypoints(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write keypoints, mask and box of every arm in COCO format, with one category per arm."""
    points = {arm.name: keypoints(arm) for arm in dataset.scene.arms}

    def annotations(view: View) -> Iterable[Annotation]:
        for category in dataset.arms:
            yield from _annotations(dataset, view, category, points[category.arm])

    categories = [_category(category, points[category.arm]) for category in dataset.arms]
    # CVAT and Datumaro expect "person" in the name for any kind of object.
    write_annotations(dataset, folder, monitor, "person_keypoints", categories, annotations)


def _category(category: Category, points: tuple[Keypoint, ...]) -> dict[str, Any]:
    names = [point.name for point in points]
    tips = [number for number, name in enumerate(names, start=1) if name.endswith(" tip")]
    joints = [number for number in range(1, len(names) + 1) if number not in tips]
    # The joints are a chain along the instrument; every tip is connected to its nearest joint.
    skeleton = [*pairwise(joints), *((tip, joints[0]) for tip in tips if joints)]
    return {
        "id": category.id,
        "name": category.name,
        "supercategory": category.arm,
        "keypoints": names,
        "skeleton": [list(edge) for edge in skeleton],
    }


def _annotations(
    dataset: Dataset, view: View, category: Category, points: tuple[Keypoint, ...]
) -> Iterable[Annotation]:
    """Annotation of an arm in a view; empty if the image contains none of its pixels or keypoints."""
    mask = dataset.label_image(view, "arms") == category.id
    pixels = project_keypoints(dataset.scene, dataset.state(view.frame), points, view.camera.name).double().numpy()
    values: list[float] = []
    for u, v in pixels:
        inside = bool(np.isfinite([u, v]).all()) and 0 <= u < view.camera.width and 0 <= v < view.camera.height
        if not inside:
            values += [0.0, 0.0, _OUTSIDE]
            continue
        values += [round(float(u), 3), round(float(v), 3), _VISIBLE if mask[int(v), int(u)] else _HIDDEN]
    labelled = sum(flag > 0 for flag in values[2::3])
    if labelled or mask.any():
        yield {**mask_annotation(view, category.id, mask), "keypoints": values, "num_keypoints": labelled}


def _element(tag: str, content: object) -> ElementTree.Element:
    """XML element with a text, or with one child per entry of a mapping and one per item of a list."""
    element = ElementTree.Element(tag)
    if isinstance(content, Mapping):
        for name, value in content.items():
            element.extend(_element(name, one) for one in (value if isinstance(value, list) else [value]))
    else:
        element.text = str(content)
    return element


def _xml(root: ElementTree.Element) -> bytes:
    """Serialize an element as indented XML."""
    ElementTree.indent(root, " ")
    return ElementTree.tostring(root, encoding="utf-8")


def write_cvat(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write the dataset in CVAT format, with lossless masks."""
    labels = [{"name": category.name, "type": "mask", "attributes": ""} for category in dataset.categories]
    task = {
        "name": dataset.sequence.name,
        "size": len(dataset.steps),
        "mode": "annotation",
        "labels": {"label": labels},
    }
    root = _element("annotations", {"version": "1.1", "meta": {"task": task}})
    for view in dataset.views(monitor):
        size = {"width": str(view.camera.width), "height": str(view.camera.height)}
        name = dataset.write_image(view, folder / "images")
        image = ElementTree.SubElement(root, "image", {"id": str(view.id - 1), "name": name, **size})
        for category, mask in dataset.instances(view):
            left, top, width, height = bounding_box(mask)
            runs = row_runs(mask[top : top + height, left : left + width])
            attributes = {"label": category.name, "source": "auto", "occluded": "0", "rle": ", ".join(map(str, runs))}
            box = {"left": str(left), "top": str(top), "width": str(width), "height": str(height), "z_order": "0"}
            ElementTree.SubElement(image, "mask", {**attributes, **box})
    write_bytes(folder / "annotations.xml", b"<?xml version='1.0' encoding='utf-8'?>\n" + _xml(root))


_IMAGE = 2
"""Datumaro's media type of still images."""


def write_datumaro(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write the dataset in Datumaro format, with lossless masks."""
    items = []
    for view in dataset.views(monitor):
        file = dataset.write_image(view, folder / "images" / "default")
        annotations = [
            {
                **{"id": number, "type": "mask", "attributes": {}, "group": 0},
                **{"label_id": category.id - 1, "rle": coco_rle(mask), "z_order": 0},
            }
            for number, (category, mask) in enumerate(dataset.instances(view))
        ]
        item = {"id": str(PurePosixPath(file).with_suffix("")), "annotations": annotations}
        item["attr"] = {"frame": view.frame.frame_id, "camera": view.camera.name, "source": view.frame.source}
        item["image"] = {"path": file, "size": [view.camera.height, view.camera.width]}
        items.append(item)
    labels = [{"name": category.name, "parent": "", "attributes": []} for category in dataset.categories]
    content = {
        "dm_format_version": "1.0",
        "media_type": _IMAGE,
        "infos": {},
        "categories": {"label": {"labels": labels, "label_groups": [], "attributes": []}},
        "items": items,
    }
    write_text(folder / "annotations" / "default.json", json.dumps(content, ensure_ascii=False))


_LISTS = ("Main", "Segmentation")
"""Folders in `ImageSets` with image lists; each contains all images, since there is no split."""
_MOST_CATEGORIES = 254
"""Largest number of categories; 0 is the background and 255 is VOC's void."""


def write_voc(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write the dataset in Pascal VOC format, with lossless label images; images keep their file format."""
    if len(dataset.categories) > _MOST_CATEGORIES:
        raise CartsError(f"Pascal VOC holds {_MOST_CATEGORIES} categories, not {len(dataset.categories)}. Export COCO.")
    for view in dataset.views(monitor):
        stem = dataset.stems[view.id - 1]
        file = dataset.write_image_as(view, folder / "JPEGImages", stem)
        objects = np.zeros(view.link_ids.shape, np.uint8)
        entries = []
        for number, (category, mask) in enumerate(dataset.instances(view), start=1):
            objects[mask] = number
            entries.append(_object(category, mask))
        size = {"width": view.camera.width, "height": view.camera.height, "depth": 3}
        content = {"folder": "JPEGImages", "filename": file, "size": size, "segmented": 1, "object": entries}
        _write_palette(folder / "SegmentationClass" / f"{stem}.png", dataset.label_image(view))
        _write_palette(folder / "SegmentationObject" / f"{stem}.png", objects)
        write_bytes(folder / "Annotations" / f"{stem}.xml", _xml(_element("annotation", content)))
    names = "".join(f"{stem}\n" for stem in dataset.stems)
    for name in _LISTS:
        write_text(folder / "ImageSets" / name / "trainval.txt", names)
    colors = [",".join(map(str, color)) for color in _palette().tolist()]
    names = ["background", *(_name(category) for category in dataset.categories)]
    lines = ["# label:color_rgb:parts:actions\n", *(f"{name}:{colors[n]}::\n" for n, name in enumerate(names))]
    write_text(folder / "labelmap.txt", "".join(lines))


def _object(category: Category, mask: np.ndarray) -> dict[str, Any]:
    """VOC entry of an object; VOC counts pixels from 1."""
    left, top, width, height = bounding_box(mask)
    outlines = [
        {f"{'xy'[axis]}{number + 1}": value + 1 for (number, axis), value in np.ndenumerate(polygon)}
        for polygon in polygons(mask)
    ]
    return {
        "name": _name(category),
        **{"pose": "Unspecified", "truncated": 0, "difficult": 0, "occluded": 0},
        "bndbox": {"xmin": left + 1, "ymin": top + 1, "xmax": left + width, "ymax": top + height},
        "polygon": outlines,
    }


def _name(category: Category) -> str:
    return category.name.replace(":", "_")  # separates the columns of labelmap.txt


def _palette() -> UInt8[np.ndarray, "256 3"]:
    """VOC's colour map: the bits of a label, from the lowest, set red, green and blue in turn, from their highest
    bit."""
    labels = np.arange(256)[:, None]
    bits = (labels >> np.arange(8)) & 1
    return np.stack(
        [sum(bits[:, 3 * n + c] << (7 - n) for n in range(3) if 3 * n + c < 8) for c in range(3)], 1
    ).astype(np.uint8)


def _write_palette(path: OutputPath, labels: UInt8[np.ndarray, "height width"]) -> None:
    image = Image.fromarray(labels, mode="L")
    image.putpalette(_palette().tobytes())  # converts grey values to palette indices
    with output_stream(path) as stream:
        image.save(stream, format="PNG")


_INTO_PIXEL = 0.25
"""Offset added to pixel indices [px], so that readers recover the pixel both by rounding (supervision) and by
truncation (Ultralytics).
"""


def write_yolo(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write the dataset in YOLO format; each connected visible region of an arm is an object."""
    for view in dataset.views(monitor):
        stem = dataset.stems[view.id - 1]
        dataset.write_image_as(view, folder / "images", stem)
        size = (view.camera.width, view.camera.height)
        lines = []
        for category, mask in dataset.instances(view):
            for polygon in polygons(mask):
                numbers = " ".join(f"{value:.6f}" for value in ((polygon + _INTO_PIXEL) / size).ravel())
                lines.append(f"{category.id - 1} {numbers}\n")
        write_text(folder / "labels" / f"{stem}.txt", "".join(lines))
    names = json.dumps([category.name for category in dataset.categories], ensure_ascii=False)  # JSON is valid YAML
    text = f"# Not split: both name all images.\ntrain: images\nval: images\nnames: {names}\n"
    write_text(folder / "data.yaml", text)
