"""Export formats by name, and the export function."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..files import MARKER, OutputPath, published, published_file, write_text
from ..settings import FormatName
from .annotation_formats import (
    write_coco,
    write_coco_keypoints,
    write_cvat,
    write_datumaro,
    write_masks,
    write_voc,
    write_yolo,
)
from .bop import write_bop
from .dataset import Dataset, Monitor
from .kinematics_files import (
    write_dvrk,
    write_dvrk_2_3,
    write_dvrk_suj,
    write_kinematics_csv,
    write_kinematics_json,
    write_kinematics_npz,
)
from .video import write_video


@dataclass(frozen=True)
class ExportFormat:
    """An export format."""

    label: str
    """Label of the format."""
    write: Callable[[Dataset, OutputPath, Monitor], None]
    """Function that writes the file or folder."""
    suffix: str = ""
    """Suffix of the file; empty for a folder."""
    images: bool = False
    """Whether the format refers to images."""


FORMATS: dict[FormatName, ExportFormat] = {
    "masks": ExportFormat("PNG masks", write_masks),
    "coco": ExportFormat("COCO", write_coco, images=True),
    "coco-keypoints": ExportFormat("COCO keypoints", write_coco_keypoints, images=True),
    "bop": ExportFormat("BOP poses", write_bop, images=True),
    "yolo": ExportFormat("YOLO segmentation", write_yolo, images=True),
    "voc": ExportFormat("Pascal VOC", write_voc, images=True),
    "cvat": ExportFormat("CVAT for images", write_cvat, images=True),
    "datumaro": ExportFormat("Datumaro", write_datumaro, images=True),
    "csv": ExportFormat("Kinematics, CSV", write_kinematics_csv, ".csv"),
    "npz": ExportFormat("Kinematics, NumPy", write_kinematics_npz, ".npz"),
    "json": ExportFormat("Kinematics, JSON", write_kinematics_json, ".json"),
    "dvrk": ExportFormat("Base frames for the dVRK", write_dvrk, ".json"),
    "dvrk-2.3": ExportFormat("Base frames for the dVRK until 2.3", write_dvrk_2_3, ".json"),
    "dvrk-suj": ExportFormat("Fixed set-up joints for the dVRK", write_dvrk_suj, ".json"),
    "video": ExportFormat("Overlay video", write_video),
}


def export(
    dataset: Dataset,
    name: FormatName,
    output: OutputPath | Path,
    *,
    overwrite: bool = False,
    monitor: Monitor | None = None,
) -> Path:
    """Write a dataset in a format; the output is replaced atomically.

    Args:
        dataset: content of the export.
        name: one of `FORMATS`.
        output: folder or file to create. A file gets the format's suffix if it has another one.
        overwrite: replace a file, or a folder written by an export.
        monitor: progress and cancellation.

    Returns:
        Path of the output.

    Raises:
        ExportCancelled: cancelled by the monitor.
        CartsError: the output exists or cannot be written, or required data is missing.
    """
    chosen = FORMATS[name]
    if chosen.suffix:
        if Path(output).suffix.lower() != chosen.suffix:
            output = output.parent / (output.name + chosen.suffix)
        with published_file(output, overwrite=overwrite) as path:
            chosen.write(dataset, path, monitor or Monitor())
        return Path(output)
    with published(output, overwrite=overwrite) as path:
        chosen.write(dataset, path, monitor or Monitor())
        write_text(path / MARKER, _summary(dataset, name))
    return Path(output)


def _summary(dataset: Dataset, name: FormatName) -> str:
    """Description of an exported folder, as JSON."""
    views = [
        {
            "name": name,
            "frame": frame.frame_id,
            "index": frame.index,
            "camera": camera.name,
            "image": None if file is None else str(file),
            "source": frame.source,
            "verdict": frame.verdict,
            "not_determined": frame.undetermined(dataset.scene),
            "review": frame.review,
            "dice": frame.dice,
        }
        for (name, frame, camera), file in zip(dataset.steps, dataset.files, strict=True)
    ]
    content = {"format": name, "sequence": dataset.sequence.name, "domain": dataset.domain, "views": views}
    return json.dumps(content, indent=1, ensure_ascii=False)
