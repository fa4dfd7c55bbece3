"""YOLO segmentation: `images/`, `labels/` with a line per polygon, and `data.yaml`."""

import json

from ..files import OutputPath, write_text
from .dataset import Dataset
from .monitor import Monitor
from .polygons import polygons

_INTO_PIXEL = 0.25
"""Added to a pixel's number [px], so that a reader finds that pixel whether it rounds (supervision) or cuts off the
fraction (Ultralytics)."""


def write_yolo(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write the dataset in YOLO's format: a visible part of an arm that stands alone is an object of its own."""
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
    names = json.dumps([category.name for category in dataset.categories], ensure_ascii=False)  # JSON is YAML
    text = f"# Not split: both name all images.\ntrain: images\nval: images\nnames: {names}\n"
    write_text(folder / "data.yaml", text)
