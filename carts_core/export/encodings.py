"""Encodings of masks and images: PNG, run-length encoding and polygons."""

import cv2
import numpy as np
from jaxtyping import Bool, Int, UInt, UInt8

from ..errors import CartsError


def mask_png(mask: Bool[np.ndarray, "height width"]) -> bytes:
    """Encode a mask as PNG: 255 on arms, 0 elsewhere."""
    return label_png(mask.astype(np.uint8) * 255)


def label_png(labels: UInt[np.ndarray, "height width *channels"]) -> bytes:
    """Encode labels or grey values of 8 or 16 bits, or BGR(A), as PNG."""
    ok, data = cv2.imencode(".png", labels)
    if not ok:
        raise CartsError(f"an image of shape {labels.shape} could not be written as PNG: OpenCV's encoder failed.")
    return data.tobytes()


def image_png(image: UInt8[np.ndarray, "height width channels"]) -> bytes:
    """Encode an RGB or RGBA image as PNG."""
    code = cv2.COLOR_RGBA2BGRA if image.shape[-1] == 4 else cv2.COLOR_RGB2BGR
    return label_png(cv2.cvtColor(image, code))


def coco_rle(mask: Bool[np.ndarray, "height width"]) -> dict[str, object]:
    """Encode a mask as COCO's compressed run-length encoding (column-major): `size` as [height, width], and `counts` as
    text."""
    from pycocotools import mask as coco_mask  # noqa: PLC0415

    counts = coco_mask.encode(np.asfortranarray(mask, dtype=np.uint8))["counts"]
    assert isinstance(counts, bytes)
    return {"size": list(mask.shape), "counts": counts.decode("ascii")}


def row_runs(mask: Bool[np.ndarray, "height width"]) -> list[int]:
    """Row-major run lengths, alternately outside and inside the mask; the first run is outside and may have length
    0."""
    flat = mask.ravel()
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    lengths = np.diff(changes, prepend=0, append=flat.size).tolist()
    return [0, *lengths] if flat[0] else lengths


def bounding_box(mask: Bool[np.ndarray, "height width"]) -> tuple[int, int, int, int]:
    """Bounding box (left, top, width, height) [px] of a nonempty mask."""
    columns, rows = np.flatnonzero(mask.any(0)), np.flatnonzero(mask.any(1))
    return int(columns[0]), int(rows[0]), int(columns[-1] - columns[0] + 1), int(rows[-1] - rows[0] + 1)


MIN_POINTS = 3
"""Minimum number of points that readers accept as a polygon."""


def polygons(mask: Bool[np.ndarray, "height width"]) -> list[Int[np.ndarray, "points 2"]]:
    """Closed polygon for each connected component of a mask, through the centres of its boundary pixels.

    If filled including its edges, as in OpenCV, each polygon reproduces its component exactly. Holes are connected to
    the outline by slits of zero width, since a polygon has a single boundary.

    Returns:
        Integer points (column, row) [px]; the centre of pixel (0, 0) is at (0, 0).
    """
    contours, hierarchy = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return []
    rims = [contour[:, 0] for contour in contours]
    parents = hierarchy[0, :, 3]
    parts = []
    for index in np.flatnonzero(parents < 0):
        part = _corners(_with_holes(rims[index], [rims[hole] for hole in np.flatnonzero(parents == index)]))
        parts.append(np.concatenate([part, part[-1:].repeat(max(MIN_POINTS - len(part), 0), axis=0)]))
    return parts


def _with_holes(rim: np.ndarray, holes: list[np.ndarray]) -> np.ndarray:
    """Closed polyline along the outline and all holes. The shortest link is added first, so that no link crosses
    another hole. Afterwards, the links of the remaining holes are only compared with links to the new points.
    """
    if not holes:
        return rim
    points, first = np.concatenate(holes), np.cumsum([0, *map(len, holes)])
    length, at, start = _links(rim, points, first)
    for _ in holes:
        nearest = int(length.argmin())
        joint, hole = int(at[nearest]), np.roll(holes[nearest], -int(start[nearest]), axis=0)
        rim = np.concatenate([rim[: joint + 1], hole, hole[:1], rim[joint:]])
        at[at > joint] += len(hole) + 2
        new_length, new_at, new_start = _links(hole, points, first)
        # Among links of equal length, the first along the line is used.
        better = (new_length < length) | ((new_length == length) & (at > joint))
        better &= np.isfinite(length)
        length[better], at[better], start[better] = new_length[better], joint + 1 + new_at[better], new_start[better]
        length[nearest] = np.inf
    return rim


_ROWS = 512
"""Number of points whose distances are computed at once."""


def _links(line: np.ndarray, points: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shortest link from a line to each hole: squared length [px^2], index along the line, index along the hole.

    Args:
        points: points of all holes; those of hole n are `first[n]` to `first[n + 1]`.
    """
    from scipy.spatial.distance import cdist  # noqa: PLC0415

    length, at = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
    for row in range(0, len(line), _ROWS):
        distances = cdist(line[row : row + _ROWS], points, "sqeuclidean")
        nearest = distances.argmin(0)
        shorter = distances[nearest, np.arange(len(points))]
        at = np.where(shorter < length, row + nearest, at)
        length = np.minimum(length, shorter)
    rank = length * len(line) + at
    least = np.minimum.reduceat(rank, first[:-1])
    equal = np.flatnonzero(rank == least.repeat(np.diff(first)))
    chosen = equal[np.searchsorted(equal, first[:-1])]
    return length[chosen], at[chosen], chosen - first[:-1]


def _corners(line: np.ndarray) -> np.ndarray:
    """Remove the intermediate points of straight segments from a closed line."""
    before, after = line - np.roll(line, 1, axis=0), np.roll(line, -1, axis=0) - line
    corners = line[(before != after).any(1)]
    return corners if len(corners) else line[:1]
