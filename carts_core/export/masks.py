"""PNG masks: binary, by arm and by link."""

import json

from ..files import OutputPath, write_bytes, write_text
from ..settings import Parts
from .dataset import Dataset
from .monitor import Monitor
from .png import label_png, mask_png

_KINDS: tuple[Parts, ...] = ("arms", "links")


def write_masks(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Folders `binary`, `arms` and `links` with a PNG per view, and `labels.json` with the meaning of the values."""
    for view in dataset.views(monitor):
        dataset.write_image(view, folder / "images")
        write_bytes(folder / "binary" / f"{view.name}.png", mask_png(view.link_ids >= 0))
        for kind in _KINDS:
            write_bytes(folder / kind / f"{view.name}.png", label_png(dataset.label_image(view, kind)))
    meaning = {
        "binary": {0: "background", 255: "arm"},
        "arms": {0: "background"} | {category.id: category.name for category in dataset.arms},
        "links": {0: "background"} | {category.id: category.name for category in dataset.links},
    }
    write_text(folder / "labels.json", json.dumps(meaning, indent=1, ensure_ascii=False))
