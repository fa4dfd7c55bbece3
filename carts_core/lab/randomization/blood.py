"""Blood in training images: pools, films and drops over background and instruments, with glints."""

import cv2
import numpy as np
from jaxtyping import Float

from .backgrounds import smooth_noise

Image = Float[np.ndarray, "h w 3"]

_COLOR = np.array([0.42, 0.035, 0.03], np.float32)
"""Colour of thick blood in display values [1]."""


def bleed(rng: np.random.Generator, image: Image, coverage: Float[np.ndarray, "h w"]) -> Image:
    """Add blood to an image: pools on the background, films and drops on background and arms.

    Args:
        image: display colours in [0, 1].
        coverage: share of each pixel that shows an arm.
    """
    height, width = coverage.shape
    pools = _patches(rng, width, height, rng.uniform(0.0, 0.8), np.exp(rng.uniform(np.log(2), np.log(12))))
    depth = pools * np.exp(rng.uniform(np.log(0.5), np.log(6)))
    stained = _patches(rng, width, height, rng.uniform(0.0, 0.7), np.exp(rng.uniform(np.log(4), np.log(30))))
    films = stained * np.exp(rng.uniform(np.log(0.1), np.log(4)))
    # Pools cover arms that dip into them; most arms are above the pools.
    dips = rng.uniform(0.3, 1.0) if rng.random() < 0.2 else 0.0
    depth = depth * (1 - coverage * (1 - dips)) + films * coverage
    for _ in range(rng.choice([0, 3, 12], p=[0.4, 0.4, 0.2])):
        depth = _drop(rng, depth)
    color = _COLOR * np.float32(rng.uniform(0.3, 1.3)) * np.clip(rng.normal(1, 0.15, 3), 0.6, 1.4).astype(np.float32)
    grey = image.mean(2, keepdims=True)
    shade = np.clip(grey / max(float(grey.mean()), 0.05), 0.3, 2.0) ** np.float32(rng.uniform(0.2, 0.9))
    absorbed = np.exp(-depth[..., None] * np.array([0.35, 2.2, 2.4], np.float32))
    result = image * absorbed + color * shade * (1 - absorbed[..., 1:2])
    return np.clip(result + _glints(rng, depth), 0, 1).astype(np.float32)


def _patches(rng: np.random.Generator, width: int, height: int, share: float, cells: float) -> np.ndarray:
    """Patches with smooth edges that cover approximately the given share of the image, in [0, 1]."""
    noise = smooth_noise(rng, width, height, cells, int(rng.integers(1, 4)))
    level = np.quantile(noise, 1 - share) if share > 0 else noise.max()
    return np.clip((noise - level) * np.float32(rng.uniform(1.5, 12)), 0, 1)


def _drop(rng: np.random.Generator, depth: np.ndarray) -> np.ndarray:
    """Add a drop or a trickle of blood."""
    height, width = depth.shape
    layer = np.zeros_like(depth)
    start = rng.uniform(0, 1, 2) * (width, height)
    radius = np.exp(rng.uniform(np.log(0.7), np.log(7)))
    end = start + rng.normal(0, rng.choice([1.0, 20.0]), 2)
    points = (np.array([start, end]) * 8).astype(np.int32)
    cv2.line(layer, points[0].tolist(), points[1].tolist(), 1.0, max(int(2 * radius), 1), cv2.LINE_AA, 3)
    return depth + cv2.GaussianBlur(layer, (0, 0), 0.6) * np.float32(rng.uniform(1, 6))


def _glints(rng: np.random.Generator, depth: np.ndarray) -> np.ndarray:
    """White reflections of the lamp on the wet surface [h, w, 1]."""
    height, width = depth.shape
    waves = smooth_noise(rng, width, height, np.exp(rng.uniform(np.log(8), np.log(50))), 2)
    bright = np.clip(waves - rng.uniform(1.4, 3.0), 0, 1) * rng.uniform(0.5, 3.0)
    return (np.clip(bright, 0, 1) * np.clip(depth, 0, 1))[..., None].astype(np.float32) * np.float32(0.9)
