"""Masks as polygons, for the formats that know nothing else."""

import cv2
import numpy as np
from jaxtyping import Bool, Int
from scipy.spatial.distance import cdist

MIN_POINTS = 3
"""Readers take fewer points for something else than a polygon."""


def polygons(mask: Bool[np.ndarray, "height width"]) -> list[Int[np.ndarray, "points 2"]]:
    """One closed polygon per connected part of a mask, through the centres of the pixels on its rim.

    Filled with its edges, as OpenCV does, each gives back the very pixels. A hole is reached through a slit of no
    width, since a polygon has one rim only.

    Returns:
        Points (column, row) [px], whole numbers; pixel (0, 0) is at (0, 0).
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
    """One closed line along the rim and all holes. The shortest link first: no other hole can lie across it."""
    while holes:
        distances = [cdist(rim, hole, "sqeuclidean") for hole in holes]
        nearest = min(range(len(holes)), key=lambda index: distances[index].min())
        at, start = np.unravel_index(distances[nearest].argmin(), distances[nearest].shape)
        hole = np.roll(holes.pop(nearest), -start, axis=0)
        rim = np.concatenate([rim[: at + 1], hole, hole[:1], rim[at:]])
    return rim


def _corners(line: np.ndarray) -> np.ndarray:
    """The closed line without the points in the middle of straight runs."""
    before, after = line - np.roll(line, 1, axis=0), np.roll(line, -1, axis=0) - line
    corners = line[(before != after).any(1)]
    return corners if len(corners) else line[:1]
