"""Blood: pools and splashes on the tissue, films and drops on the instruments."""

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from ...settings import DomainConfig
from .noise import smooth_noise, smoothstep
from .path_tracer import Surface
from .tissue import EXTENT, Tissue, sample

_ABSORPTION = np.array([620.0, 4200.0, 4600.0])
"""Absorption of blood for red, green and blue light [1/m]."""
_SCATTERED = np.array([0.030, 0.0012, 0.0011])
"""Light that blood itself sends back, as a reflectance."""
_POOL_DEPTH = 0.0011
_FILM_DEPTH = 0.00030
_GRID = 64
_GRID_SIZE = 0.040
"""Period of the pattern on the instruments [m]."""


class Bleeding:
    """Blood at fixed places of the tissue, and fixed to the instruments while they move.

    Args:
        tissue: what bleeds; blood gathers in its hollows.
        config: how much is covered.
        rng: source of randomness.
    """

    def __init__(self, tissue: Tissue, config: DomainConfig, rng: np.random.Generator) -> None:
        shape = (len(tissue.albedo) // 2,) * 2
        scale = shape[0] / EXTENT
        heights = cv2.resize(tissue.heights, shape, interpolation=cv2.INTER_LINEAR)
        hollow = cv2.GaussianBlur(heights, (0, 0), 0.012 * scale) - heights
        level = smooth_noise(shape, 0.055 * scale, rng, octaves=4, gain=0.45) + 0.7 * hollow / hollow.std()
        shore = _level_of(level, config.blood_coverage)
        pools = smoothstep(level, shore, shore + 0.8) + 0.10 * smoothstep(level, shore - 0.10, shore + 0.05)
        splashes = smooth_noise(shape, 0.006 * scale, rng, octaves=2)
        near = smoothstep(level, shore - 1.0, shore)
        drops = smoothstep(splashes - 2.1 + 0.9 * near, 0.0, 0.35) * (config.blood_coverage > 0)
        film = 0.04 * smoothstep(level, shore - 3.0, shore)
        self._depth = (_POOL_DEPTH * np.maximum(np.maximum(pools, 0.45 * drops), film)).astype(np.float32)
        waves = smooth_noise(shape, 0.010 * scale, rng, octaves=2)
        self._waves = np.stack([np.gradient(waves, axis=axis) for axis in (1, 0)], axis=-1).astype(np.float32)
        self._tools = smooth_noise((_GRID,) * 3, _GRID / 2.5, rng, octaves=4, gain=0.6)
        self._tool_level = _level_of(self._tools, config.blood_on_tools)

    def stain(
        self,
        light: Float[np.ndarray, "h w 3"],
        surface: Surface,
        Ts_world_link: Mapping[int, Float[np.ndarray, "4 4"]],
        lens: Float[np.ndarray, "3"],
        lamp: float,
    ) -> Float[np.ndarray, "h w 3"]:
        """A picture with the blood in it: absorption twice through its depth, its own red, and its wet highlights.

        Args:
            light: linear RGB without blood.
            surface: what each pixel sees.
            Ts_world_link: the place of each link that `surface.link` names.
            lens: the lens, where the light is, too [m].
            lamp: radiant intensity of the light, in the unit of `light` times square metres.
        """
        x, y = surface.position[..., 0], surface.position[..., 1]
        on_tissue = surface.link < 0
        depth = np.where(on_tissue, sample(self._depth, x, y), 0.0)
        for link, T_world_link in Ts_world_link.items():
            there = surface.link == link
            if there.any():
                depth[there] = self._film((surface.position[there] - T_world_link[:3, 3]) @ T_world_link[:3, :3])
        pooled = smoothstep(depth, 0.00002, 0.00025)

        # Glints of the dry surface drown in the pool: what lies far above its surroundings is not under the blood.
        dull = np.minimum(light, 1.3 * cv2.GaussianBlur(light.astype(np.float32), (0, 0), light.shape[1] / 100))
        base = light + (dull - light) * (pooled * on_tissue)[..., None]
        through = np.exp(-2.0 * depth[..., None] * _ABSORPTION)

        offset = lens - surface.position
        distance = np.linalg.norm(offset, axis=-1)
        to_eye = offset / distance[..., None]
        facing = np.clip((surface.normal * to_eye).sum(axis=-1), 0.0, 1.0)
        irradiance = lamp * facing / distance**2
        own = (irradiance * np.where(on_tissue, 0.4, 1.0) / np.pi * (1.0 - through[..., 1]))[..., None] * _SCATTERED

        normal = self._wet_normal(surface, x, y)
        aligned = np.clip((normal * to_eye).sum(axis=-1), 0.0, 1.0)
        # Light and lens stand side by side, so the half vector is the way back: D of a Blinn lobe, Fresnel of water.
        lobe = np.where(on_tissue, 350.0, 60.0)
        glint = 0.025 * (lobe + 2.0) / (8.0 * np.pi) * aligned**lobe * lamp / distance**2 * pooled
        return (base * through + own + glint[..., None]).astype(np.float32)

    def _film(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        pattern = map_coordinates(self._tools, (points * (_GRID / _GRID_SIZE)).T, order=1, mode="grid-wrap")
        above = pattern - self._tool_level
        return _FILM_DEPTH * (0.25 * smoothstep(above, -0.05, 0.10) + smoothstep(above, 0.0, 1.0))

    def _wet_normal(self, surface: Surface, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Pools lie flatter than the tissue under them, with small waves."""
        slope = np.stack([sample(self._waves[..., axis], x, y) for axis in (0, 1)], axis=-1)
        waves = np.concatenate([-0.35 * slope, np.zeros((*slope.shape[:-1], 1))], axis=-1)
        soft = cv2.GaussianBlur(surface.normal.astype(np.float32), (0, 0), surface.normal.shape[1] / 60)
        normal = np.where((surface.link < 0)[..., None], soft + waves, surface.normal)
        return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)


def _level_of(field: np.ndarray, share: float) -> float:
    """The level above which a share of the field lies; far above all of it when that share is none."""
    return float(np.quantile(field, 1.0 - share)) if share > 0 else float(field.max()) + 10.0
