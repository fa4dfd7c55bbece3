"""From radiance to the bytes of a picture: exposure, lens, sensor noise, tone curve."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ...settings import SensorConfig

_SHOULDER = 0.65


def exposure_gain(radiance: Float[np.ndarray, "h w 3"], config: SensorConfig) -> float:
    """The gain that brings the median of a picture to `SensorConfig.exposure`."""
    return config.exposure / max(float(np.median(radiance)), 1e-9)


def expose(
    light: Float[np.ndarray, "h w 3"],
    config: SensorConfig,
    rng: np.random.Generator,
    motion: Float[np.ndarray, "h w 2"] | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """The picture that an endoscope camera takes.

    Args:
        light: linear RGB, 1 = white.
        config: the sensor.
        rng: source of the noise.
        motion: how far the image moves while the shutter is open [px].
    """
    height, width = light.shape[:2]
    scale = width / 640.0
    image = np.minimum(light, 30.0).astype(np.float32)  # the brightest glints would otherwise bloom over the picture
    image = image * _vignette(height, width, config.vignette)[..., None]
    if motion is not None:
        image = _motion_blur(image, motion)
    if config.blur > 0:
        image = cv2.GaussianBlur(image, (0, 0), max(config.blur * scale, 0.3))
    image = _with_glow(image, scale)
    image = _noisy(image, config, rng)
    image = _soft_clip(image)
    image = _srgb(image)
    if config.sharpening > 0:
        image = image + config.sharpening * (image - cv2.GaussianBlur(image, (0, 0), max(1.2 * scale, 0.5)))
    return np.clip(np.round(image * 255.0), 0, 255).astype(np.uint8)


def linear(image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Linear RGB in [0, 1] of a picture: the inverse of the sRGB curve."""
    value = image.astype(np.float32) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _srgb(value: np.ndarray) -> np.ndarray:
    value = np.clip(value, 0.0, 1.0)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055).astype(np.float32)


def _vignette(height: int, width: int, loss: float) -> Float[np.ndarray, "h w"]:
    y, x = np.indices((height, width), dtype=np.float32) + 0.5
    radius = np.hypot(x - width / 2, y - height / 2) / np.hypot(width / 2, height / 2)
    return 1.0 - loss * radius**2.4


def _motion_blur(image: np.ndarray, motion: np.ndarray, taps: int = 5) -> np.ndarray:
    """Mean of the picture along each pixel's motion; the motion field is widened so that edges smear, too."""
    if np.abs(motion).max() < 0.25:
        return image
    # A moving instrument smears over the tissue beside it, so its motion must reach beyond its outline.
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


def _with_glow(image: np.ndarray, scale: float) -> np.ndarray:
    """Light of the glints scattered in the lens."""
    excess = np.maximum(image - 1.0, 0.0)
    return image + 0.06 * cv2.GaussianBlur(excess, (0, 0), max(5.0 * scale, 0.5))


def _noisy(image: np.ndarray, config: SensorConfig, rng: np.random.Generator) -> np.ndarray:
    electrons = np.minimum(image, 2.0) * config.full_well
    deviation = np.sqrt(electrons + config.read_noise**2) / config.full_well
    noise = rng.standard_normal(image.shape).astype(np.float32)
    # Colours are interpolated from the neighbours' on a real sensor, so noise has a grain of more than a pixel.
    noise = 0.55 * noise + 0.85 * cv2.GaussianBlur(noise, (0, 0), 0.8) * 1.6
    return image + deviation.astype(np.float32) * noise


def _soft_clip(image: np.ndarray) -> np.ndarray:
    rest = 1.0 - _SHOULDER
    bright = _SHOULDER + rest * (1.0 - np.exp(-np.maximum(image - _SHOULDER, 0.0) / rest))
    return np.where(image > _SHOULDER, bright, np.maximum(image, 0.0)).astype(np.float32)
