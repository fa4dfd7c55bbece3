"""Pascal VOC: `JPEGImages`, `Annotations` with boxes and polygons, and label images in VOC's colours.

Class names stand in `labelmap.txt`, as Datumaro and CVAT look for them. Polygons are those of supervision's reader.
"""

from collections.abc import Mapping
from xml.etree import ElementTree

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from ..errors import CartsError
from ..files import OutputPath, output_stream, write_bytes, write_text
from .dataset import Category, Dataset, View
from .monitor import Monitor
from .polygons import polygons
from .rle import bounding_box

_LISTS = ("Main", "Segmentation")
"""Folders in `ImageSets` where lists of the images stand; there is no split, so each is one list of all."""
_MOST_CATEGORIES = 254
"""0 is the background and 255 is VOC's void."""


def write_voc(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write the dataset in Pascal VOC's format; label images lose nothing, and images are copies of any kind.

    Raises:
        CartsError: there are more categories than VOC's label images can tell apart.
    """
    if len(dataset.categories) > _MOST_CATEGORIES:
        raise CartsError(f"Pascal VOC holds {_MOST_CATEGORIES} categories, not {len(dataset.categories)}. Export COCO.")
    for view in dataset.views(monitor):
        stem = dataset.stems[view.id - 1]
        file = dataset.write_image_as(view, folder / "JPEGImages", stem)
        labels, objects = dataset.label_image(view), np.zeros(view.link_ids.shape, np.uint8)
        root = _annotation(view, file)
        for number, (category, mask) in enumerate(dataset.instances(view), start=1):
            objects[mask] = number
            _add_object(root, category, mask)
        _write_palette(folder / "SegmentationClass" / f"{stem}.png", labels)
        _write_palette(folder / "SegmentationObject" / f"{stem}.png", objects)
        ElementTree.indent(root, " ")
        write_bytes(folder / "Annotations" / f"{stem}.xml", ElementTree.tostring(root, encoding="utf-8"))
    names = "".join(f"{stem}\n" for stem in dataset.stems)
    for name in _LISTS:
        write_text(folder / "ImageSets" / name / "trainval.txt", names)
    _write_label_map(folder / "labelmap.txt", dataset)


def _annotation(view: View, file: str) -> ElementTree.Element:
    root = ElementTree.Element("annotation")
    _texts(root, {"folder": "JPEGImages", "filename": file})
    size = {"width": view.camera.width, "height": view.camera.height, "depth": 3}
    _texts(ElementTree.SubElement(root, "size"), size)
    _texts(root, {"segmented": 1})
    return root


def _add_object(root: ElementTree.Element, category: Category, mask: np.ndarray) -> None:
    """An object; VOC counts pixels from 1."""
    left, top, width, height = bounding_box(mask)
    object_ = ElementTree.SubElement(root, "object")
    _texts(object_, {"name": _name(category), "pose": "Unspecified", "truncated": 0, "difficult": 0, "occluded": 0})
    box = {"xmin": left + 1, "ymin": top + 1, "xmax": left + width, "ymax": top + height}
    _texts(ElementTree.SubElement(object_, "bndbox"), box)
    for polygon in polygons(mask):
        points = {f"{'xy'[axis]}{number + 1}": value + 1 for (number, axis), value in np.ndenumerate(polygon)}
        _texts(ElementTree.SubElement(object_, "polygon"), points)


def _texts(parent: ElementTree.Element, values: Mapping[str, object]) -> None:
    for tag, value in values.items():
        ElementTree.SubElement(parent, tag).text = str(value)


def _name(category: Category) -> str:
    return category.name.replace(":", "_")  # separates the columns of labelmap.txt


def _palette() -> UInt8[np.ndarray, "256 3"]:
    """VOC's colours: the bits of a label, from the lowest, fill red, green and blue in turn from their highest bit."""
    labels = np.arange(256)[:, None]
    bits = (labels >> np.arange(8)) & 1
    return np.stack(
        [sum(bits[:, 3 * n + c] << (7 - n) for n in range(3) if 3 * n + c < 8) for c in range(3)], 1
    ).astype(np.uint8)


def _write_palette(path: OutputPath, labels: UInt8[np.ndarray, "height width"]) -> None:
    image = Image.fromarray(labels, mode="L")
    image.putpalette(_palette().tobytes())  # turns grey values into numbers of colours
    with output_stream(path) as stream:
        image.save(stream, format="PNG")


def _write_label_map(path: OutputPath, dataset: Dataset) -> None:
    colors = [",".join(map(str, color)) for color in _palette().tolist()]
    names = ["background", *(_name(category) for category in dataset.categories)]
    lines = ["# label:color_rgb:parts:actions\n", *(f"{name}:{colors[n]}::\n" for n, name in enumerate(names))]
    write_text(path, "".join(lines))
