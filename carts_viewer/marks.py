"""Keypoints over the picture: a ring where the pose has each of them, a cross where a person says that it is."""

from collections.abc import Iterable

import cv2
import numpy as np

from carts_core.model.keypoints import Keypoint, keypoints, project_keypoints
from carts_core.model.scene import Scene, SceneState
from carts_core.optimization.keypoints import Pin
from carts_viewer.layers import Rgba

_RING, _CROSS, _EDGE = (255, 255, 255, 255), (250, 204, 21, 255), (0, 0, 0, 255)


def labelled_keypoints(scene: Scene) -> dict[str, Keypoint]:
    """All keypoints of a scene by what people read; the arm is named where there are several."""
    points = [point for arm in scene.arms for point in keypoints(arm)]
    several = len(scene.arms) > 1
    return {f"{point.arm} {point.name}" if several else point.name: point for point in points}


def draw_keypoints(
    picture: Rgba, scene: Scene, state: SceneState, camera: str, points: Iterable[Keypoint], pins: Iterable[Pin]
) -> None:
    """Draw the keypoints of a pose, and the pins of this camera, into a picture of the camera's image size."""
    size = max(picture.shape[:2]) / 640
    for pixel in project_keypoints(scene, state, list(points), camera).tolist():
        if np.isfinite(pixel).all() and np.abs(pixel).max() < 4 * max(picture.shape):
            for color, thickness in ((_EDGE, 3 * size), (_RING, size)):
                cv2.circle(picture, _corner(pixel), round(5 * size) + 1, color, max(1, round(thickness)))
    for pin in pins:
        if pin.camera == camera:
            for color, thickness in ((_EDGE, 3 * size), (_CROSS, size)):
                at = _corner(pin.pixel)
                cv2.drawMarker(
                    picture, at, color, cv2.MARKER_TILTED_CROSS, round(9 * size) + 2, max(1, round(thickness))
                )


def _corner(pixel: Iterable[float]) -> tuple[int, int]:
    """OpenCV's index of the pixel; ours have their centres at 0.5."""
    u, v = pixel
    return int(np.floor(u)), int(np.floor(v))
