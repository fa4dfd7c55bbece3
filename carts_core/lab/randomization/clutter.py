"""Things on the background that are not instruments, and shadows, theirs and the instruments'."""

import cv2
import numpy as np
from jaxtyping import Float

Image = Float[np.ndarray, "h w 3"]


def add_clutter(rng: np.random.Generator, image: Image) -> Image:
    """Shadow-like streaks, blobs, threads, crumbs and small objects on a background."""
    for _ in range(rng.choice([0, 1, 2, 3], p=[0.3, 0.35, 0.2, 0.15])):
        image = _streak(rng, image)
    for _ in range(rng.choice([0, 1, 2, 4], p=[0.5, 0.25, 0.15, 0.1])):
        image = _object(rng, image)
    for _ in range(rng.choice([0, 1, 2], p=[0.7, 0.2, 0.1])):
        image = _thread(rng, image)
    if rng.random() < 0.6:
        image = _crumbs(rng, image)
    return image


def cast_shadow(rng: np.random.Generator, image: Image, coverage: Float[np.ndarray, "h w"]) -> Image:
    """The arms' own soft shadow: their silhouette moved, turned, blurred and used to darken the background.

    The arms themselves are put over it later, so the shadow shows beside them only.
    """
    width = coverage.shape[1]
    reach = np.exp(rng.uniform(np.log(0.01), np.log(0.35))) * width
    moved = _displaced(rng, coverage, reach, turn=6, scale=(0.9, 1.15))
    soft = cv2.GaussianBlur(moved, (0, 0), np.clip(reach * rng.uniform(0.03, 0.2), 0.6, 8))
    # Close to what casts it a shadow can be nearly black.
    return _darken(rng, image, soft, 0.9 if reach < 0.08 * width else 0.6)


def contact_shadow(
    rng: np.random.Generator, image: Image, coverage: Float[np.ndarray, "h w"], darkness: float
) -> Image:
    """A crisp shadow right beside the arms, about as dark and as grey as they are, so that only shape tells it apart.

    Args:
        rng: random numbers.
        image: the background.
        coverage: of the arms.
        darkness: typical brightness of the arms [1].
    """
    reach = np.exp(rng.uniform(np.log(0.006), np.log(0.06))) * coverage.shape[1]
    moved = _displaced(rng, coverage, reach, turn=2, scale=(1.0, 1.0))
    shape = cv2.GaussianBlur(moved, (0, 0), rng.uniform(0.4, 1.5))[..., None]
    brightness = darkness * np.exp(rng.normal(0, 0.4))
    tinted = image * np.clip(brightness / max(float(image.mean()), 1e-3), 0.03, 0.8)
    grey = brightness * np.clip(rng.normal(1, 0.05, 3), 0.8, 1.2)
    dark = tinted + rng.uniform(0, 0.9) * (grey - tinted)
    return (image + shape * (np.minimum(dark, image) - image)).astype(np.float32)


def _displaced(
    rng: np.random.Generator, coverage: np.ndarray, reach: float, turn: float, scale: tuple[float, float]
) -> np.ndarray:
    """A silhouette moved by `reach` [px] any way, turned with a deviation of `turn` [deg] and scaled."""
    height, width = coverage.shape
    heading = rng.uniform(0, 2 * np.pi)
    centre = rng.uniform(0, width), rng.uniform(0, height)
    motion = cv2.getRotationMatrix2D(centre, rng.normal(0, turn), rng.uniform(*scale))
    motion[:, 2] += reach * np.cos(heading), reach * np.sin(heading)
    return cv2.warpAffine(coverage, motion, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _darken(rng: np.random.Generator, image: np.ndarray, shape: np.ndarray, strongest: float = 0.6) -> np.ndarray:
    strength = rng.uniform(0.12, strongest) * np.clip(rng.normal(1, 0.06, 3), 0.8, 1.2)
    return image * np.clip(1 - shape[..., None] * strength.astype(np.float32), 0.05, 1)


def _streak(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """A tapered dark band with soft edges that keeps the texture below it: a shadow, never an instrument."""
    height, width = image.shape[:2]
    start, heading = rng.uniform(-0.1, 1.1, 2) * (width, height), rng.uniform(0, 2 * np.pi)
    length = rng.uniform(0.2, 1.3) * width
    along = np.array([np.cos(heading), np.sin(heading)])
    across = np.array([-along[1], along[0]])
    near, far = np.exp(rng.uniform(np.log(1.5), np.log(16), 2))
    bend = across * rng.normal(0, 0.04) * length
    middle, end = start + along * length / 2 + bend, start + along * length
    half = (near + far) / 2
    outline = [start + across * near, middle + across * half, end + across * far,
               end - across * far, middle - across * half, start - across * near]  # fmt: skip
    shape = np.zeros((height, width), np.float32)
    cv2.fillPoly(shape, [(np.array(outline) * 8).astype(np.int32)], 1.0, cv2.LINE_AA, 3)
    if rng.random() < 0.4:
        centre = tuple(int(v * 8) for v in end)
        cv2.circle(shape, centre, int(far * rng.uniform(1, 1.6) * 8), 1.0, -1, cv2.LINE_AA, 3)
    return _darken(rng, image, cv2.GaussianBlur(shape, (0, 0), rng.uniform(0.6, 5)))


def _object(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """A small opaque thing with some shading: swab, clip, needle holder's target, fold."""
    height, width = image.shape[:2]
    shape = np.zeros((height, width), np.float32)
    centre = rng.uniform(0, 1, 2) * (width, height)
    size = np.exp(rng.uniform(np.log(2), np.log(0.18 * width)))
    if rng.random() < 0.5:
        axes = (max(int(size * 4), 8), max(int(size * 8 * rng.uniform(0.3, 1)), 8))
        cv2.ellipse(
            shape, tuple((centre * 8).astype(int).tolist()), axes, rng.uniform(0, 180), 0, 360, 1.0, -1, cv2.LINE_AA, 3
        )
    else:
        angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 8)))
        radius = size * rng.uniform(0.4, 1, len(angles))
        corners = centre + np.stack([np.cos(angles) * radius, np.sin(angles) * radius], 1)
        cv2.fillPoly(shape, [(corners * 8).astype(np.int32)], 1.0, cv2.LINE_AA, 3)
    shape = cv2.GaussianBlur(shape, (0, 0), np.exp(rng.uniform(np.log(0.4), np.log(4))))[..., None]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    slope = ((x - centre[0]) * rng.normal(0, 1) + (y - centre[1]) * rng.normal(0, 1)) / (size + 4)
    color = rng.uniform(0.2, 1.0, 3).astype(np.float32) * (1 + 0.12 * np.clip(slope, -2, 2))[..., None]
    return image + shape * rng.uniform(0.5, 1) * (color - image)


def _thread(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.2, 30))
    steps = np.stack([np.cos(heading), np.sin(heading)], 1) * rng.uniform(0.01, 0.04) * width
    points = rng.uniform(0, 1, 2) * (width, height) + np.cumsum(steps, axis=0)
    shape = np.zeros((height, width), np.float32)
    cv2.polylines(shape, [(points * 8).astype(np.int32)], False, 1.0, int(rng.integers(1, 3)), cv2.LINE_AA, 3)
    return image + shape[..., None] * rng.uniform(0.3, 0.9) * (rng.uniform(0.05, 0.95, 3).astype(np.float32) - image)


def _crumbs(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    shape = np.zeros((height, width), np.float32)
    for _ in range(rng.integers(1, 12)):
        centre = tuple((rng.uniform(0, 1, 2) * (width, height) * 8).astype(int).tolist())
        axes = tuple((np.exp(rng.uniform(np.log(0.4), np.log(3), 2)) * 8).astype(int).tolist())
        cv2.ellipse(shape, centre, axes, rng.uniform(0, 180), 0, 360, float(rng.uniform(0.3, 1)), -1, cv2.LINE_AA, 3)
    return image + shape[..., None] * (rng.uniform(0.05, 0.5, 3).astype(np.float32) - image)
