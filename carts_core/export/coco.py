"""COCO instance segmentation: `images/`, and `annotations/instances_default.json` with a run-length mask per object."""

import json

from ..files import OutputPath, write_text
from .dataset import Dataset
from .monitor import Monitor
from .rle import bounding_box, coco_rle


def write_coco(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write the dataset in COCO's format; masks lose nothing."""
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
            }
        )
        for category, mask in dataset.instances(view):
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": view.id,
                    "category_id": category.id,
                    "segmentation": coco_rle(mask),
                    "area": int(mask.sum()),
                    "bbox": list(bounding_box(mask)),
                    "iscrowd": 0,
                }
            )
    categories = [{"id": c.id, "name": c.name, "supercategory": c.arm} for c in dataset.categories]
    content = {
        "info": {"description": dataset.sequence.name},
        "licenses": [],
        "images": images,
        "annotations": annotations,
        "categories": categories,
    }
    write_text(folder / "annotations" / "instances_default.json", json.dumps(content, ensure_ascii=False))
