"""Options of an export."""

from typing import Literal

FormatName = Literal[
    "masks",
    "coco",
    "yolo",
    "voc",
    "cvat",
    "datumaro",
    "csv",
    "npz",
    "json",
    "dvrk",
    "dvrk-2.3",
    "dvrk-suj",
    "video",
]
"""Names of the export formats."""

Parts = Literal["arms", "links"]
"""What gets a category of its own."""
