"""Correct one frame: perturb its joints, optimize them, and draw the arms before and after.

python examples/01_optimize_a_frame.py [--sequence sequence.toml] [--picture overlay.png]
"""

from pathlib import Path

import cv2
import numpy as np
import tyro

from carts_core.export import image_and_mask, overlay
from carts_core.model.perturbation import perturb
from carts_core.networks import FeatureExtractor
from carts_core.optimization import Backgrounds, FrameOptimizer
from carts_core.process import tune_process
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence


def main(sequence: Path | None = None, picture: Path = Path("overlay.png")) -> None:
    """Optimize the first frame in its first camera."""
    recording = Sequence.open(sequence or sample_sequence(), progress=print)
    camera = recording.scene.cameras[0].name
    frame = recording.frame(0)
    start = perturb(recording.scene, frame.measured, degrees=2.0, seed=1)

    extractor = FeatureExtractor.load()
    # Images of the scene without arms, used to discount false detections; pass {} to omit them.
    backgrounds = Backgrounds.of(recording, [camera], frame.domain)
    optimizer = FrameOptimizer(recording.scene, frame, backgrounds, extractor, start=start, cameras=[camera])
    for iterate in optimizer:
        print(f"iteration {iterate.index:3}  loss {iterate.loss:.4f}  {1000 * iterate.seconds:.0f} ms")
    best = optimizer.best
    assert best is not None
    print(f"stopped: {optimizer.stop_reason}")
    for arm, positions in best.joint_positions().items():
        print(f"{arm}: {np.round(positions, 4)} +- {np.round(best.joint_std()[arm], 4)} [rad, m]")

    renderer = Renderer(recording.scene, cameras=[camera])
    image = frame.images[camera]
    states = (recording.scene.state(start), best.state)
    both = np.hstack([overlay(image, *image_and_mask(renderer, state), 0.6) for state in states])
    cv2.imwrite(str(picture), both[..., ::-1])
    print(f"wrote {picture}")


if __name__ == "__main__":
    tune_process()
    tyro.cli(main)
