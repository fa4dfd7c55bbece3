"""What an endoscope camera does to an image."""

import cv2
import numpy as np
from jaxtyping import Float

from ...settings import AppearanceRanges
from .noise import smooth_noise

Image = Float[np.ndarray, "h w 3"]


def photograph(rng: np.random.Generator, image: Image, ranges: AppearanceRanges) -> Image:
    """Vignette, blur, exposure, colour, noise and JPEG artefacts, each drawn from `ranges`; result in [0, 1]."""
    image = image * _vignette(rng, image.shape[1], image.shape[0], ranges)
    sigma = rng.uniform(*ranges.blur)
    if sigma > 0.2:
        image = cv2.GaussianBlur(image, (0, 0), sigma)
    if rng.random() < 0.25:  # cameras sharpen; that leaves bright seams along dark shafts
        image = image + rng.uniform(0.2, 1.0) * (image - cv2.GaussianBlur(image, (0, 0), rng.uniform(0.7, 1.5)))
    image = tone(rng, image, ranges)
    image = np.clip(_noise(rng, image, ranges), 0, 1)
    if rng.random() < 0.7:
        image = _jpeg(rng, image, ranges)
    if rng.random() < 0.08:
        image = image * _round_mask(rng, image.shape[1], image.shape[0])
    return image.astype(np.float32)


def tone(rng: np.random.Generator, image: Image, ranges: AppearanceRanges) -> Image:
    """Exposure, white balance, contrast and tone curve alone."""
    factor = rng.uniform(*ranges.brightness) * rng.uniform(*ranges.white_balance, size=3)
    # The floor holds for the whole image; white balance moves colours about it.
    factor *= max(1.0, ranges.brightness[0] / factor.mean())
    image = np.clip(image * factor.astype(np.float32), 0, 1.2)
    mean = image.mean()
    image = mean + (image - mean) * rng.uniform(*ranges.contrast)
    return np.clip(image, 0, 1) ** np.float32(rng.uniform(*ranges.gamma))


def _vignette(rng: np.random.Generator, width: int, height: int, ranges: AppearanceRanges) -> np.ndarray:
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x, y = x / width - 0.5, y / height - 0.5
    light = 1 - rng.uniform(*ranges.vignette) * np.clip((x * x + y * y) * 2, 0, 1)
    if rng.random() < 0.6:
        light = light * np.exp(
            rng.uniform(0, ranges.unevenness) * smooth_noise(rng, width, height, rng.uniform(2, 5), 1)
        )
        # Light that is uneven is not low light: the image as a whole stays as bright as it was.
        light = light / light.mean()
    return np.clip(light, 0.35, 1.6)[..., None]


def _noise(rng: np.random.Generator, image: np.ndarray, ranges: AppearanceRanges) -> np.ndarray:
    height, width = image.shape[:2]
    sigma = rng.uniform(*ranges.noise)
    luminance = rng.standard_normal((height, width, 1), np.float32)
    color = cv2.resize(rng.standard_normal((height // 2, width // 2, 3), np.float32), (width, height))
    return image + sigma * (luminance + 0.7 * color) * (0.5 + image)


def _jpeg(rng: np.random.Generator, image: np.ndarray, ranges: AppearanceRanges) -> np.ndarray:
    quality = int(rng.uniform(*ranges.jpeg_quality))
    coded = cv2.imencode(".jpg", (image[..., ::-1] * 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded = cv2.imdecode(coded, cv2.IMREAD_COLOR)
    assert decoded is not None
    return decoded[..., ::-1].astype(np.float32) / 255


def _round_mask(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """The black surround of a round endoscope image."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    radius = np.hypot(x - width * rng.uniform(0.4, 0.6), y - height * rng.uniform(0.4, 0.6))
    edge = rng.uniform(0.55, 0.75) * width
    return np.clip((edge - radius) / rng.uniform(1, 6), 0, 1)[..., None]
