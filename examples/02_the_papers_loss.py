"""Compare Dice and time of the paper's setting and of the default solver on one frame, from the same start.

python examples/02_the_papers_loss.py [--iterations 20] [--picture paper.png]

The loss of the paper compares features of the image with features of a rendered image (ACS) and is minimized by Adam.
The default solver compares the parts of the arm that cover each pixel, and takes damped Gauss-Newton steps.
"""

from pathlib import Path

import cv2
import numpy as np
import tyro

from carts_core.evaluation import dice
from carts_core.export import image_and_mask, outlined
from carts_core.model.perturbation import perturb
from carts_core.networks import FeatureExtractor
from carts_core.optimization import DescentSolver, FrameOptimizer, SurfaceSolver
from carts_core.process import tune_process
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence


def main(iterations: int = 20, picture: Path = Path("paper.png")) -> None:
    """Optimize the first shipped frame with both solvers."""
    sequence = Sequence.open(sample_sequence())
    frame = sequence.frame(0)
    camera = sequence.scene.cameras[0].name
    assert frame.truth is not None and frame.masks is not None
    start = perturb(sequence.scene, frame.truth, degrees=1.0, seed=3)
    # The arms are rendered over the mean background before features are compared.
    background = {camera: sequence.background(camera)}
    extractor, renderer = FeatureExtractor.load(), Renderer(sequence.scene)

    pictures = []
    for name, settings in (("paper", DescentSolver.paper(iterations)), ("default", SurfaceSolver())):
        optimizer = FrameOptimizer(sequence.scene, frame, background, extractor, start=start, settings=settings)
        iterates = list(optimizer)
        assert optimizer.best is not None
        for label, state in (("start", iterates[0].state), ("best", optimizer.best.state)):
            _, mask = image_and_mask(renderer, state)
            print(f"{name:8} {label:6} Dice {dice(mask, frame.masks[camera]):.4f}")
        seconds = sum(iterate.seconds for iterate in iterates)
        print(f"{name:8} {len(iterates)} iterates in {seconds:.1f} s, {1000 * seconds / len(iterates):.0f} ms each")
        pictures.append(outlined(frame.images[camera], mask))
    cv2.imwrite(str(picture), np.hstack(pictures)[..., ::-1])
    print(f"wrote {picture}: the outlines of both results, the paper's on the left")


if __name__ == "__main__":
    tune_process()
    tyro.cli(main)
