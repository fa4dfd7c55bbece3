"""Correct some frames and export them: masks in COCO's format, and the kinematics as a table.

python examples/08_export.py [--frames 2] [--output exported] [--picture export.png]
"""

from pathlib import Path

import cv2
import numpy as np
import tyro
from pycocotools.coco import COCO

from carts_core.export import Dataset, ExportFrame, ExportProgress, export
from carts_core.networks import FeatureExtractor
from carts_core.optimization import FrameOptimizer
from carts_core.process import tune_process
from carts_core.recording import Sequence
from carts_core.resources import sample_sequence


def corrected(sequence: Sequence, index: int, extractor: FeatureExtractor) -> ExportFrame:
    """Optimize the joint positions of one frame for the export."""
    frame = sequence.frame(index)
    optimizer = FrameOptimizer(sequence.scene, frame, {}, extractor, live=False)
    list(optimizer)
    best = optimizer.best
    assert best is not None
    return ExportFrame(frame.frame_id, "optimized", best.joint_positions(), best.joint_std(), index=index)


def main(frames: int = 2, output: Path = Path("exported"), picture: Path = Path("export.png")) -> None:
    """Export the first frames of the shipped sequence, and draw the annotations as read by pycocotools."""
    sequence, extractor = Sequence.open(sample_sequence()), FeatureExtractor.load()
    rows = tuple(corrected(sequence, index, extractor) for index in range(frames))
    dataset = Dataset(sequence, rows, sequence.scene, sequence.domains[0])
    progress = ExportProgress(lambda done, total: print(f"{done} of {total} views"))
    folder = export(dataset, "coco", output / "coco", overwrite=True, progress=progress)
    table = export(dataset, "csv", output / "kinematics.csv", overwrite=True)
    print(f"wrote {folder} and {table}")

    coco = COCO(str(folder / "annotations" / "instances_default.json"))
    entry = coco.loadImgs(coco.getImgIds()[0])[0]
    image = cv2.imread(str(dataset.image_folder / entry["file_name"]))
    assert image is not None
    for annotation, colour in zip(
        coco.loadAnns(coco.getAnnIds(entry["id"])), ((80, 200, 80), (220, 140, 60)), strict=False
    ):
        mask = coco.annToMask(annotation).astype(bool)
        image[mask] = (0.5 * image[mask] + 0.5 * np.array(colour)).astype(np.uint8)
        x, y, width, height = (round(value) for value in annotation["bbox"])
        cv2.rectangle(image, (x, y), (x + width, y + height), colour, 2)
    cv2.imwrite(str(picture), image)
    print(f"wrote {picture}: masks and boxes as read back")


if __name__ == "__main__":
    tune_process()
    tyro.cli(main)
