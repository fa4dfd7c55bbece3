"""Mask an occluder in front of an instrument, so that the optimizer ignores its pixels.

python examples/07_ignore_masks.py [--picture ignore.png]
"""

from pathlib import Path

import cv2
import numpy as np
import tyro

from carts_core.evaluation import dice
from carts_core.export import image_and_mask, outlined
from carts_core.model.perturbation import perturb
from carts_core.networks import FeatureExtractor
from carts_core.optimization import FrameOptimizer
from carts_core.process import tune_process
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence


def covered(image: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draw a sheet of gauze over the jaws of the left instrument; returns the image and the mask of the gauze."""
    count, labels, _, centres = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    left = min(range(1, count), key=lambda number: centres[number][0])
    rows, columns = np.nonzero(labels == left)
    tip = (int(columns.max()) - 35, int(rows[columns.argmax()]))
    sheet = cv2.ellipse(np.zeros(mask.shape, np.uint8), tip, (60, 45), 20, 0, 360, 1, cv2.FILLED)
    weave = np.random.default_rng(0).normal(205, 12, image.shape).clip(0, 255).astype(np.uint8)
    return np.where(sheet[..., None] > 0, cv2.GaussianBlur(weave, (5, 5), 0), image), sheet > 0


def main(picture: Path = Path("ignore.png")) -> None:
    """Optimize the first shipped frame with an occluder, first without and then with its mask."""
    sequence = Sequence.open(sample_sequence())
    scene, frame = sequence.scene, sequence.frame(0)
    camera = scene.cameras[0].name
    assert frame.masks is not None and frame.truth is not None
    truth, start = frame.masks[camera], perturb(scene, frame.truth, degrees=2.0, seed=1)
    frame.images[camera], gauze = covered(frame.images[camera], truth)

    extractor, renderer, views = FeatureExtractor.load(), Renderer(scene), []
    for name, ignore in (("not marked", {}), ("marked", {camera: gauze})):
        optimizer = FrameOptimizer(scene, frame, {}, extractor, ignore=ignore, start=start, live=False)
        list(optimizer)
        assert optimizer.best is not None
        _, mask = image_and_mask(renderer, optimizer.best.state)
        visible = dice(mask & ~gauze, truth & ~gauze)
        print(f"gauze {name}: Dice {dice(mask, truth):.4f}, {visible:.4f} in the visible part")
        views.append(outlined(frame.images[camera], mask))
    views[1] = outlined(views[1], gauze)
    cv2.imwrite(str(picture), np.hstack(views)[..., ::-1])
    print(f"wrote {picture}")


if __name__ == "__main__":
    tune_process()
    tyro.cli(main)
