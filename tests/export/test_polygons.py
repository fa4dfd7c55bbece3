"""Polygons that give back the very pixels."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from carts_core.export.encodings import MIN_POINTS, polygons, row_runs


def _filled(mask: np.ndarray) -> np.ndarray:
    filled = np.zeros(mask.shape, np.uint8)
    for polygon in polygons(mask):
        cv2.fillPoly(filled, [polygon.astype(np.int32)], 1)
    return filled.astype(bool)


def _blobs(seed: int) -> np.ndarray:
    """Random islands with holes, and islands in the holes."""
    noise = gaussian_filter(np.random.default_rng(seed).standard_normal((90, 120)), 3.0)
    return np.abs(noise) > 0.6 * noise.std()


@pytest.mark.parametrize("seed", range(20))
def test_filling_gives_the_mask_back_within_a_pixel(seed: int) -> None:
    mask = _blobs(seed)
    wrong = _filled(mask) != mask
    # Along a slanted slit a pixel of a hole's rim may be hit; nothing is further than a pixel off.
    near = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert not (wrong & ~near).any() and not (wrong & mask).any()
    assert wrong.mean() < 1e-3


def test_every_part_is_one_polygon() -> None:
    mask = _blobs(1)
    assert len(polygons(mask)) == cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)[0] - 1


@pytest.mark.parametrize(
    "mask",
    [
        np.ones((1, 1), bool),
        np.ones((1, 5), bool),
        np.eye(4, dtype=bool),
        np.pad(np.ones((7, 9), bool), 2),
        np.pad(np.pad(np.zeros((3, 3), bool), 1, constant_values=True), 1),
        np.pad(np.pad(np.zeros((3, 6), bool), 4, constant_values=True), 1),
    ],
    ids=["pixel", "line", "diagonal", "rectangle", "thin ring", "thick ring"],
)
def test_simple_shapes_come_back_exactly(mask: np.ndarray) -> None:
    assert all(len(polygon) >= MIN_POINTS for polygon in polygons(mask))
    np.testing.assert_array_equal(_filled(mask), mask)


def test_straight_edges_need_corners_only() -> None:
    (rectangle,) = polygons(np.pad(np.ones((30, 40), bool), 3))
    assert len(rectangle) == 4


def test_an_empty_mask_has_no_polygon() -> None:
    assert polygons(np.zeros((4, 4), bool)) == []


@pytest.mark.parametrize("seed", range(3))
def test_row_runs_alternate_from_outside(seed: int) -> None:
    mask = _blobs(seed)
    runs = row_runs(mask)
    inside = np.arange(len(runs)) % 2 == 1
    np.testing.assert_array_equal(np.repeat(inside, runs).reshape(mask.shape), mask)
    assert row_runs(np.ones((2, 2), bool)) == [0, 4]
