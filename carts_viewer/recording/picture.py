"""The image of a frame with the arms as they would be seen, and the points that were clicked in it."""

from collections.abc import Sequence as Rows

import cv2
import numpy as np

from carts_core.model.scene import Scene
from carts_core.optimization.hand_eye import ImagePoint
from carts_core.recording import Sequence
from carts_viewer import layers
from carts_viewer.layers import Rgba
from carts_viewer.overlay import OverlayRenderer
from carts_viewer.scene_view import SceneView
from carts_viewer.transport.page import Page

_GOOD, _WRONG, _EDGE = (250, 204, 21, 255), (239, 68, 68, 255), (0, 0, 0, 255)
_OPACITY = 0.9


class FramePicture:
    """What lies behind the document at its side."""

    def __init__(self, page: Page, sequence: Sequence) -> None:
        self._page = page
        self._sequence = sequence
        self._renderer = OverlayRenderer(sequence)
        self._shown: tuple[int, str] | None = None
        frame = sequence.frame(0)
        state = sequence.scene.state(frame.measured, mounts=frame.mounts)
        self._view = SceneView(page.server.scene, sequence.scene, state, sequence.scene.cameras[0].name)

    def show(
        self,
        index: int,
        camera: str,
        scene: Scene | None,
        points: Rows[ImagePoint],
        wrong: frozenset[int],
    ) -> None:
        """Show a frame.

        Args:
            index: of the frame.
            camera: whose image.
            scene: with a calibration that is worth showing; None without one.
            points: all that were clicked.
            wrong: which of these contradict the others.
        """
        frame = self._sequence.frame(index, cameras=[camera])
        own = self._sequence.scene.camera(camera)
        if scene is None:
            picture = layers.nothing(own.height, own.width)
        else:
            ids = self._renderer.arm_ids(scene.state(frame.measured, mounts=frame.mounts), camera)
            picture = layers.contour(ids, _OPACITY)
        for row, point in enumerate(points):
            if point.frame == index and point.camera == camera:
                _cross(picture, point, _WRONG if row in wrong else _GOOD)
        with self._page.server.atomic():
            if self._shown != (index, camera):
                self._view.show_frame(frame.images[camera], own)
            self._view.show_overlay(picture, own)
        self._page.server.flush()
        self._shown = (index, camera)


def _cross(picture: Rgba, point: ImagePoint, color: tuple[int, int, int, int]) -> None:
    size = max(picture.shape[:2]) / 640
    at = (int(np.floor(point.pixel[0])), int(np.floor(point.pixel[1])))
    for shade, thickness in ((_EDGE, 3 * size), (color, size)):
        cv2.drawMarker(picture, at, shade, cv2.MARKER_CROSS, round(11 * size), max(1, round(thickness)))
