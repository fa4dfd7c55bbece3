"""Where an arm may be before a camera, from points alone and without any initial guess."""

from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Bool, Float

from ...model.camera import HALF_PIXEL
from .points import View

FEWEST_POINTS = 4
"""With three, up to four poses fit equally well."""
_RANDOM_SUBSETS = 40
_KEPT = 4
"""How many of the best poses are refined."""


def poses_of(
    view: View, intrinsics: Float[np.ndarray, "4"], pixel_error: float
) -> list[tuple[float, Float[np.ndarray, "4 4"]]]:
    """The best few poses T_camera_base with their costs, the best first.

    Perspective-n-point (SQPnP, EPnP) on all points, on all but each frame's and each single one, and on random few, so
    that some subset is free of wrong points; each pose is judged by all points, wrong ones with little weight.

    Args:
        view: at least `FEWEST_POINTS` points.
        intrinsics: fx, fy, cx, cy [px].
        pixel_error: expected error of a point [px].
    """
    found: list[tuple[float, np.ndarray]] = []
    for rows in _subsets(view):
        for T in _perspective(view, rows, intrinsics):
            if (T[2, :3] @ view.starts[view.is_point].T + T[2, 3] > 0).all():
                found.append((robust_cost(view.distances(T, intrinsics) / pixel_error), T))
    found.sort(key=lambda entry: entry[0])
    return found[:_KEPT]


def robust_cost(scaled: Float[np.ndarray, "points 2"]) -> float:
    """Sum of Cauchy's loss of the distances, in expected errors."""
    return float(np.log1p((scaled**2).sum(-1) / 4.0).sum())


def _subsets(view: View) -> Iterator[Bool[np.ndarray, " points"]]:
    """Points to be used together: all, all but a few, and random few."""
    points = view.is_point
    yield points
    frames = np.array(view.frames)
    for frame in dict.fromkeys(view.frames):
        yield points & (frames != frame)
    for row in np.flatnonzero(points):
        yield points & (np.arange(len(points)) != row)
    random = np.random.default_rng(0)
    count = int(points.sum())
    for _ in range(_RANDOM_SUBSETS if count > FEWEST_POINTS else 0):
        chosen = np.zeros(len(points), bool)
        chosen[random.choice(np.flatnonzero(points), min(count, FEWEST_POINTS + 1), replace=False)] = True
        yield chosen


def _perspective(view: View, rows: np.ndarray, intrinsics: np.ndarray) -> Iterator[np.ndarray]:
    if rows.sum() < FEWEST_POINTS:
        return
    fx, fy, cx, cy = intrinsics
    K = np.array([[fx, 0.0, cx - HALF_PIXEL], [0.0, fy, cy - HALF_PIXEL], [0.0, 0.0, 1.0]])
    pixels = view.pixels[rows] - HALF_PIXEL
    for method in (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_EPNP):
        try:
            _, rotations, translations, _ = cv2.solvePnPGeneric(
                np.ascontiguousarray(view.starts[rows]), pixels, K, None, flags=method
            )
        except cv2.error:
            # Points that coincide or lie on a line have no pose.
            continue
        for rotation, translation in zip(rotations, translations, strict=True):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
            if np.isfinite(T).all():
                yield T
