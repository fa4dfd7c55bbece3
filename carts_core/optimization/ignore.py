"""A proposed ignore mask: where an image contradicts an estimate at the arms, something probably occludes them."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from ..model.scene import Scene

_CONTRADICTS = 0.5
"""Similarity below which a pixel contradicts the estimate: 1 minus the squared difference of surface maps."""
_SMALLEST, _NEAR, _GAP, _RIM = 2, 5, 7, 2
"""Radii at an image width of 320 px [px]: of what is an outline that is off and no object, of the distance from the
silhouette, of holes that are closed, and of what is added all around."""
_MOST = 0.5
"""Part of the silhouette; where more contradicts, the estimate is wrong and not the image."""


def propose_ignore(
    scene: Scene, silhouette: Float[np.ndarray, "cameras h w"], similarity: Float[np.ndarray, "cameras h w"]
) -> dict[str, Bool[np.ndarray, "height width"]]:
    """Pixels that probably show an occluder: areas at the arms where the prediction differs from the rendering.

    An occluder that the network takes for background makes a gap in the arm, one that it takes for an instrument
    sticks out of the arm. Both count, if they touch the silhouette.

    Args:
        scene: with the cameras that took part.
        silhouette: of an estimate, as an `Iterate` carries it.
        similarity: the same of what was compared.

    Returns:
        Camera name -> mask at the camera's size; cameras without a proposal are left out.
    """
    proposals = {}
    for camera, inside, alike in zip(scene.cameras, silhouette > 0.5, similarity, strict=True):
        mask = _proposal(inside, alike < _CONTRADICTS)
        if mask.any():
            size = camera.width, camera.height
            proposals[camera.name] = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST).astype(bool)
    return proposals


def _proposal(inside: Bool[np.ndarray, "h w"], contradicts: Bool[np.ndarray, "h w"]) -> np.ndarray:
    scale = inside.shape[1] / 320.0
    objects = cv2.morphologyEx(contradicts.astype(np.uint8), cv2.MORPH_OPEN, _disc(_SMALLEST * scale))
    _, labels = cv2.connectedComponents(objects)
    near = cv2.dilate(inside.astype(np.uint8), _disc(_NEAR * scale)) > 0
    touching = np.unique(labels[near])
    chosen = np.isin(labels, touching[touching > 0]).astype(np.uint8)
    mask = cv2.dilate(cv2.morphologyEx(chosen, cv2.MORPH_CLOSE, _disc(_GAP * scale)), _disc(_RIM * scale))
    return mask if (mask[inside] > 0).sum() <= _MOST * inside.sum() else np.zeros_like(mask)


def _disc(radius: float) -> np.ndarray:
    side = 2 * max(round(radius), 1) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
