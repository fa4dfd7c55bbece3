"""CVAT for images 1.1: `images/`, and `annotations.xml` with run-length masks (CVAT reads these since 2.3)."""

from xml.etree import ElementTree

from ..files import OutputPath, write_bytes
from .dataset import Dataset
from .monitor import Monitor
from .rle import bounding_box, row_runs


def write_cvat(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write the dataset in CVAT's format; masks lose nothing."""
    root = ElementTree.Element("annotations")
    _text(root, "version", "1.1")
    _add_meta(root, dataset)
    for view in dataset.views(monitor):
        size = {"width": str(view.camera.width), "height": str(view.camera.height)}
        name = dataset.write_image(view, folder / "images")
        image = ElementTree.SubElement(root, "image", {"id": str(view.id - 1), "name": name, **size})
        for category, mask in dataset.instances(view):
            left, top, width, height = bounding_box(mask)
            runs = row_runs(mask[top : top + height, left : left + width])
            attributes = {
                "label": category.name,
                "source": "auto",
                "occluded": "0",
                "rle": ", ".join(map(str, runs)),
                "left": str(left),
                "top": str(top),
                "width": str(width),
                "height": str(height),
                "z_order": "0",
            }
            ElementTree.SubElement(image, "mask", attributes)
    ElementTree.indent(root, " ")
    content = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    write_bytes(folder / "annotations.xml", content)


def _add_meta(root: ElementTree.Element, dataset: Dataset) -> None:
    task = ElementTree.SubElement(ElementTree.SubElement(root, "meta"), "task")
    _text(task, "name", dataset.sequence.name)
    _text(task, "size", str(len(dataset.steps)))
    _text(task, "mode", "annotation")
    labels = ElementTree.SubElement(task, "labels")
    for category in dataset.categories:
        label = ElementTree.SubElement(labels, "label")
        _text(label, "name", category.name)
        _text(label, "type", "mask")
        ElementTree.SubElement(label, "attributes")


def _text(parent: ElementTree.Element, tag: str, text: str) -> None:
    ElementTree.SubElement(parent, tag).text = text
