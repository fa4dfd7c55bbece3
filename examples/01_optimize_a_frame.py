"""Open a sequence, move its joints off on purpose, let ACS bring them back, and save a picture of before and after.

python examples/01_optimize_a_frame.py [SEQUENCE.toml] [PICTURE.png]
"""

import sys
from pathlib import Path

import cv2
import numpy as np
import torch

from carts_core.data import Sequence
from carts_core.features import FeatureExtractor
from carts_core.optimization import FrameOptimizer
from carts_core.perturbation import perturb
from carts_core.process import tune_process
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence
from carts_core.scene import SceneState


def overlay(renderer: Renderer, state: SceneState, image: np.ndarray) -> np.ndarray:
    """The rendered arms over the frame, RGB uint8."""
    with torch.no_grad():
        rendering = renderer(state)
    rendered = (rendering.image[0].movedim(0, -1) * 255).byte().numpy()
    blended = cv2.addWeighted(image, 0.4, rendered, 0.6, 0)
    return np.where(renderer.segment(state)[0][..., None] >= 0, blended, image)


def main(path: Path, picture: Path) -> None:
    """Optimize the first frame in its first camera."""
    tune_process(keep_memory=True)
    sequence = Sequence.open(path, progress=print)
    camera = sequence.scene.cameras[0].name
    frame = sequence.frame(0)
    start = perturb(sequence.scene, frame.measured, degrees=2.0, seed=1)

    background = {camera: sequence.background(camera)}
    extractor = FeatureExtractor.load()
    optimizer = FrameOptimizer(sequence.scene, frame, background, extractor, start=start, cameras=[camera])
    states = []
    for iterate in optimizer:
        states.append(iterate.state)
        print(f"iteration {iterate.index:3}  loss {iterate.loss:.4f}  {1000 * iterate.seconds:.0f} ms")
    assert optimizer.best is not None
    print(f"best: iteration {optimizer.best.index}, {optimizer.best.joint_positions()}")

    renderer = Renderer(sequence.scene, cameras=[camera])
    image = frame.images[camera]
    both = np.hstack([overlay(renderer, states[0], image), overlay(renderer, optimizer.best.state, image)])
    cv2.imwrite(str(picture), both[..., ::-1])
    print(f"wrote {picture}")


if __name__ == "__main__":
    arguments = sys.argv[1:]
    main(Path(arguments[0]) if arguments else sample_sequence(), Path((arguments[1:] or ["overlay.png"])[0]))
