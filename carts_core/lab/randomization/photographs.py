"""Photographs in a folder as backgrounds of training images."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from ...errors import SettingsError
from ...files.image_size import size_problem
from ...files.reading import IMAGE, read_bytes

Image = Float[np.ndarray, "h w 3"]

_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff")
_LARGEST = 640
"""Longer side that photographs are reduced to [px]."""
_DARKEST = 0.25
"""Mean brightness that photographs are raised to at least: low light is no part of the training data."""


class Photographs:
    """Random views of the photographs in a folder.

    Args:
        folder: searched with its subfolders; files that are no images by their name are left out.

    Raises:
        SettingsError: there is no photograph, or one cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _SUFFIXES)
        if not paths:
            raise SettingsError(
                f"{folder} holds no photograph. Give a folder with at least one image file ({', '.join(_SUFFIXES)})."
            )
        self._images = [_read(path) for path in paths]

    def __len__(self) -> int:
        return len(self._images)

    def __call__(self, rng: np.random.Generator, width: int, height: int) -> Image:
        """A part of a photograph, turned, mirrored, enlarged and with other colours; RGB in [0, 1]."""
        image = self._images[int(rng.integers(len(self._images)))]
        rows, columns = image.shape[:2]
        if rng.random() < 0.5:
            image = image[:, ::-1]
        # The part is never larger than the photograph, so that little lies beyond its border.
        largest = min(columns / width, rows / height)
        step = largest * np.exp(rng.uniform(np.log(0.3), 0.0))
        turn = rng.normal(0, 12) + 90 * int(rng.integers(4)) * (rng.random() < 0.3)
        centre = np.array([columns, rows]) * 0.5 + rng.uniform(-0.5, 0.5, 2) * (
            columns - step * width,
            rows - step * height,
        )
        motion = cv2.getRotationMatrix2D((width / 2, height / 2), turn, 1 / step)
        motion[:, 2] = np.array([width, height]) / 2 - motion[:, :2] @ centre
        if step > 1:
            image = cv2.GaussianBlur(image, (0, 0), 0.4 * step)
        part = cv2.warpAffine(image, motion, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        return _recolored(rng, part.astype(np.float32) / 255)


def _read(path: Path) -> np.ndarray:
    try:
        content = read_bytes(path, IMAGE)
        image = None if size_problem(content) else cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    except (OSError, cv2.error):
        image = None
    if image is None:
        raise SettingsError(f"photograph {path} cannot be read. Give a readable image file, or take it out.")
    scale = _LARGEST / max(image.shape[:2])
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(image[..., ::-1])


def _recolored(rng: np.random.Generator, image: Image) -> Image:
    """Other exposure, saturation and white balance, sometimes channels swapped."""
    if rng.random() < 0.15:
        image = image[..., rng.permutation(3)]
    grey = image.mean(2, keepdims=True)
    image = grey + (image - grey) * np.float32(rng.uniform(0.3, 1.6))
    image = image * np.clip(rng.normal(1, 0.1, 3), 0.7, 1.3).astype(np.float32) * np.float32(rng.uniform(0.8, 1.3))
    image = np.clip(image, 0, 1)
    return np.clip(image + max(_DARKEST - float(image.mean()), 0.0), 0, 1)
