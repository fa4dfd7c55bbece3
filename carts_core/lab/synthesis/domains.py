"""Counterfactual domains: blood, smoke, light and sensor effects on the same motion."""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import map_coordinates

from ...settings import DomainConfig, SensorConfig, SynthesisConfig
from .path_tracer import Surface
from .scene import EXTENT, Tissue, sample, smooth_noise, smoothstep

_ABSORPTION = np.array([620.0, 4200.0, 4600.0])
"""Absorption of blood for red, green and blue light [1/m]."""
_SCATTERED = np.array([0.030, 0.0012, 0.0011])
"""Reflectance of thick blood, for red, green and blue light [1]."""
_POOL_DEPTH = 0.0011
_FILM_DEPTH = 0.00030
_BLOOD_GRID = 64
_GRID_SIZE = 0.040
"""Period of the pattern on the instruments [m]."""


class Bleeding:
    """Blood in hollows of the tissue, and in a pattern attached to the moving instruments."""

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
        self._tools = smooth_noise((_BLOOD_GRID,) * 3, _BLOOD_GRID / 2.5, rng, octaves=4, gain=0.6)
        self._tool_level = _level_of(self._tools, config.blood_on_tools)

    def stain(
        self,
        light: Float[np.ndarray, "h w 3"],
        surface: Surface,
        Ts_world_link: Mapping[int, Float[np.ndarray, "4 4"]],
        lens: Float[np.ndarray, "3"],
        lamp: float,
    ) -> Float[np.ndarray, "h w 3"]:
        """Add blood to an image: absorption along the path in and out, scattered red light, and wet highlights.

        Args:
            light: linear RGB without blood.
            surface: surface points of the pixels.
            Ts_world_link: pose of each link in `surface.link`.
            lens: position of the lens and the light [m].
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

        # Pools cover the highlights of the surface below.
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
        # Since the light is beside the lens, the half vector is the view direction: distribution of a Blinn lobe,
        # Fresnel term of water.
        lobe = np.where(on_tissue, 350.0, 60.0)
        glint = 0.025 * (lobe + 2.0) / (8.0 * np.pi) * aligned**lobe * lamp / distance**2 * pooled
        return (base * through + own + glint[..., None]).astype(np.float32)

    def _film(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        pattern = map_coordinates(self._tools, (points * (_BLOOD_GRID / _GRID_SIZE)).T, order=1, mode="grid-wrap")
        above = pattern - self._tool_level
        return _FILM_DEPTH * (0.25 * smoothstep(above, -0.05, 0.10) + smoothstep(above, 0.0, 1.0))

    def _wet_normal(self, surface: Surface, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Normals of the blood surface, which is flatter than the tissue below and has small waves."""
        slope = np.stack([sample(self._waves[..., axis], x, y) for axis in (0, 1)], axis=-1)
        waves = np.concatenate([-0.35 * slope, np.zeros((*slope.shape[:-1], 1))], axis=-1)
        soft = cv2.GaussianBlur(surface.normal.astype(np.float32), (0, 0), surface.normal.shape[1] / 60)
        normal = np.where((surface.link < 0)[..., None], soft + waves, surface.normal)
        return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)


def _level_of(field: np.ndarray, share: float) -> float:
    """Threshold that is exceeded by a share of the values of a field; above their maximum for a share of 0."""
    return float(np.quantile(field, 1.0 - share)) if share > 0 else float(field.max()) + 10.0


_SMOKE_GRID = 96
_STEPS = 18
_CONTRAST = 0.95
"""Standard deviation of the logarithm of the density."""
_BACKSCATTER = 0.024
"""Share of the extinguished light scattered back to the lens, including multiple scattering [1/sr]."""
_LAMP_SIZE = 0.060
"""Distance below which scattering softens the inverse square law of light [m]."""


class Smoke:
    """Turbulent smoke cloud that drifts and changes its shape."""

    def __init__(self, config: DomainConfig, rng: np.random.Generator) -> None:
        self._config = config
        self._fields = [smooth_noise((_SMOKE_GRID,) * 3, _SMOKE_GRID / 3, rng, octaves=4, gain=0.6) for _ in range(2)]
        self._winds = [wind / np.linalg.norm(wind) for wind in rng.normal(size=(2, 3))]

    def density(self, points: Float[np.ndarray, "*n 3"], time: float) -> Float[np.ndarray, "*n"]:
        """Extinction coefficient [1/m] at points [m] and a time [s]."""
        config = self._config
        # Two noise fields move in different directions. Smoke is dense where both values are high, so its shape varies.
        total = np.zeros(points.shape[:-1], dtype=np.float32)
        for field, wind in zip(self._fields, self._winds, strict=True):
            places = (points - wind * config.smoke_speed * time) * (_SMOKE_GRID / 3 / config.smoke_wavelength)
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
        """Add smoke to an image: Beer-Lambert extinction and single scattering of the light beside the lens.

        Args:
            light: linear RGB without smoke.
            positions: surface points of the pixels [m].
            lens: position of the lens and the light [m].
            lamp: radiant intensity of the light, in the unit of `light` times square metres.
            time: time in the sequence [s].
        """
        height, width = light.shape[:2]
        small = (max(width // 3, 1), max(height // 3, 1))
        # A third of the resolution suffices, since smoke is smooth, but depth must remain sharp at instruments. Rays
        # are marched at the coarse resolution up to the farthest point, and each pixel is evaluated at its own
        # distance.
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
        # Light crosses the smoke twice, but forward-scattered light is not lost, so the factor is below 2.
        seen = light * np.exp(-1.2 * optical)[..., None]
        return seen + glow[..., None] * np.array([0.98, 1.0, 1.02], np.float32)


class SmokeOverlay:
    """Smooth white pattern blended over the final image, independent of depth, as in common augmentations."""

    def __init__(self, opacity: float, rng: np.random.Generator) -> None:
        self._opacity = opacity
        self._pattern = smooth_noise((512, 512), 300, rng, octaves=5, gain=0.55)
        self._drift = rng.normal(size=2)

    def over(self, image: UInt8[np.ndarray, "h w 3"], time: float = 0.0) -> UInt8[np.ndarray, "h w 3"]:
        """Blend an image with the pattern, which moves by about 5 % of the width per second."""
        height, width = image.shape[:2]
        shift = np.asarray(self._drift, np.float32) * 25.0 * time
        rows, columns = np.indices((height, width), dtype=np.float32) * (512.0 / width)
        pattern = cv2.remap(
            self._pattern, (columns + shift[0]) % 512, (rows + shift[1]) % 512, cv2.INTER_LINEAR, None, cv2.BORDER_WRAP
        )
        alpha = np.clip(self._opacity * (1.0 + 0.45 * pattern), 0.0, 0.95)[..., None]
        return np.clip(np.round((1.0 - alpha) * image + alpha * 205.0), 0, 255).astype(np.uint8)


_SHOULDER = 0.65


def exposure_gain(radiance: Float[np.ndarray, "h w 3"], config: SensorConfig) -> float:
    """Gain that brings the median of an image to `SensorConfig.exposure`."""
    return config.exposure / max(float(np.median(radiance)), 1e-9)


def expose(
    light: Float[np.ndarray, "h w 3"],
    config: SensorConfig,
    rng: np.random.Generator,
    motion: Float[np.ndarray, "h w 2"] | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """Simulate the image of an endoscope camera.

    Args:
        light: linear RGB, 1 = white.
        config: sensor settings.
        rng: random generator of the noise.
        motion: image motion of each pixel while the shutter is open [px].
    """
    height, width = light.shape[:2]
    scale = width / 640.0
    image = np.minimum(light, 30.0).astype(np.float32)  # the brightest glints would bloom over the image
    y, x = np.indices((height, width), dtype=np.float32) + 0.5
    radius = np.hypot(x - width / 2, y - height / 2) / np.hypot(width / 2, height / 2)
    image = image * (1.0 - config.vignette * radius**2.4)[..., None]
    if motion is not None:
        image = _motion_blur(image, motion)
    if config.blur > 0:
        image = cv2.GaussianBlur(image, (0, 0), max(config.blur * scale, 0.3))
    # Glints are scattered in the lens.
    image = image + 0.06 * cv2.GaussianBlur(np.maximum(image - 1.0, 0.0), (0, 0), max(5.0 * scale, 0.5))
    image = _noisy(image, config, rng)
    rest = 1.0 - _SHOULDER
    bright = _SHOULDER + rest * (1.0 - np.exp(-np.maximum(image - _SHOULDER, 0.0) / rest))
    image = np.where(image > _SHOULDER, bright, np.maximum(image, 0.0)).astype(np.float32)
    image = np.clip(image, 0.0, 1.0)
    image = np.where(image <= 0.0031308, 12.92 * image, 1.055 * image ** (1 / 2.4) - 0.055).astype(np.float32)
    if config.sharpening > 0:
        image = image + config.sharpening * (image - cv2.GaussianBlur(image, (0, 0), max(1.2 * scale, 0.5)))
    return np.clip(np.round(image * 255.0), 0, 255).astype(np.uint8)


def linear(image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Convert an sRGB image to linear RGB in [0, 1]."""
    value = image.astype(np.float32) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _motion_blur(image: np.ndarray, motion: np.ndarray, taps: int = 5) -> np.ndarray:
    """Average the image along the motion of each pixel; the motion field is dilated, so that edges are also blurred."""
    if np.abs(motion).max() < 0.25:
        return image
    # A moving instrument also blurs the adjacent tissue, so its motion must extend beyond its outline.
    speed = np.hypot(motion[..., 0], motion[..., 1])
    reach = int(np.ceil(min(speed.max(), 12.0))) * 2 + 1
    kernel = np.ones((reach, reach), np.uint8)
    wide = cv2.dilate(speed, kernel)
    near = cv2.GaussianBlur(motion * (speed[..., None] + 1e-3), (0, 0), reach / 2)
    near /= np.maximum(cv2.GaussianBlur(speed + 1e-3, (0, 0), reach / 2), 1e-6)[..., None]
    field = np.where((wide > 0.25)[..., None], near, 0.0).astype(np.float32)
    rows, columns = np.indices(image.shape[:2], dtype=np.float32)
    total = np.zeros_like(image)
    for shift in np.linspace(-0.5, 0.5, taps):
        total += cv2.remap(
            image,
            columns + np.float32(shift) * field[..., 0],
            rows + np.float32(shift) * field[..., 1],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )
    return total / taps


def _noisy(image: np.ndarray, config: SensorConfig, rng: np.random.Generator) -> np.ndarray:
    electrons = np.minimum(image, 2.0) * config.full_well
    deviation = np.sqrt(electrons + config.read_noise**2) / config.full_well
    noise = rng.standard_normal(image.shape).astype(np.float32)
    # Demosaicing on a real sensor correlates the noise of neighbouring pixels.
    noise = 0.55 * noise + 0.85 * cv2.GaussianBlur(noise, (0, 0), 0.8) * 1.6
    return image + deviation.astype(np.float32) * noise


@dataclass(frozen=True)
class View:
    """View of a frame in a camera, without any condition."""

    frame: int
    time: float
    """Time in the sequence [s]."""
    camera: int
    """Index of the camera."""
    light: Float[np.ndarray, "h w 3"]
    """Linear RGB with the regular background, 1 = white."""
    lamp: float
    """Radiant intensity of the light at the lens, in the unit of `light` times square metres."""
    other_light: Float[np.ndarray, "h w 3"] | None
    """Linear RGB with the other background; None if the domain is not rendered."""
    surface: Surface
    motion: Float[np.ndarray, "h w 2"] | None
    """Image motion while the shutter is open [px]."""
    lens: Float[np.ndarray, "3"]
    """Position of the lens in the world [m]."""
    Ts_world_link: Mapping[int, Float[np.ndarray, "4 4"]]


class Conditions:
    """Renderer of all domains of a view; blood is on `tissue`, the regular background."""

    def __init__(self, config: SynthesisConfig, tissue: Tissue) -> None:
        self._config = config
        self._bleeding = Bleeding(tissue, config.domain, config.rng("bleeding"))
        self._smoke = Smoke(config.domain, config.rng("smoke"))
        self.overlay = SmokeOverlay(config.domain.overlay_opacity, config.rng("overlay"))

    def image(self, domain: str, view: View) -> UInt8[np.ndarray, "h w 3"]:
        """Image of a view in one domain."""
        if domain == "simulated_smoke":
            return self.overlay.over(self.image("regular", view), view.time)
        rng = self._config.rng("noise", domain, view.frame, view.camera)
        return expose(self.light(domain, view), self._config.sensor, rng, view.motion)

    def light(self, domain: str, view: View) -> Float[np.ndarray, "h w 3"]:
        """Linear RGB of a view in one domain, before overlay and sensor."""
        match domain:
            case "regular":
                return view.light
            case "low_brightness":
                return view.light * self._config.domain.low_brightness
            case "bleeding":
                return self._bleeding.stain(view.light, view.surface, view.Ts_world_link, view.lens, view.lamp)
            case "smoke":
                return self._smoke.haze(view.light, view.surface.position, view.lens, view.lamp, view.time)
            case "background_change" if view.other_light is not None:
                return view.other_light
        raise AssertionError(f"no lighting for domain {domain}")
