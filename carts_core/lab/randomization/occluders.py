"""Opaque things in front of the arms, whose surface a network shall know all the same."""

import cv2
import numpy as np
from jaxtyping import Float

from .backgrounds import random_background
from .noise import smooth_noise

Image = Float[np.ndarray, "h w 3"]


def occlude(rng: np.random.Generator, image: Image, coverage: Float[np.ndarray, "h w"]) -> Image:
    """One to three things of any texture but a red one over the arms, ragged or smooth; none where there is no arm."""
    rows, columns = np.nonzero(coverage > 0.5)
    if not len(rows):
        return image
    height, width = coverage.shape
    for _ in range(rng.integers(1, 4)):
        at = rng.integers(len(rows))
        shape = _shape(rng, (float(columns[at]), float(rows[at])), width, height)[..., None]
        image = image + shape * (_texture(rng, width, height) - image)
    return image


def _texture(rng: np.random.Generator, width: int, height: int) -> Image:
    """Any texture without red in it: blood over an instrument is evaluated, so it must not be trained on."""
    texture = random_background(rng, width, height).astype(np.float32) * rng.uniform(0.6, 1.2)
    # Where red is strongest it changes places with the next, which leaves no seam where both are as strong.
    red, strongest = texture[..., 0].copy(), 1 + texture[..., 1:].argmax(2)[..., None]
    other = np.take_along_axis(texture, strongest, 2)[..., 0]
    texture[..., 0] = np.minimum(red, other)
    np.put_along_axis(texture, strongest, np.maximum(red, other)[..., None], 2)
    return texture


def _shape(rng: np.random.Generator, centre: tuple[float, float], width: int, height: int) -> Float[np.ndarray, "h w"]:
    """Share of each pixel that is hidden: an ellipse with a waved, ragged or smooth edge."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    angle, radius = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(0.012), np.log(0.1))) * width
    u = ((x - centre[0]) * np.cos(angle) + (y - centre[1]) * np.sin(angle)) / (radius * np.exp(rng.uniform(0, 1)))
    v = ((y - centre[1]) * np.cos(angle) - (x - centre[0]) * np.sin(angle)) / radius
    waves = smooth_noise(rng, width, height, rng.uniform(4, 40), int(rng.integers(1, 4)))
    inside = 1 - np.hypot(u, v) + rng.uniform(0, 0.5) * waves
    return cv2.GaussianBlur((inside > 0).astype(np.float32), (0, 0), rng.uniform(0.4, 1.5))
