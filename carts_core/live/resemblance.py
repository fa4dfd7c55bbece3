"""Whether two frames show the same."""

import cv2
import numpy as np
from jaxtyping import Float

from ..recording import Frame

CHANGED = 0.5
"""Change of small pictures from which they show something else: they correlate by less than a half [1]."""
_SIZE = (32, 24)
"""Width and height of small pictures [px]."""

Picture = Float[np.ndarray, "cameras pixels"]


def small_picture(frame: Frame) -> Picture:
    """The images, small and gray, each without its mean."""
    small = [cv2.resize(image, _SIZE, interpolation=cv2.INTER_AREA) for image in frame.images.values()]
    pixels = np.stack([image.reshape(_SIZE[0] * _SIZE[1], -1).mean(axis=1) for image in small]).astype(float)
    return pixels - pixels.mean(axis=1, keepdims=True)


def change(before: Picture, now: Picture) -> float:
    """How much pictures have changed, in the camera where they did most [1]: 0.7 where they have nothing in common."""
    sizes = np.linalg.norm(before, axis=1) + np.linalg.norm(now, axis=1)
    return float((np.linalg.norm(now - before, axis=1) / (sizes + np.sqrt(before.shape[1]))).max())
