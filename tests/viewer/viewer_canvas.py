"""Looking at the canvas: where the frame is on the screen, and whether the overlay lies where it should."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from playwright.sync_api import Page

from carts_viewer.app import ViewerApp
from carts_viewer.picture.layers import ARM_COLORS
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.state import ViewState

T = TypeVar("T")
MARKERS = ((0.30, 0.30), (0.70, 0.30), (0.30, 0.70), (0.70, 0.70))
"""Where the red discs are in the marked frame, as shares of its width and height."""
RADIUS = 0.03
"""Of a disc, as a share of the width."""


def mark_frames(folder: Path) -> None:
    """Overwrite the left camera's images of a tiny sequence by red discs on black."""
    for path in (folder / "regular" / "left").iterdir():
        _mark(path)


def decoded(content: bytes, flags: int = cv2.IMREAD_UNCHANGED) -> np.ndarray:
    """The picture in a file's content."""
    image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    assert image is not None
    return image


def _mark(path: Path) -> None:
    height, width = decoded(path.read_bytes()).shape[:2]
    y, x = np.mgrid[:height, :width] + 0.5
    image = np.zeros((height, width, 3), np.uint8)
    for u, v in MARKERS:
        image[np.hypot(x - u * width, y - v * height) < RADIUS * width] = (0, 0, 255)
    cv2.imwrite(str(path), image)


class Canvas:
    """The picture in a tab."""

    def __init__(self, app: ViewerApp, page: Page) -> None:
        self._app = app
        self._page = page
        self._renderer = OverlayRenderer(app.sequence)

    @property
    def _state(self) -> ViewState:
        """What this tab shows, as the viewer has it."""
        key = self._page.evaluate("carts.key")
        return next(place for place in self._app.tabs if place.key == key).controller.state

    def screenshot(self) -> np.ndarray:
        """RGB [height, width, 3] of the canvas as a person sees it, the tool bar blanked."""
        box = self._page.locator("canvas").first.bounding_box()
        assert box is not None
        png = self._page.screenshot(clip={"x": box["x"], "y": box["y"], "width": box["width"], "height": box["height"]})
        image = decoded(png, cv2.IMREAD_COLOR)[..., ::-1].copy()
        image[: self._bar_height()] = 0
        image[image.shape[0] - self._strip_height() :] = 0
        return image

    def _strip_height(self) -> int:
        """How far up the timeline hides the picture [px]."""
        box = self._page.locator(".carts-strip").first.bounding_box()
        return 1 if box is None else int(box["height"]) + 1

    def _bar_height(self) -> int:
        """How far down the tool bar hides the picture [px]."""
        bar, box = (self._page.locator(name).first.bounding_box() for name in (".carts-bar", "canvas"))
        assert bar is not None and box is not None
        return int(bar["y"] + bar["height"] - box["y"]) + 1

    def screen_from_image(self, image: np.ndarray) -> np.ndarray | None:
        """The affine map [2, 3] from image to canvas coordinates that the red discs show; None when they do not."""
        red = (image[..., 0] > 120) & (image[..., 1] < 90) & (image[..., 2] < 90)
        _, _, stats, centroids = cv2.connectedComponentsWithStats(red.astype(np.uint8))
        order = np.argsort(-stats[1:, cv2.CC_STAT_AREA])[:4] + 1
        if len(order) < 4:
            return None
        found = centroids[order] + 0.5
        camera = self._app.scene.camera(self._state.camera)
        wanted = np.array(MARKERS) * (camera.width, camera.height)
        by_row = sorted(found.tolist(), key=lambda point: point[1])
        found = np.array([*sorted(by_row[:2]), *sorted(by_row[2:])])
        map_, *_ = np.linalg.lstsq(np.c_[wanted, np.ones(4)], found, rcond=None)
        straight = np.abs(np.c_[wanted, np.ones(4)] @ map_ - found).max() < 0.5
        return map_.T if straight else None

    def misregistration(self) -> float:
        """95th percentile of the distance [px of the screen] between the overlay's outline and where it should be."""
        image = self.screenshot()
        map_ = self.screen_from_image(image)
        if map_ is None:
            return float("inf")
        shown = np.linalg.norm(image.astype(float) - ARM_COLORS[0], axis=-1) < 60
        arm_ids = self._renderer.arm_ids(self._state.pose.scene, self._state.camera)
        wanted = _warped(arm_ids >= 0, map_, image.shape[:2])
        wanted[: self._bar_height()] = False
        wanted[wanted.shape[0] - self._strip_height() :] = False
        if not shown.any() or not wanted.any():
            return float("inf")
        return max(_outline_distance(shown, wanted), _outline_distance(wanted, shown))

    def where(self, good: Callable[[np.ndarray], bool] = lambda map_: True) -> np.ndarray:
        """Wait until the frame is seen, at a good place, and give the map from image to canvas coordinates."""
        map_ = eventually(
            lambda: self.screen_from_image(self.screenshot()), lambda map_: map_ is not None and good(map_)
        )
        assert map_ is not None
        return map_

    def eventually_registered(self, limit: float = 1.5) -> float:
        """Wait until the overlay lies where it should, and give the distance that was reached."""
        return eventually(self.misregistration, lambda distance: distance <= limit)


def eventually(read: Callable[[], T], good: Callable[[T], bool], timeout: float = 30.0) -> T:
    """Read until the value is good; fails with the last one."""
    end = time.monotonic() + timeout
    while True:
        value = read()
        if good(value):
            return value
        assert time.monotonic() < end, f"still {value!r} after {timeout} s"
        time.sleep(0.1)


def _warped(mask: np.ndarray, map_: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """An image's mask on the screen. OpenCV counts from pixel centres, the map from pixel corners."""
    shifted = map_.copy()
    shifted[:, 2] += map_[:, :2] @ (0.5, 0.5) - 0.5
    smooth = cv2.warpAffine(mask.astype(np.float32), shifted, size[::-1], flags=cv2.INTER_LINEAR)
    return smooth > 0.5


def _outline_distance(mask: np.ndarray, other: np.ndarray) -> float:
    """95th percentile of the distance from the outline of one mask to that of the other [px]."""

    def outline(values: np.ndarray) -> np.ndarray:
        return cv2.morphologyEx(values.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8)) > 0

    distance = cv2.distanceTransform((~outline(other)).astype(np.uint8), cv2.DIST_L2, 5)
    return float(np.percentile(distance[outline(mask)], 95))
