"""Occluders: gauze, tissue and cloth before the instruments of a picture."""

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ...settings import SensorConfig
from ..synthesis.domains import expose, linear, smooth_noise, smoothstep

OCCLUSION = "occlusion"
"""Name of the domain."""
SHARE = 0.3
"""Part of the visible instruments that is covered."""
_SENSOR = dataclasses.replace(SensorConfig(), vignette=0.0)
_SURROUNDINGS = 0.3
"""Reflectance of what else is in the picture, from which the light is guessed."""


@dataclass(frozen=True)
class Occluded:
    """A picture with occluders in it."""

    image: UInt8[np.ndarray, "h w 3"]
    hidden: Bool[np.ndarray, "h w"]
    """The occluders' pixels."""


def occlude(
    image: UInt8[np.ndarray, "h w 3"],
    instruments: Bool[np.ndarray, "h w"],
    rng: np.random.Generator,
    share: float = SHARE,
) -> Occluded:
    """Lay one to three pieces of one kind over the instruments, with folds, soft edges and a soft shadow.

    Args:
        image: the picture without them.
        instruments: where instruments are visible.
        rng: decides places, shapes and kind.
        share: part of these pixels that is covered, exactly; where there are none, nothing is.
    """
    if not instruments.any():
        return Occluded(image, np.zeros_like(instruments))
    height, width = instruments.shape
    scale = width / 640.0
    level = _pieces(instruments, scale, rng)
    level -= np.quantile(level[instruments], 1.0 - share)
    hidden = level > 0.0
    normal = _normals(level, scale, rng)
    reflectance = _KINDS[int(rng.integers(len(_KINDS)))]((height, width), scale, normal, rng)
    brightness = float(np.median(linear(image))) / _SURROUNDINGS
    lit = expose(brightness * normal[..., 2:] ** 1.5 * reflectance, _SENSOR, rng)
    shadow = cv2.GaussianBlur(hidden.astype(np.float32), (0, 0), 7.0 * scale)
    shift = np.array([[1, 0, rng.uniform(-8, 8) * scale], [0, 1, rng.uniform(0, 10) * scale]])
    shadow = cv2.warpAffine(shadow, shift, (width, height), borderMode=cv2.BORDER_REPLICATE)
    cover = cv2.GaussianBlur(hidden.astype(np.float32), (0, 0), 0.8 * scale)[..., None]
    below = image * (1.0 - 0.45 * shadow[..., None])
    return Occluded(np.rint(cover * lit + (1.0 - cover) * below).astype(np.uint8), hidden)


def _pieces(instruments: np.ndarray, scale: float, rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """A field that falls with the distance from the pieces' middles, which lie on the instruments; noise frays it."""
    rows, columns = np.indices(instruments.shape, dtype=np.float32)
    places = np.argwhere(instruments)
    level = np.full(instruments.shape, -np.inf, np.float32)
    for row, column in places[rng.integers(len(places), size=int(rng.integers(1, 4)))]:
        angle, longer = rng.uniform(0.0, np.pi), rng.uniform(1.0, 2.0)
        x, y = columns - column, rows - row
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        size = 60.0 * scale * rng.uniform(0.6, 1.4)
        level = np.maximum(level, -np.hypot(along / longer, across) / size)
    frayed = smooth_noise(instruments.shape, 70.0 * scale, rng, octaves=3, gain=0.35)
    return (level + 0.12 * frayed).astype(np.float32)


def _normals(level: np.ndarray, scale: float, rng: np.random.Generator) -> Float[np.ndarray, "h w 3"]:
    """Unit normals of a body that bulges within its outline and has folds; z is towards the camera."""
    bulge = 22.0 * scale * np.sqrt(np.clip(level, 0.0, None) + 1e-3)
    folds = 3.0 * scale * smooth_noise(level.shape, 35.0 * scale, rng, octaves=3)
    dy, dx = np.gradient(cv2.GaussianBlur((bulge + folds).astype(np.float32), (0, 0), 1.2 * scale))
    normal = np.stack([-dx, -dy, np.ones_like(dx)], -1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _gauze(shape: tuple[int, int], scale: float, normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Off-white weave, with some blood in it."""
    rows, columns = np.indices(shape, dtype=np.float32) / (rng.uniform(4.0, 7.0) * scale)
    warp = 1.2 * smooth_noise(shape, 90.0 * scale, rng)
    angle = rng.uniform(0.0, np.pi)
    warped = (
        columns * np.cos(angle) + rows * np.sin(angle) + warp,
        rows * np.cos(angle) - columns * np.sin(angle) + warp,
    )
    threads = 0.5 + 0.25 * (np.cos(2 * np.pi * warped[0]) + np.cos(2 * np.pi * warped[1]))
    soaked = smoothstep(smooth_noise(shape, 110.0 * scale, rng, octaves=3), rng.uniform(-0.5, 1.5), 2.5)[..., None]
    white = (0.50 + 0.30 * threads)[..., None] * np.array([1.0, 0.97, 0.90])
    return white * (1.0 - soaked * np.array([0.35, 0.88, 0.90]))


def _tissue(shape: tuple[int, int], scale: float, normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Red to pink, with fat, and wet: it glints where it faces the lamp."""
    fat = smoothstep(smooth_noise(shape, 70.0 * scale, rng, octaves=4), 0.2, 1.4)[..., None]
    red = np.array([0.50, 0.14, 0.11]) * rng.uniform(0.7, 1.3)
    flesh = red * (1.0 + 0.2 * smooth_noise(shape, 25.0 * scale, rng, octaves=4)[..., None])
    glint = 2.5 * np.clip(normal[..., 2:], 0.0, 1.0) ** 300.0
    return np.clip(flesh + fat * (np.array([0.62, 0.44, 0.20]) - flesh), 0.02, 1.0) + glint


def _cloth(shape: tuple[int, int], scale: float, normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A plain colour of drapes and gloves: blue, green or white."""
    colors = ((0.10, 0.25, 0.50), (0.10, 0.38, 0.30), (0.65, 0.65, 0.62))
    shade = 1.0 + 0.06 * smooth_noise(shape, 12.0 * scale, rng, octaves=3)
    return shade[..., None] * np.array(colors[int(rng.integers(len(colors)))])


_KINDS = (_gauze, _tissue, _cloth)
