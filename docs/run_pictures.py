"""Make the moving picture of the first page, and the picture of the start page, from a fit of the shipped sample.

    make pictures

Writes `docs/images/run.webp` and `static/hero.webp`.
"""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from carts_core.evaluation.metrics import dice
from carts_core.model.scene import SceneState
from carts_core.networks import FeatureExtractor
from carts_core.optimization import FrameOptimizer
from carts_core.process import tune_process
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence, static_dir

FRAME = 6
MEASURED, CORRECTED = (255, 176, 32), (45, 212, 167)
BACKGROUND, TEXT, DIM = (20, 24, 27), (213, 222, 222), (111, 125, 132)
CURVE = 80
"""Height of the curve [px]."""
HOLD = 6
"""Repetitions of the first and the last picture."""
INTERVAL = 300
"""Time of a picture [ms]."""


def outlined(image: np.ndarray, labels: np.ndarray, colour: tuple[int, int, int], scale: int = 2) -> np.ndarray:
    """The image [h, w, 3], enlarged, with the outline of each arm."""
    large = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    for arm in np.unique(labels[labels >= 0]):
        mask = cv2.resize((labels == arm).astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        lines, _ = cv2.findContours((mask > 0.5).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for shade, width in ((BACKGROUND, 5 * scale // 2), (colour, 3 * scale // 2)):
            cv2.drawContours(large, lines, -1, shade, width, cv2.LINE_AA)
    return large


def curve(values: list[float], step: int, width: int) -> np.ndarray:
    """Curve of the overlaps up to a step, at twice its size."""
    panel = np.full((2 * CURVE, 2 * width, 3), BACKGROUND, np.uint8)
    top, low, high = 64, min(values), max(values)
    x = 32 + np.arange(len(values)) / (len(values) - 1) * (2 * width - 64)
    y = top + (1 - (np.array(values) - low) / (high - low)) * (2 * CURVE - top - 24)
    cv2.line(panel, (32, 2 * CURVE - 20), (2 * width - 32, 2 * CURVE - 20), DIM, 1)
    points = np.stack([x, y], -1)[: step + 1].round().astype(np.int32)
    cv2.polylines(panel, [points], False, CORRECTED, 4, cv2.LINE_AA)
    cv2.circle(panel, points[-1].tolist(), 8, CORRECTED, -1, cv2.LINE_AA)
    words = f"Step {step}    overlap with the true mask {100 * values[step]:.1f} %"
    cv2.putText(panel, words, (32, 40), cv2.FONT_HERSHEY_SIMPLEX, 0.95, TEXT, 2, cv2.LINE_AA)
    return panel


def run() -> tuple[np.ndarray, list[tuple[np.ndarray, float]]]:
    """The image, and labels and overlap (Dice) of each iterate; the first is at the measured joint positions."""
    sequence = Sequence.open(sample_sequence())
    camera = sequence.scene.cameras[0].name
    frame, renderer = sequence.frame(FRAME), Renderer(sequence.scene)
    optimizer = FrameOptimizer(sequence.scene, frame, {camera: sequence.background(camera)}, FeatureExtractor.load())

    def labels(state: SceneState) -> np.ndarray:
        return renderer.segment(state)[0]

    true = labels(sequence.scene.state(frame.truth or {})) >= 0
    states = [iterate.state for iterate in optimizer]
    assert optimizer.best is not None
    found = [labels(state) for state in (*states, optimizer.best.state)]
    return frame.images[camera], [(each, dice(each >= 0, true)) for each in found]


def pictures(image: np.ndarray, found: list[tuple[np.ndarray, float]]) -> Iterator[Image.Image]:
    """Pictures of the run."""
    values = [value for _, value in found]
    for step, (labels, _) in enumerate(found):
        colour = MEASURED if step == 0 else CORRECTED
        whole = np.vstack([outlined(image, labels, colour), curve(values, step, image.shape[1])])
        small = Image.fromarray(whole).resize((whole.shape[1] // 2, whole.shape[0] // 2), Image.Resampling.LANCZOS)
        yield from [small] * (HOLD if step in (0, len(found) - 1) else 1)


def main() -> None:
    """Write both pictures."""
    tune_process()
    image, found = run()
    moving = Path(__file__).parent / "images" / "run.webp"
    first, *others = pictures(image, found)
    first.save(moving, save_all=True, append_images=others, duration=INTERVAL, loop=0, quality=62, method=6)
    height, width = image.shape[:2]
    rows = slice(2 * (height - width * 9 // 14) // 2, 2 * (height + width * 9 // 14) // 2)
    ends = (found[0][0], MEASURED), (found[-1][0], CORRECTED)
    halves = [outlined(image, labels, colour)[rows] for labels, colour in ends]
    gap = np.full((len(halves[0]), 16, 3), 128, np.uint8)
    hero = Image.fromarray(np.hstack([halves[0], gap, halves[1]]))
    hero = hero.resize((1120, round(1120 * hero.height / hero.width)), Image.Resampling.LANCZOS)
    hero.save(static_dir() / "hero.webp", quality=80, method=6)
    for path in (moving, static_dir() / "hero.webp"):
        print(f"{path}: {path.stat().st_size // 1024} KiB")
    print(f"{len(found)} steps, overlap {found[0][1]:.3f} to {found[-1][1]:.3f}")


if __name__ == "__main__":
    main()
