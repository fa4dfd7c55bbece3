"""Estimation of the mean background BG_m of the paper from a recording."""

from collections.abc import Callable, Iterable
from collections.abc import Sequence as Items
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ..errors import SequenceError
from ..model.scene import Scene, SceneState
from ..reprs import short_repr

FRAMES = 30
"""Maximum number of frames, evenly spaced over the recording, for the median background."""

MARGIN = 15 / 640
"""Uncertainty margin around the silhouette of an arm, relative to the width of the image."""

_MAX_ERROR = 3
"""Maximum error of measured kinematics, in margins [1]."""

_STAYS = 0.4
"""Area covered in all views, relative to the mean area covered in a view, above which the arms are considered
immobile [1]."""

_FEWEST = 3
"""Minimum number of views whose agreement makes a pixel known [1]."""

_AGREE = 3.0, 4.0
"""Maximum difference between views of the empty scene: a multiple of the image's median deviation, plus grey levels."""

_COVERED = 256
_ROWS_AT_ONCE = 64


@dataclass(frozen=True, eq=False)
class MeanBackground:
    """Mean background BG_m of a camera and the pixels in which it is known."""

    image: UInt8[np.ndarray, "height width 3"]
    known: Bool[np.ndarray, "height width"]
    """Pixels that show no arm, even with the expected error of measured kinematics."""
    problem: str | None = None
    """Reason why the background is unreliable, as a sentence; None for a reliable background."""

    __repr__ = short_repr


def evenly_spaced(length: int, count: int = FRAMES) -> list[int]:
    """At most `count` different frame numbers, evenly spaced over `length`."""
    return sorted({round(float(index)) for index in np.linspace(0, length - 1, min(count, length))})


def dilate_silhouette(
    silhouette: Bool[np.ndarray, "height width"], margins: int = 1
) -> Bool[np.ndarray, "height width"]:
    """Dilate a silhouette by one or several uncertainty margins of measured kinematics."""
    radius = max(1, round(margins * MARGIN * silhouette.shape[1]))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.dilate(silhouette.astype(np.uint8), disc).astype(bool)


def background_of_recording(
    scene: Scene, camera: str, states: Items[SceneState], image: Callable[[int], UInt8[np.ndarray, "height width 3"]]
) -> MeanBackground:
    """Mean background of a recording: the median of each pixel over the views in which no arm covers this pixel.

    Pixels covered in every view are filled in from their surroundings. A pixel is known if the arms are far from it in
    most views of its median, or if at least three views agree, since an arm that is visible because of inaccurate
    kinematics would move and change its shading.

    Args:
        scene: scene with the camera.
        camera: name of the camera.
        states: measured state of the scene in each view.
        image: index in `states` -> image of the frame.
    """
    # Imported here, so that reading and importing recordings require neither the renderer nor its compiler.
    from ..rendering import ImageRenderer  # noqa: PLC0415

    renderer = ImageRenderer(scene, cameras=[camera])
    arms = [renderer.segment(state)[0] >= 0 for state in states]
    covers = [dilate_silhouette(silhouette) for silhouette in arms]
    clear = len(arms) - np.sum([dilate_silhouette(silhouette, _MAX_ERROR) for silhouette in arms], axis=0)
    used = len(arms) - np.sum(covers, axis=0)
    estimate, deviation = uncovered_median((image(place), cover) for place, cover in enumerate(covers))
    estimate = filled_in(estimate, used == 0)
    agree = (used >= _FEWEST) & (deviation <= _AGREE[0] * np.median(deviation[used > 0]) + _AGREE[1])
    always, usually = (used == 0).sum(), np.mean([cover.sum() for cover in covers])
    problem = None
    if always > _STAYS * usually:
        problem = (
            f"camera {camera!r}: the background behind the arms is unknown and may contain an arm, since the "
            f"arms hardly move in {len(arms)} views. Add a `background` image without arms to the sequence file."
        )
    return MeanBackground(estimate, (2 * clear > used) | agree, problem)


def uncovered_median(
    views: Iterable[tuple[UInt8[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"]]],
) -> tuple[UInt8[np.ndarray, "height width 3"], Float[np.ndarray, "height width"]]:
    """Median of every pixel over the views in which the pixel is not covered, and median absolute deviation [grey
    levels].

    Both are 0 for pixels covered in every view; `SequenceError` if this applies to all pixels.
    """
    images, covers = (np.stack(arrays) for arrays in zip(*views, strict=True))
    seen = (~covers).sum(0)
    if not seen.any():
        raise SequenceError(
            "the background cannot be estimated, since the arms at their measured positions cover every pixel of every "
            "frame. Check T_camera_world and the units of the joints, or give a `background` image."
        )
    median, deviation = np.empty(images.shape[1:], np.uint8), np.empty(images.shape[1:3], np.float32)
    for top in range(0, images.shape[1], _ROWS_AT_ONCE):
        rows = slice(top, top + _ROWS_AT_ONCE)
        covered, count = covers[:, rows, :, None], seen[rows]
        middle = _middle(np.where(covered, _COVERED, images[:, rows].astype(np.int16)), count)
        apart = np.abs(images[:, rows] - middle).max(-1)
        median[rows] = middle
        deviation[rows] = _middle(np.where(covered[..., 0], _COVERED, apart), count)
    return median, deviation


def _middle(values: Int[np.ndarray, "views ..."], count: Int[np.ndarray, "rows columns"]) -> Int[np.ndarray, "..."]:
    """Median over the `count` smallest values at every pixel, rounded up; 0 for a count of 0."""
    values = np.sort(values, axis=0)
    middle = np.maximum(count - 1, 0).reshape(1, *count.shape, *(1,) * (values.ndim - 3)) / 2
    low = np.take_along_axis(values, np.floor(middle).astype(np.intp), 0)[0]
    high = np.take_along_axis(values, np.ceil(middle).astype(np.intp), 0)[0]
    return np.where(count.reshape(middle.shape[1:]) > 0, (low + high + 1) // 2, 0)


def filled_in(
    image: UInt8[np.ndarray, "height width 3"], hole: Bool[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """`image` with permanently covered pixels filled in from their surroundings."""
    # If the kinematic error exceeds the margin, the arm may be visible next to permanently covered pixels.
    rim = dilate_silhouette(hole)
    return fill(image, hole if rim.all() else rim)


def fill(
    image: UInt8[np.ndarray, "height width 3"], hole: Bool[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """`image` with the pixels of `hole` filled in smoothly from their surroundings (pull-push over a pyramid)."""
    if not hole.any():
        return image
    weight = (~hole).astype(np.float32)
    smooth = _pull_push(image.astype(np.float32) * weight[..., None], weight)
    return np.where(hole[..., None], np.clip(np.rint(smooth), 0, 255).astype(np.uint8), image)


def _pull_push(weighted: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Mean colours where `weight` is positive; colours of the next coarser level elsewhere."""
    height, width = weight.shape
    mean = weighted / np.maximum(weight, 1e-6)[..., None]
    if weight.all() or min(height, width) < 2:
        return mean
    coarse = _pull_push(cv2.pyrDown(weighted), cv2.pyrDown(weight))
    coarse = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    trust = np.minimum(weight * 4.0, 1.0)[..., None]
    return trust * mean + (1.0 - trust) * coarse
