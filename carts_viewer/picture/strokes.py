"""Strokes over a frame: tools, parsing of strokes from a browser, and their effect on painted layers."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

import cv2
import msgspec
import numpy as np
from jaxtyping import Bool, Float

from carts_core.errors import SettingsError
from carts_core.model.camera import Camera
from carts_core.project import IgnoreRegion, MaskCorrection, PartLabels
from carts_viewer.transport.events import Event

DIAMETERS = (1, 300)
"""Minimum and maximum diameter of the brush [px]."""
MAX_STROKE_POINTS = 20_000
"""Maximum number of points of a stroke; the page splits longer strokes."""
_SUBPIXELS = 3
"""Subpixels per pixel and axis at which strokes are drawn; odd, so that one is in the middle."""
_FRACTION_BITS = 4
"""Fractional bits of pixel coordinates passed to OpenCV."""

Mask = Bool[np.ndarray, "height width"]
_Count = Annotated[int, msgspec.Meta(ge=0, lt=2**53)]


class Tool(StrEnum):
    """Tool of the pointer; the value is its label."""

    SELECT = "Select"
    DRAG = "Drag link"
    KEYPOINT = "Keypoint"
    BRUSH = "Brush"
    POLYGON = "Polygon"
    ERASER = "Eraser"
    PROMPT = "Prompt"

    @property
    def paints(self) -> bool:
        """Whether the tool changes a painted layer."""
        return self in (Tool.BRUSH, Tool.POLYGON, Tool.ERASER, Tool.PROMPT)


class Target(StrEnum):
    """The layer that a stroke changes; the value is the label in the page."""

    MASK = "Mask"
    IGNORE = "Ignore region"


@dataclass(frozen=True)
class Brush:
    """Tool of a tab, and what it paints."""

    tool: Tool = Tool.SELECT
    target: Target = Target.MASK
    label: int = 0
    """Number of the class that is painted on the mask (`carts_core.model.parts.PartClass`); 0 for any arm."""
    diameter: int = 20
    """Diameter of the brush [px]."""
    painted: Mapping[int, int] = field(default_factory=dict)
    """Number of each tab's last applied stroke."""


@dataclass(frozen=True, eq=False)
class Stroke:
    """One stroke or polygon, checked and clamped."""

    number: int
    """Number of the stroke, counted by its tab."""
    frame: int
    """Index of the frame on which the stroke was drawn; another frame may be shown by now."""
    camera: str
    target: Target
    erase: bool
    polygon: bool
    diameter: int
    """Diameter of the brush [px]; not used by polygons."""
    points: Float[np.ndarray, "points 2"]
    """(u, v) [px], at most one image size beyond the image."""
    label: int = 0
    """Number of the painted class; 0 for any arm."""
    prompt: bool = False
    """Whether the point, or the box between the two points, is a prompt to the segmenter."""

    def covers(self, camera: Camera) -> Mask:
        """The pixels of the camera's image that the stroke covers."""
        margin = math.ceil(self.diameter / 2) + 1
        # Lines just outside of the image also cover its pixels, so the canvas has a margin on each side.
        limits = (camera.width + 2 * margin, camera.height + 2 * margin)
        covered = np.zeros(limits[::-1], bool)
        image = covered[margin:-margin, margin:-margin]
        drawn = self.points + margin
        left, top = np.clip(np.floor(drawn.min(0) - margin), 0, limits).astype(int)
        right, bottom = np.clip(np.ceil(drawn.max(0) + margin), 0, limits).astype(int)
        if right <= left or bottom <= top:
            return image
        # Thin lines on subpixels and their distances, since OpenCV rounds thick lines to whole pixels.
        canvas = np.ones((_SUBPIXELS * (bottom - top), _SUBPIXELS * (right - left)), np.uint8)
        # OpenCV places integer coordinates at pixel centres, this package at pixel corners.
        points = _SUBPIXELS * (drawn - (left, top)) - 0.5
        line = np.rint(points * 2**_FRACTION_BITS).astype(np.int32)
        if self.polygon:
            cv2.fillPoly(canvas, [line], 0, cv2.LINE_8, _FRACTION_BITS)
            inside = canvas == 0
        else:
            cv2.polylines(canvas, [np.append(line, line[-1:], axis=0)], False, 0, 1, cv2.LINE_8, _FRACTION_BITS)
            distance = cv2.distanceTransform(canvas, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            inside = distance <= _SUBPIXELS * self.diameter / 2
        middle = slice(_SUBPIXELS // 2, None, _SUBPIXELS)
        covered[top:bottom, left:right] = inside[middle, middle]
        return image


class Painted(Event):
    """A stroke as a tab reports it."""

    number: _Count
    frame: _Count
    camera: str
    target: Target
    erase: bool
    polygon: bool
    diameter: Annotated[float, msgspec.Meta(gt=0)]
    points: Annotated[list[tuple[float, float]], msgspec.Meta(min_length=1, max_length=MAX_STROKE_POINTS)]
    label: _Count = 0
    prompt: bool = False


def read_stroke(painted: Painted, frames: int, cameras: Mapping[str, Camera], classes: int = 0) -> Stroke:
    """Check a stroke, given the numbers of frames and classes and the cameras by name; clamp its points and diameter.

    Raises:
        SettingsError: the frame, camera or class does not exist, or the number of points is invalid.
    """
    camera, count = cameras.get(painted.camera), len(painted.points)
    shaped = count <= 2 if painted.prompt else count >= 3 or not painted.polygon
    if camera is None or painted.frame >= frames or painted.label > classes or not shaped:
        raise SettingsError(
            f"the message is not a stroke in one of {frames} frames of a camera ({', '.join(cameras)}). Draw it in "
            "this viewer's page."
        )
    size = np.array([camera.width, camera.height], float)
    return Stroke(
        number=painted.number,
        frame=painted.frame,
        camera=camera.name,
        target=painted.target,
        erase=painted.erase,
        polygon=painted.polygon,
        diameter=round(min(max(painted.diameter, DIAMETERS[0]), DIAMETERS[1])),
        points=np.clip(np.array(painted.points, float), -size, 2 * size),
        label=painted.label,
        prompt=painted.prompt,
    )


def corrected(old: MaskCorrection | None, stroke: Mask, rendered: Mask, *, erase: bool) -> MaskCorrection | None:
    """The correction after a stroke that adds pixels to the mask or removes them; None if it is empty.

    Only pixels that are not rendered are added, and only rendered pixels are removed.
    """
    nothing = np.zeros_like(stroke)
    added, removed = (nothing, nothing) if old is None else (old.added(), old.removed())
    if erase:
        added, removed = added & ~stroke, removed | (stroke & rendered)
    else:
        added, removed = added | (stroke & ~rendered), removed & ~stroke
    return MaskCorrection.of(added & ~removed, removed) if added.any() or removed.any() else None


def relabelled(old: PartLabels | None, stroke: Mask, label: int, *, erase: bool) -> PartLabels | None:
    """The painted classes after a stroke on the mask; None if there are none.

    Removed pixels lose their class; pixels added without a class keep theirs.
    """
    if (not erase and not label) or (erase and old is None):
        return old
    labels = np.zeros(stroke.shape, np.uint8) if old is None else old.labels().copy()
    labels[stroke] = 0 if erase else label
    return PartLabels.of(labels) if labels.any() else None


def ignored(old: IgnoreRegion | None, stroke: Mask, *, erase: bool) -> IgnoreRegion | None:
    """The ignore region after a stroke; None if it is empty."""
    region = np.zeros_like(stroke) if old is None else old.region()
    region = region & ~stroke if erase else region | stroke
    return IgnoreRegion.of(region) if region.any() else None
