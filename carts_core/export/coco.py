"""COCO instance segmentation: `annotations/instances_default.json` with a run-length mask per object."""

import json
from collections.abc import Callable, Iterable
from typing import Any

from jaxtyping import Bool
from numpy import ndarray

from ..files import OutputPath, write_text
from .dataset import Dataset, View
from .monitor import Monitor
from .rle import bounding_box, coco_rle

Annotation = dict[str, Any]


def write_coco(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write the dataset in COCO's format; masks lose nothing."""

    def annotations(view: View) -> Iterable[Annotation]:
        for category, mask in dataset.instances(view):
            yield mask_annotation(view, category.id, mask)

    categories = [{"id": c.id, "name": c.name, "supercategory": c.arm} for c in dataset.categories]
    write_annotations(dataset, folder, monitor, "instances", categories, annotations)


def mask_annotation(view: View, category_id: int, mask: Bool[ndarray, "height width"]) -> Annotation:
    """An object of a view, without its number; the box of one that is not in the image is empty."""
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
    """Write images, and the file of annotations that CVAT and Datumaro look for under this name.

    Args:
        dataset, folder, monitor: what is written where, and who hears of progress.
        kind: `instances` or `person_keypoints`, as COCO names its files.
        categories: as COCO has them.
        annotate: the objects of a view, without their numbers.
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
