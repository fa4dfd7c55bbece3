"""PNG masks: binary, by arm, by part and by link."""

import json

from ..files import OutputPath, write_bytes, write_text
from ..settings import Parts
from .dataset import Dataset
from .monitor import Monitor
from .png import label_png, mask_png

_KINDS: tuple[Parts, ...] = ("arms", "parts", "links")


def write_masks(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Folders `binary`, `arms`, `parts` and `links` with a PNG per view; `labels.json` says what the values mean."""
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
