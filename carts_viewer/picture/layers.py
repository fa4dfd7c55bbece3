"""Layers over the frame: pure functions from arm ids, masks and maps to RGBA pictures."""

import colorsys
from collections.abc import Iterable
from enum import StrEnum
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from carts_core.project import IgnoreRegion, MaskCorrection


class Layer(StrEnum):
    """Layer drawn over the frame; the value is the label in the page."""

    SHADED = "Shaded arm"
    MASK = "Mask"
    CONTOUR = "Contour"
    TRUTH = "Ground truth"
    ATTENTION = "Attention map"
    SIMILARITY = "Feature similarity"
    NONE = "None"
    IMPORTED = "Imported masks"
    PARTS = "Parts"
    REFINED = "Refined mask"


ARM_COLORS = ((45, 212, 167), (96, 165, 250), (250, 204, 21), (232, 121, 249))
"""Colours of the arms in mask and contour, in the scene's order, repeated cyclically."""

TRUTH_COLORS = {
    "true positive": (255, 255, 255),
    "false positive": (255, 140, 0),
    "false negative": (220, 20, 30),
    "true negative": (0, 0, 0),
}
"""The paper's colours for the comparison with a ground-truth mask."""

ADDED_COLOR, REMOVED_COLOR, IGNORED_COLOR = (190, 242, 60), (239, 68, 68), (168, 85, 247)
"""Colours of pixels added to the mask, removed from it, or excluded from the optimization."""
RENDERED_COLOR = (255, 255, 255)
"""Colour of the outline of the rendered mask in the layer *Refined mask*."""

Rgba = UInt8[np.ndarray, "height width 4"]
ArmIds = Int[np.ndarray, "height width"]


def small_jpeg(
    image: UInt8[np.ndarray, "height width 3"], *, height: int = 0, width: int = 0, quality: int = 80
) -> bytes:
    """JPEG file of an RGB image that is scaled to this height or width [px]."""
    if width:
        height = max(1, round(image.shape[0] * width / image.shape[1]))
    else:
        width = max(1, round(image.shape[1] * height / image.shape[0]))
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", np.ascontiguousarray(small[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])[
        1
    ].tobytes()


def transparent(height: int, width: int) -> Rgba:
    """A fully transparent picture."""
    return np.zeros((height, width, 4), np.uint8)


def shaded(image: Float[np.ndarray, "3 height width"], arm_ids: ArmIds, opacity: float) -> Rgba:
    """The rendered arms; `image` is RGB in [0, 1]."""
    picture = transparent(*arm_ids.shape)
    # Most of a frame is background, so only the arm's own pixels are converted.
    rows, columns = np.nonzero(arm_ids >= 0)
    picture[rows, columns, :3] = np.clip(image[:, rows, columns].T * 255.0 + 0.5, 0, 255)
    picture[rows, columns, 3] = _byte(opacity)
    return picture


def mask(arm_ids: ArmIds, opacity: float) -> Rgba:
    """Each arm's pixels in the arm's colour."""
    colors, _ = _palette(arm_ids)
    colors[1:, 3] = _byte(opacity)
    return np.take(colors, arm_ids + 1, axis=0)


def refined(arm_ids: ArmIds, rendered: ArmIds, opacity: float) -> Rgba:
    """Each arm's pixels of a refined mask in the arm's colour, and the outline of the rendered mask."""
    picture = mask(arm_ids, opacity)
    inside = (rendered >= 0).view(np.uint8)
    _fill(picture, (inside - cv2.erode(inside, np.ones((3, 3), np.uint8))).view(bool), (*RENDERED_COLOR, 255))
    return picture


def parts(classes: Int[np.ndarray, "height width"], opacity: float) -> Rgba:
    """Each class of parts in its colour (`label_color`); 0 is the background."""
    # As in `_palette`, the background has an invisible colour.
    numbers = range(1, int(classes.max(initial=0)) + 1)
    rows = [(*ARM_COLORS[0], 0), *((*label_color(number), _byte(opacity)) for number in numbers)]
    return np.take(np.array(rows, np.uint8), classes, axis=0)


def contour(arm_ids: ArmIds, opacity: float) -> Rgba:
    """Outline of each arm's visible part in the arm's colour, wide enough to be visible in reduced images."""
    colors, count = _palette(arm_ids)
    colors[1:, 3] = _byte(opacity)
    width = max(2, round(max(arm_ids.shape) / 320))
    near = np.ones((2 * width + 1, 2 * width + 1), np.uint8)
    rim = np.zeros(arm_ids.shape, np.uint8)
    for arm in range(count):
        visible = (arm_ids == arm).view(np.uint8)
        rim += np.uint8(arm + 1) * (visible - cv2.erode(visible, near))
    return np.take(colors, rim, axis=0)


def against_truth(
    predicted: Bool[np.ndarray, "height width"], truth: Bool[np.ndarray, "height width"], opacity: float
) -> Rgba:
    """True and false positives and negatives in the paper's colours."""
    positive, false_positive, false_negative, negative = TRUTH_COLORS.values()
    table = np.array(
        [(*color, _byte(opacity)) for color in (negative, false_negative, false_positive, positive)], np.uint8
    )
    return np.take(table, 2 * predicted.astype(np.uint8) + truth, axis=0)


def imported(
    labels: UInt8[np.ndarray, "height width"] | None,
    points: Iterable[tuple[str, float, float]],
    size: tuple[int, int],
    opacity: float,
) -> Rgba:
    """Imported labels in the colours of `label_color`, and keypoints as crosses; `size` is height and width [px]."""
    picture = transparent(*size)
    if labels is not None:
        colors = np.array([(*label_color(max(number, 1)), _byte(opacity)) for number in range(256)], np.uint8)
        colors[0, 3] = 0
        picture = np.take(colors, labels, axis=0)
    length = max(5, round(max(size) / 60))
    for number, (_, u, v) in enumerate(points, start=1):
        at = round(u - 0.5), round(v - 0.5)
        if 0 <= at[0] < size[1] and 0 <= at[1] < size[0]:
            for color, thickness in (((0, 0, 0), 3), (label_color(number), 1)):
                cv2.drawMarker(picture, at, (*color, 255), cv2.MARKER_CROSS, length, thickness)
    return picture


def label_color(number: int) -> tuple[int, int, int]:
    """Colour of a label, counted from 1: first the arms' colours, then colours spread over the hues."""
    if number <= len(ARM_COLORS):
        return ARM_COLORS[number - 1]
    red, green, blue = colorsys.hsv_to_rgb(0.618 * number % 1.0, 0.65, 0.95)
    return round(255 * red), round(255 * green), round(255 * blue)


def heat(values: Float[np.ndarray, "h w"], low: float, high: float, size: tuple[int, int], opacity: float) -> Rgba:
    """A map at any resolution in the colours of viridis, from `low` (dark) to `high`; `size` is height, width [px]."""
    height, width = size
    share = np.clip((np.nan_to_num(values.astype(np.float32)) - low) / (high - low), 0, 1)
    share = cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR)
    colored = cv2.applyColorMap((share * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    picture = transparent(height, width)
    picture[..., :3] = colored[..., ::-1]
    picture[..., 3] = _byte(opacity)
    return picture


def paint_over(picture: Rgba, correction: MaskCorrection | None, ignored: IgnoreRegion | None, opacity: float) -> None:
    """Draw painted layers into a picture of their size: corrections solid, ignored pixels hatched."""
    if correction is not None:
        _fill(picture, correction.added(), (*ADDED_COLOR, _byte(opacity)))
        _fill(picture, correction.removed(), (*REMOVED_COLOR, _byte(opacity)))
    if ignored is not None:
        region = ignored.region()
        # The layers below stay visible between the lines.
        _fill(picture, region & _hatch(*region.shape), (*IGNORED_COLOR, _byte(opacity)))
        inside = cv2.erode(region.view(np.uint8), np.ones((3, 3), np.uint8)).view(bool)
        _fill(picture, region & ~inside, (*IGNORED_COLOR, 255))


def _fill(picture: Rgba, mask: Bool[np.ndarray, "height width"], color: tuple[int, int, int, int]) -> None:
    """Set pixels to a colour, four bytes at a time."""
    np.copyto(picture.view(np.uint32)[..., 0], np.array(color, np.uint8).view(np.uint32)[0], where=mask)


@lru_cache(maxsize=2)
def _hatch(height: int, width: int) -> Bool[np.ndarray, "height width"]:
    """Mask of hatching lines at 45 degrees."""
    step = max(3, round(max(height, width) / 160))
    rows, columns = np.ogrid[:height, :width]
    return (rows + columns) // step % 2 == 0


def _palette(arm_ids: ArmIds) -> tuple[UInt8[np.ndarray, "arms_and_1 4"], int]:
    """RGBA of background (index 0) and of each arm (its index + 1) up to the last visible arm, and their number."""
    count = int(arm_ids.max(initial=-1)) + 1
    # The browser interpolates colour and opacity separately, so a black background would leave a dark seam.
    rows = [(*ARM_COLORS[0], 0), *((*ARM_COLORS[arm % len(ARM_COLORS)], 255) for arm in range(count))]
    return np.array(rows, np.uint8), count


def _byte(opacity: float) -> int:
    return round(255 * opacity)
