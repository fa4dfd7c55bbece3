"""Options of an export."""

from typing import Literal

FormatName = Literal[
    "masks",
    "coco",
    "coco-keypoints",
    "bop",
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

Parts = Literal["arms", "parts", "links"]
"""What gets a category of its own: every arm, every part of it (shaft, wrist, jaws), or every link."""

Images = Literal["named", "copied", "none"]
"""Images of an export: labels name the recording's own files, or copies of them, byte for byte, or none are written."""
