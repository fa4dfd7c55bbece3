"""Datumaro's own format, version 1.0: `images/default/`, and `annotations/default.json` with run-length masks."""

import json
from pathlib import PurePosixPath

from ..files import OutputPath, write_text
from .dataset import Dataset
from .monitor import Monitor
from .rle import coco_rle

_IMAGE = 2
"""Datumaro's media type of still images."""


def write_datumaro(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write the dataset in Datumaro's format; masks lose nothing."""
    items = []
    for view in dataset.views(monitor):
        file = dataset.write_image(view, folder / "images" / "default")
        annotations = [
            {
                "id": number,
                "type": "mask",
                "attributes": {},
                "group": 0,
                "label_id": category.id - 1,
                "rle": coco_rle(mask),
                "z_order": 0,
            }
            for number, (category, mask) in enumerate(dataset.instances(view))
        ]
        items.append(
            {
                "id": str(PurePosixPath(file).with_suffix("")),
                "annotations": annotations,
                "attr": {"frame": view.frame.frame_id, "camera": view.camera.name, "source": view.frame.source},
                "image": {"path": file, "size": [view.camera.height, view.camera.width]},
            }
        )
    labels = [{"name": category.name, "parent": "", "attributes": []} for category in dataset.categories]
    content = {
        "dm_format_version": "1.0",
        "media_type": _IMAGE,
        "infos": {},
        "categories": {"label": {"labels": labels, "label_groups": [], "attributes": []}},
        "items": items,
    }
    write_text(folder / "annotations" / "default.json", json.dumps(content, ensure_ascii=False))
