"""Fit joint positions to given, incomplete masks instead of the network's predictions.

python examples/11_masks_as_the_target.py [--picture masks.png]
"""

from pathlib import Path

import cv2
import numpy as np
import tyro

from carts_core.evaluation import dice
from carts_core.export import image_and_mask, outlined
from carts_core.model.perturbation import perturb
from carts_core.optimization import FrameOptimizer, MaskPredictor
from carts_core.process import tune_process
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence


def main(picture: Path = Path("masks.png")) -> None:
    """Fit the first shipped frame to its mask, from which a fifth of the blocks is removed."""
    sequence = Sequence.open(sample_sequence())
    scene, frame = sequence.scene, sequence.frame(0)
    camera = scene.cameras[0].name
    assert frame.masks is not None and frame.truth is not None
    whole = frame.masks[camera]
    kept = np.random.default_rng(0).random((12, 16)) >= 0.2
    size = whole.shape[1], whole.shape[0]
    given = whole & (cv2.resize(kept.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)

    predictor, start = MaskPredictor(masks=lambda _: {camera: given}), perturb(scene, frame.truth, degrees=4.0, seed=1)
    optimizer = FrameOptimizer(scene, frame, {}, predictor, start=start, live=False)
    list(optimizer)
    assert optimizer.best is not None
    renderer, views = Renderer(scene), []
    for name, state in (("start", scene.state(start)), ("fitted", optimizer.best.state)):
        _, mask = image_and_mask(renderer, state)
        print(f"{name}: Dice {dice(mask, whole):.4f} with the whole mask")
        shown = np.where(given[..., None], frame.images[camera] // 2 + 100, frame.images[camera])
        views.append(outlined(shown, mask))
    cv2.imwrite(str(picture), np.hstack(views)[..., ::-1])
    print(f"wrote {picture}")


if __name__ == "__main__":
    tune_process()
    tyro.cli(main)
