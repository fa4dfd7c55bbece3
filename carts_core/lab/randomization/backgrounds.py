"""Procedural backgrounds: tissue, rooms, cloth, boards, anything smooth or patterned, in display colours."""

import cv2
import numpy as np
from jaxtyping import Float

from .noise import grain, smooth_noise
from .rooms import drape, foil, plain, room

Image = Float[np.ndarray, "h w 3"]

_TISSUE = np.array(
    [
        [0.75, 0.35, 0.30], [0.85, 0.55, 0.45], [0.60, 0.22, 0.20], [0.88, 0.70, 0.55],
        [0.80, 0.66, 0.36], [0.92, 0.80, 0.66], [0.66, 0.42, 0.36], [0.80, 0.45, 0.48],
    ],
    np.float32,
)  # fmt: skip
_BOARD = np.array(
    [
        [0.58, 0.55, 0.36], [0.72, 0.68, 0.55], [0.62, 0.52, 0.40], [0.55, 0.58, 0.52],
        [0.80, 0.78, 0.74], [0.45, 0.52, 0.60], [0.42, 0.58, 0.44], [0.66, 0.60, 0.46],
    ],
    np.float32,
)  # fmt: skip


def random_background(rng: np.random.Generator, width: int, height: int) -> Image:
    """A background without shadows, clutter or camera effects, RGB in [0, 1].

    Its mean brightness stays above about 0.25: low light is no part of the training data.
    """
    name = rng.choice(list(_SHARES), p=list(_SHARES.values()))
    image = MAKERS[name](rng, width, height).astype(np.float32)
    image = np.clip(image, 0, 1)
    mean = image.mean()
    if mean < 0.25:
        image = np.clip(image + (0.25 - mean), 0, 1)
    return image * _illumination(rng, width, height)


def _free(rng: np.random.Generator, width: int, height: int) -> Image:
    """Clouds of any colours."""
    image = _blend(rng, rng.uniform(0.1, 0.95, (3, 3)).astype(np.float32), width, height)
    return image * (1 + rng.uniform(0, 0.12) * grain(rng, width, height))


def _blend(rng: np.random.Generator, colors: np.ndarray, width: int, height: int) -> Image:
    cells, octaves = np.exp(rng.uniform(np.log(2), np.log(12))), int(rng.integers(1, 5))
    image = np.broadcast_to(colors[0], (height, width, 3)).astype(np.float32)
    for color in colors[1:]:
        sharpness = rng.uniform(0.8, 3.0)
        field = sharpness * (smooth_noise(rng, width, height, cells, octaves) + rng.normal(0, 0.5))
        share = 1 / (1 + np.exp(-field))
        image = image + share[..., None] * (color - image)
    return image


def _tissue(rng: np.random.Generator, width: int, height: int) -> Image:
    colors = _TISSUE[rng.choice(len(_TISSUE), 3, replace=False)] * np.clip(rng.normal(1, 0.12, (3, 3)), 0.6, 1.4)
    image = _blend(rng, colors.astype(np.float32), width, height)
    relief = smooth_noise(rng, width, height, rng.uniform(4, 20), 3)
    image = image * (1 + rng.uniform(0, 0.15) * relief[..., None])
    image = image * (1 + rng.uniform(0, 0.06) * grain(rng, width, height))
    for _ in range(rng.integers(0, 8)):
        image = _vessel(rng, image)
    for _ in range(rng.choice([0, 1, 2, 4], p=[0.35, 0.25, 0.25, 0.15])):
        image = _glare(rng, image)
    if rng.random() < 0.65:
        image = _wet_relief(rng, image)
    elif rng.random() < 0.5:  # wet spots mirror the light
        wet = smooth_noise(rng, width, height, rng.uniform(15, 45), 2) + 0.5 * relief
        spots = np.clip((wet - rng.uniform(2.0, 3.0)) * 2, 0, 1)[..., None]
        image = image + spots * (rng.uniform(0.7, 1.0) - image)
    return image


def _wet_relief(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """Folds lit by a lamp at the lens, with the white highlights of a wet surface, small and large."""
    height, width = image.shape[:2]
    relief = smooth_noise(rng, width, height, np.exp(rng.uniform(np.log(3), np.log(14))), int(rng.integers(1, 4)))
    if rng.random() < 0.4:  # creases
        relief = -np.abs(relief)
    if rng.random() < 0.5:
        folds = _folds(rng, width, height)
        relief = np.float32(rng.uniform(0.1, 0.5)) * relief + folds * np.float32(rng.uniform(1, 3))
        image = image * (1 - rng.uniform(0, 0.5) * np.exp(-8 * folds))[..., None]  # dark between folds
    steepness = rng.uniform(4, 14)
    slope_x, slope_y = (
        cv2.Sobel(relief, cv2.CV_32F, 1, 0) * steepness / 8,
        cv2.Sobel(relief, cv2.CV_32F, 0, 1) * steepness / 8,
    )
    y, x = np.mgrid[:height, :width].astype(np.float32)
    focal = rng.uniform(0.8, 1.6) * width
    tilt_x, tilt_y = (x - rng.uniform(0.2, 0.8) * width) / focal, (y - rng.uniform(0.2, 0.8) * height) / focal
    # The lamp is at the lens, so a point shines where its normal meets the view ray.
    facing = (1 + slope_x * tilt_x + slope_y * tilt_y) / np.sqrt(
        (1 + slope_x**2 + slope_y**2) * (1 + tilt_x**2 + tilt_y**2)
    )
    facing = np.clip(facing, 0, 1)
    shininess = np.exp(rng.uniform(np.log(15), np.log(300)))
    highlight = rng.uniform(0, 1.3) * facing**shininess
    if rng.random() < 0.5:  # glisten
        highlight = highlight * np.clip(1 + smooth_noise(rng, width, height, width / rng.uniform(3, 10), 1), 0, 3)
    shade = 1 + rng.uniform(0.2, 0.8) * (facing - facing.mean())
    return image * shade[..., None] + highlight[..., None]


def _folds(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """Heights of folds, gut and vessels: tubes that wind over one another [height, width], in [0, 1]."""
    heights = np.zeros((height, width), np.float32)
    for _ in range(rng.integers(2, 14)):
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, rng.uniform(0.05, 0.4), 30))
        steps = np.stack([np.cos(heading), np.sin(heading)], 1) * rng.uniform(0.01, 0.05) * width
        points = rng.uniform(-0.1, 1.1, 2) * (width, height) + np.cumsum(steps, axis=0)
        away = np.ones((height, width), np.uint8)
        cv2.polylines(away, [np.rint(points).astype(np.int32)], False, 0, 1)
        distance = cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        radius = np.float32(np.exp(rng.uniform(np.log(2.5), np.log(26))))
        tube = np.sqrt(np.clip(1 - (distance / radius) ** 2, 0, 1))
        heights = np.maximum(heights, tube * np.float32(min(radius / 12, 1.0)))
    return cv2.GaussianBlur(heights, (0, 0), rng.uniform(0.6, 2.0))


def _glare(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """A wet bulge that mirrors the lamp: a bright patch, smooth or broken up by a rough surface, up to white."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    centre = rng.uniform(0, 1, 2) * (width, height)
    angle, radius = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(4), np.log(35)))
    u = ((x - centre[0]) * np.cos(angle) + (y - centre[1]) * np.sin(angle)) / radius
    v = ((y - centre[1]) * np.cos(angle) - (x - centre[0]) * np.sin(angle)) / (radius * rng.uniform(0.4, 1))
    bulge = np.exp(-((u * u + v * v) ** rng.uniform(0.7, 2.0)))
    rough = smooth_noise(rng, width, height, width / np.exp(rng.uniform(np.log(2), np.log(12))), 2)
    shine = np.clip(rng.uniform(0.6, 2.5) * bulge * (1 + rng.uniform(0, 1.2) * rough), 0, 1.2)
    return image + shine[..., None] * np.clip(rng.normal(0.9, 0.1, 3), 0.7, 1).astype(np.float32)


def _vessel(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    steps = 24
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.25, steps))
    stride = rng.uniform(0.02, 0.06) * width
    start = rng.uniform(0, 1, 2) * (width, height)
    points = start + np.cumsum(np.stack([np.cos(heading), np.sin(heading)], 1) * stride, axis=0)
    layer = np.zeros((height, width), np.float32)
    cv2.polylines(layer, [(points * 8).astype(np.int32)], False, 1.0, int(rng.integers(1, 5)), cv2.LINE_AA, 3)
    layer = cv2.GaussianBlur(layer, (0, 0), rng.uniform(0.6, 2.0))[..., None] * rng.uniform(0.2, 0.7)
    color = image.mean((0, 1)) * rng.uniform(0.5, 1.0) * np.array([1.0, 0.75, 0.75], np.float32)
    return image + layer * (color - image)


def _board(rng: np.random.Generator, width: int, height: int) -> Image:
    color = _BOARD[rng.integers(len(_BOARD))] * np.clip(rng.normal(1, 0.12, 3), 0.6, 1.4)
    stain = smooth_noise(rng, width, height, rng.uniform(2, 8), 4)[..., None]
    image = color * (1 + rng.uniform(0, 0.08) * stain)
    image = image * (1 + rng.uniform(0, 0.06) * grain(rng, width, height))
    return image.astype(np.float32)


def _pattern(rng: np.random.Generator, width: int, height: int) -> Image:
    """Weave, stripes or checks between two colours."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    angle, period = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(4), np.log(60)))
    u = (x * np.cos(angle) + y * np.sin(angle)) * 2 * np.pi / period
    v = (y * np.cos(angle) - x * np.sin(angle)) * 2 * np.pi / period
    wave = np.sin(u) * (np.sin(v) if rng.random() < 0.6 else 1)
    share = 1 / (1 + np.exp(-wave * rng.uniform(1, 8)))[..., None]
    first = rng.uniform(0.25, 0.9, 3)
    second = np.clip(first + rng.normal(0, 0.2, 3), 0.15, 0.95)
    return (first + share * (second - first)).astype(np.float32) * (1 + 0.05 * grain(rng, width, height))


def _illumination(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """Uneven light: a broad spot and a slope, never darker than about two thirds."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x, y = x / width - rng.uniform(0.1, 0.9), y / height - rng.uniform(0.1, 0.9)
    spot = np.exp(-(x * x + y * y) / (2 * rng.uniform(0.3, 0.9) ** 2))
    slope = x * rng.normal(0, 0.2) + y * rng.normal(0, 0.2)
    light = 1 - rng.uniform(0, 0.4) * (1 - spot) + slope
    return np.clip(light, 0.6, 1.25)[..., None].astype(np.float32)


MAKERS = {
    "tissue": _tissue,
    "board": _board,
    "free": _free,
    "pattern": _pattern,
    "room": room,
    "plain": plain,
    "drape": drape,
    "foil": foil,
}
"""Kinds of backgrounds by name; each takes random numbers, width and height [px]."""

_SHARES = {
    "tissue": 0.42, "board": 0.14, "free": 0.06, "pattern": 0.06,
    "room": 0.18, "plain": 0.05, "drape": 0.05, "foil": 0.04,
}  # fmt: skip
"""How often each kind of background is made; they add up to 1."""
