"""Smoke: a drifting cloud lit by the endoscope, and the flat overlay that stands in for it in data augmentation."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import map_coordinates

from ...settings import DomainConfig
from .noise import smooth_noise

_GRID = 96
_STEPS = 18
_CONTRAST = 0.95
"""Standard deviation of the logarithm of the density."""
_BACKSCATTER = 0.024
"""Share of the extinguished light that comes back to the lens, per steradian, several scatterings included [1/sr]."""
_LAMP_SIZE = 0.060
"""Light scattered on the way hides the inverse square law nearer than this [m]."""


class Smoke:
    """A cloud of turbulent density that fills space, drifts, and changes its shape while it does.

    Args:
        config: density, size of the eddies and speed.
        rng: source of randomness.
    """

    def __init__(self, config: DomainConfig, rng: np.random.Generator) -> None:
        self._config = config
        self._fields = [smooth_noise((_GRID,) * 3, _GRID / 3, rng, octaves=4, gain=0.6) for _ in range(2)]
        self._winds = [wind / np.linalg.norm(wind) for wind in rng.normal(size=(2, 3))]

    def density(self, points: Float[np.ndarray, "*n 3"], time: float) -> Float[np.ndarray, "*n"]:
        """Extinction [1/m] at points of space [m] at a time [s]."""
        config = self._config
        # Two patterns that slide through each other: where they agree it is dense, and that place is never the same.
        total = np.zeros(points.shape[:-1], dtype=np.float32)
        for field, wind in zip(self._fields, self._winds, strict=True):
            places = (points - wind * config.smoke_speed * time) * (_GRID / 3 / config.smoke_wavelength)
            total += map_coordinates(field, np.moveaxis(places, -1, 0), order=1, mode="grid-wrap")
        return config.smoke_density * np.exp(_CONTRAST * total / np.sqrt(2.0) - 0.5 * _CONTRAST**2)

    def haze(
        self,
        light: Float[np.ndarray, "h w 3"],
        positions: Float[np.ndarray, "h w 3"],
        lens: Float[np.ndarray, "3"],
        lamp: float,
        time: float,
    ) -> Float[np.ndarray, "h w 3"]:
        """A picture seen through the smoke: Beer-Lambert's law and one scattering of the light beside the lens.

        Args:
            light: linear RGB without smoke.
            positions: the point that each pixel sees [m].
            lens: the lens, where the light is, too [m].
            lamp: radiant intensity of the light, in the unit of `light` times square metres.
            time: [s].
        """
        height, width = light.shape[:2]
        small = (max(width // 3, 1), max(height // 3, 1))
        # Smoke is smooth, so a third of the resolution will do, but depth must stay sharp at instruments: the march
        # goes along each coarse ray to the farthest point, and each pixel stops at its own distance.
        offsets = positions - lens
        distance = np.linalg.norm(offsets, axis=-1).astype(np.float32)
        rays = cv2.resize((offsets / distance[..., None]).astype(np.float32), small, interpolation=cv2.INTER_AREA)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        edges = np.linspace(0.0, float(distance.max()), _STEPS + 1)
        step = edges[1]
        depth_so_far = np.zeros(small[::-1], np.float32)
        optical = np.zeros((height, width), np.float32)
        glow = np.zeros((height, width), np.float32)
        for near in edges[:-1]:
            middle = near + 0.5 * step
            slab = (self.density(lens + rays * middle, time) * step).astype(np.float32)
            there_and_back = np.exp(-1.2 * (depth_so_far + 0.5 * slab))
            slab_glow = _BACKSCATTER * lamp / (middle**2 + _LAMP_SIZE**2) * slab * there_and_back
            share = np.clip((distance - near) / step, 0.0, 1.0)
            optical += share * cv2.resize(slab, (width, height), interpolation=cv2.INTER_CUBIC)
            glow += share * cv2.resize(slab_glow.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
            depth_so_far += slab
        # The light has to cross the smoke too, but what smoke scatters forwards still arrives: hence less than twice.
        seen = light * np.exp(-1.2 * optical)[..., None]
        return seen + glow[..., None] * np.array([0.98, 1.0, 1.02], np.float32)


class SmokeOverlay:
    """A smooth white pattern laid over the finished picture, blind to depth: the usual augmentation."""

    def __init__(self, opacity: float, rng: np.random.Generator) -> None:
        self._opacity = opacity
        self._pattern = smooth_noise((512, 512), 300, rng, octaves=5, gain=0.55)
        self._drift = rng.normal(size=2)

    def over(self, image: UInt8[np.ndarray, "h w 3"], time: float = 0.0) -> UInt8[np.ndarray, "h w 3"]:
        """The picture with the pattern, which slides by about 5 % of the width per second."""
        height, width = image.shape[:2]
        shift = np.asarray(self._drift, np.float32) * 25.0 * time
        rows, columns = np.indices((height, width), dtype=np.float32) * (512.0 / width)
        pattern = cv2.remap(
            self._pattern, (columns + shift[0]) % 512, (rows + shift[1]) % 512, cv2.INTER_LINEAR, None, cv2.BORDER_WRAP
        )
        alpha = np.clip(self._opacity * (1.0 + 0.45 * pattern), 0.0, 0.95)[..., None]
        return np.clip(np.round((1.0 - alpha) * image + alpha * 205.0), 0, 255).astype(np.uint8)
