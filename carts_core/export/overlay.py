"""The rendered arms over the recorded image, for people."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, UInt8

from ..model.scene import SceneState
from ..rendering import Renderer

_CONTOUR = (80, 255, 120)


def image_and_mask(
    renderer: Renderer, state: SceneState
) -> tuple[UInt8[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"]]:
    """The first camera's rendering as RGB, and its mask."""
    with torch.no_grad():
        rendering = renderer(state)
    image = (rendering.image[0].movedim(0, -1) * 255.0).to(torch.uint8).numpy()
    return image, rendering.silhouette[0].numpy() > 0.5


def overlay(
    frame: UInt8[np.ndarray, "height width 3"],
    image: UInt8[np.ndarray, "height width 3"],
    mask: Bool[np.ndarray, "height width"],
    opacity: float,
) -> UInt8[np.ndarray, "height width 3"]:
    """The rendering blended over the frame where the mask is, RGB."""
    return np.where(mask[..., None], cv2.addWeighted(frame, 1.0 - opacity, image, opacity, 0.0), frame)


def outlined(
    frame: UInt8[np.ndarray, "height width 3"], mask: Bool[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """The frame with a bright line along the rim of the mask, RGB."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(frame.copy(), contours, -1, _CONTOUR, 1)
