"""Masks, labels and pictures as PNG files."""

import cv2
import numpy as np
from jaxtyping import Bool, UInt, UInt8

from ..errors import CartsError


def mask_png(mask: Bool[np.ndarray, "height width"]) -> bytes:
    """A mask as a PNG file: 255 where an arm is, 0 elsewhere."""
    return _png(mask.astype(np.uint8) * 255)


def label_png(labels: UInt[np.ndarray, "height width"]) -> bytes:
    """Labels of 8 or 16 bits as a PNG file whose grey values they are."""
    return _png(labels)


def image_png(image: UInt8[np.ndarray, "height width channels"]) -> bytes:
    """An RGB or RGBA picture as a PNG file."""
    code = cv2.COLOR_RGBA2BGRA if image.shape[-1] == 4 else cv2.COLOR_RGB2BGR
    return _png(cv2.cvtColor(image, code))


def _png(image: np.ndarray) -> bytes:
    ok, data = cv2.imencode(".png", image)
    if not ok:
        raise CartsError(f"an image of shape {image.shape} could not be written as PNG: OpenCV's encoder failed.")
    return data.tobytes()
