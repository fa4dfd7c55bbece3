"""Draw the figure of the page on the method: surface maps of a frame of the shipped sample.

python docs/method_picture.py
"""

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from carts_core.imaging.working_image import stacked_images
from carts_core.model.parts import COVERAGE
from carts_core.networks import FeatureExtractor
from carts_core.optimization import Backgrounds, FrameOptimizer
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence

PICTURE = Path(__file__).parent / "images" / "method.png"
WIDTH, HEIGHT, CAPTION, GAP = 320, 240, 30, 6
FRAME = 2
COLOURS = np.array([[0.18, 0.83, 0.65], [0.98, 0.75, 0.26], [0.90, 0.33, 0.42]])
"""Of shaft, wrist and jaws."""


def main() -> None:
    """Write the figure."""
    torch.manual_seed(0)
    sequence = Sequence.open(sample_sequence())
    frame, scene, network = sequence.frame(FRAME), sequence.scene, FeatureExtractor.load()
    backgrounds = Backgrounds.of(sequence, frame.images, frame.domain)
    optimizer = FrameOptimizer(scene, frame, backgrounds, network)
    for _ in optimizer:
        pass
    assert optimizer.best is not None
    measured, found = scene.state(frame.measured), optimizer.best.state
    renderer = Renderer(scene, width=WIDTH, height=HEIGHT)
    image = stacked_images(scene, frame.images, (WIDTH, HEIGHT), "image")
    before, after = renderer.surface_maps(measured), renderer.surface_maps(found)
    first, last = (network.surface(image, given)[0] for given in (before, after))
    tiles = [
        ("image I", _as_bytes(image[0].permute(1, 2, 0).numpy())),
        ("S(x), measured joints", _drawn(before[0])),
        ("S(x), corrected joints", _drawn(after[0])),
        ("predicted map f(I, S(x)), corrected", _drawn(last)),
        ("residual r, measured joints", _difference(first, before[0])),
        ("residual r, corrected joints", _difference(last, after[0])),
    ]
    drawn = [np.vstack([picture, _caption(text)]) for text, picture in tiles]
    rows = [
        np.hstack([np.pad(tile, ((0, 0), (0, GAP), (0, 0)), constant_values=255) for tile in drawn[i : i + 3]])
        for i in (0, 3)
    ]
    cv2.imwrite(str(PICTURE), np.vstack(rows)[:, :-GAP, ::-1])


def _drawn(maps: Float[Tensor, "6 h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Coverage of the parts, in their colours."""
    return _as_bytes(np.tensordot(maps[COVERAGE].clamp(0.0, 1.0).permute(1, 2, 0).numpy(), COLOURS, 1))


def _difference(observed: Float[Tensor, "6 h w"], rendered: Float[Tensor, "6 h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Difference of total coverage: red where the rendering lacks the arm, blue where it has too much."""
    residual = (observed - rendered)[COVERAGE].sum(0).clamp(-1.0, 1.0).numpy()[..., None]
    red, blue = np.array([0.85, 0.15, 0.2]), np.array([0.15, 0.35, 0.85])
    colour = np.where(residual > 0, red, blue)
    return _as_bytes(1.0 - np.abs(residual) * (1.0 - colour))


def _as_bytes(values: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    return np.round(255 * np.clip(values, 0.0, 1.0)).astype(np.uint8)


def _caption(text: str) -> UInt8[np.ndarray, "rows w 3"]:
    caption = np.full((CAPTION, WIDTH, 3), 255, np.uint8)
    cv2.putText(caption, text, (4, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
    return caption


if __name__ == "__main__":
    main()
