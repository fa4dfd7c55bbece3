"""Rasterization of annotated shapes. A pixel belongs to a shape if its centre is inside; the origin of coordinates is
the upper left corner of the image, so the centre of the first pixel is at (0.5, 0.5).

Invalid shapes raise `ValueError` with a clause that describes the error.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from ...files.reading import pixels_problem

MAX_SIDE = 16384
"""Maximum width or height of an image [px]."""
MAX_SHAPES = 5_000
"""Maximum number of shapes of an image, and of polygons of an annotation."""
MAX_VERTICES = 100_000
"""Maximum number of vertices of a polygon."""
_MIN_VERTICES = 3
_CROSSINGS = 2**20
"""Number of edge crossings that are computed at once."""

_BITS, _MORE, _SIGN, _FIRST = 5, 0x20, 0x10, 48
"""Constants of COCO's run-length text: five bits per character, with offset "0"."""


def check_shapes(count: int) -> None:
    """Check the number of shapes of an image."""
    if count > MAX_SHAPES:
        raise ValueError(f"it has {count} shapes; at most {MAX_SHAPES} are allowed")


def check_size(height: int, width: int) -> tuple[int, int]:
    """Check the size of an image [px] and return it."""
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE) or pixels_problem(width, height):
        raise ValueError(f"its size is {width} x {height}")
    return height, width


def checked_points(values: object) -> Float[np.ndarray, "points 2"]:
    """Points [px] from pairs or a flat list of numbers, which must be finite and not far outside of an image."""
    given = np.asarray(values, np.float64)
    if given.ndim > 2 or (given.ndim == 2 and given.size and given.shape[1] != 2) or given.size % 2:
        raise ValueError("its points are not pairs of x and y")
    points = given.reshape(-1, 2)
    if not np.isfinite(points).all() or np.abs(points).max(initial=0) > 2 * MAX_SIDE:
        raise ValueError("a point is not finite or far outside the image")
    return points


def runs_of_text(text: str) -> list[int]:
    """Decode COCO's compressed run lengths."""
    runs: list[int] = []
    value = place = 0
    for character in text:
        code = ord(character) - _FIRST
        if not 0 <= code < 2 * _MORE or place > 40:
            raise ValueError(f"the character {character!r} does not occur in run lengths")
        value |= (code & (_MORE - 1)) << place
        place += _BITS
        if not code & _MORE:
            if code & _SIGN:
                value -= 1 << place
            runs.append(value + (runs[-2] if len(runs) > 2 else 0))
            value = place = 0
    if place:
        raise ValueError("the run lengths end within a number")
    return runs


def mask_of_runs(runs: Sequence[int], height: int, width: int, *, by_columns: bool) -> Bool[np.ndarray, "height width"]:
    """Mask from alternating run lengths, beginning with background, whose sum must be the number of pixels."""
    lengths = np.asarray(runs, np.int64)
    if lengths.ndim != 1 or (lengths < 0).any() or (lengths > height * width).any() or lengths.sum() != height * width:
        raise ValueError(f"the run lengths do not sum to {width} x {height} pixels")
    flat = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
    return flat.reshape(width, height).T if by_columns else flat.reshape(height, width)


def mask_of_polygon(
    points: Float[np.ndarray, "vertices 2"], height: int, width: int
) -> Bool[np.ndarray, "height width"]:
    """Pixels whose centres are inside a polygon, by the even-odd rule; vertices [px] may lie outside the image."""
    if not _MIN_VERTICES <= len(points) <= MAX_VERTICES:
        raise ValueError(f"a polygon has {len(points)} vertices; {_MIN_VERTICES} to {MAX_VERTICES} are allowed")
    mask = np.zeros((height, width), bool)
    x0, y0, x1, y1 = np.column_stack([points, np.roll(points, -1, axis=0)]).T
    first = np.clip(np.ceil(np.minimum(y0, y1) - 0.5), 0, height).astype(np.int64)
    last = np.clip(np.ceil(np.maximum(y0, y1) - 0.5), 0, height).astype(np.int64)
    crossing = last > first
    if not crossing.any():
        return mask
    x0, y0, x1, y1, first, last = (values[crossing] for values in (x0, y0, x1, y1, first, last))
    top, bottom = int(first.min()), int(last.max())
    flips = np.zeros((bottom - top, width + 1), np.uint8)
    counts = last - first
    ends = np.cumsum(counts)
    start = 0
    while start < len(counts):
        before = int(ends[start - 1]) if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, before + _CROSSINGS, side="right")))
        edges = np.repeat(np.arange(start, stop), counts[start:stop])
        rows = first[edges] + np.arange(len(edges)) - (ends - counts)[edges] + before
        # Column where the edge crosses the middle of the row; pixel centres to the right are on its other side.
        x = x0[edges] + (rows + 0.5 - y0[edges]) * (x1 - x0)[edges] / (y1 - y0)[edges]
        columns = np.clip(np.ceil(x - 0.5), 0, width).astype(np.int64)
        np.add.at(flips, (rows - top, columns), 1)  # Overflow keeps the parity.
        start = stop
    mask[top:bottom] = np.bitwise_xor.accumulate(flips[:, :width] & 1, axis=1)
    return mask


def mask_of_ellipse(
    centre: Sequence[float], radii: Sequence[float], angle: float, height: int, width: int
) -> Bool[np.ndarray, "height width"]:
    """Pixels whose centres are inside an ellipse.

    Args:
        centre: column and row [px].
        radii: along the axes of the ellipse [px].
        angle: clockwise rotation of its first axis from the horizontal axis [rad].
    """
    (x, y), (a, b) = checked_points(centre)[0], checked_points(radii)[0]
    if a <= 0 or b <= 0 or not np.isfinite(angle):
        raise ValueError(f"its radii are {a:g} and {b:g}")
    cosine, sine = np.cos(angle), np.sin(angle)
    half = np.hypot(a * cosine, b * sine), np.hypot(a * sine, b * cosine)
    left, right = (int(np.clip(edge, 0, width)) for edge in (np.floor(x - half[0]), np.ceil(x + half[0])))
    top, bottom = (int(np.clip(edge, 0, height)) for edge in (np.floor(y - half[1]), np.ceil(y + half[1])))
    dx, dy = np.arange(left, right) + 0.5 - x, (np.arange(top, bottom) + 0.5 - y)[:, None]
    along, across = (dx * cosine + dy * sine) / a, (dy * cosine - dx * sine) / b
    mask = np.zeros((height, width), bool)
    mask[top:bottom, left:right] = along**2 + across**2 <= 1
    return mask


def corners_of_box(corner: Sequence[float], size: Sequence[float], angle: float = 0.0) -> Float[np.ndarray, "4 2"]:
    """Corners of a rectangle [px], rotated clockwise by `angle` [rad] around its first corner."""
    (x, y), (wide, high) = checked_points(corner)[0], checked_points(size)[0]
    cosine, sine = np.cos(angle), np.sin(angle)
    along, down = np.array([cosine, sine]) * wide, np.array([-sine, cosine]) * high
    return checked_points(np.array([x, y]) + np.stack([0 * along, along, along + down, down]))
