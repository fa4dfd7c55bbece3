"""The pictures that go over the frame."""

import numpy as np
import pytest

from carts_viewer.picture import layers


@pytest.fixture
def arm_ids() -> np.ndarray:
    """Two arms, the second over a corner of the first."""
    ids = np.full((48, 64), -1)
    ids[10:30, 10:40] = 0
    ids[20:40, 30:60] = 1
    return ids


def test_the_mask_covers_exactly_the_arms_in_their_colours(arm_ids: np.ndarray) -> None:
    picture = layers.mask(arm_ids, 0.5)
    assert np.array_equal(picture[..., 3] > 0, arm_ids >= 0)
    assert tuple(picture[12, 12]) == (*layers.ARM_COLORS[0], 128)
    assert tuple(picture[25, 35]) == (*layers.ARM_COLORS[1], 128)


def test_the_contour_runs_along_the_arms_and_leaves_their_inside_open(arm_ids: np.ndarray) -> None:
    picture = layers.contour(arm_ids, 1.0)
    assert picture[10, 20, 3] == 255 and picture[20, 10, 3] == 255
    assert picture[15, 20, 3] == 0 and picture[2, 2, 3] == 0
    assert tuple(picture[39, 45, :3]) == layers.ARM_COLORS[1]


def test_the_comparison_uses_the_papers_colours() -> None:
    predicted = np.array([[True, True, False, False]])
    truth = np.array([[True, False, True, False]])
    picture = layers.against_truth(predicted, truth, 0.6)
    names = ("true positive", "false positive", "false negative", "true negative")
    assert [tuple(pixel[:3]) for pixel in picture[0]] == [layers.TRUTH_COLORS[name] for name in names]
    assert set(picture[..., 3].ravel()) == {153}


def test_the_shaded_arm_shows_the_rendering_where_the_arm_is(arm_ids: np.ndarray) -> None:
    image = np.full((3, 48, 64), 2.0, np.float32)
    image[:, 12, 12] = (0.0, 0.5, 1.0)
    picture = layers.shaded(image, arm_ids, 1.0)
    assert tuple(picture[12, 12]) == (0, 128, 255, 255)
    assert tuple(picture[25, 35]) == (255, 255, 255, 255)
    assert tuple(picture[2, 2]) == (0, 0, 0, 0)


def test_a_map_of_a_lower_resolution_fills_the_picture_from_dark_to_bright() -> None:
    values = np.tile(np.linspace(0, 1, 16, dtype=np.float32), (12, 1))
    picture = layers.heat(values, 0.0, 1.0, (48, 64), 0.5)
    assert picture.shape == (48, 64, 4)
    brightness = picture[24, :, :3].astype(int).sum(-1)
    assert brightness[2] < brightness[32] < brightness[61]
    assert set(picture[..., 3].ravel()) == {128}


def test_values_that_are_not_numbers_do_not_break_a_map() -> None:
    values = np.full((4, 4), np.nan, np.float32)
    assert layers.heat(values, 0.0, 1.0, (8, 8), 1.0).shape == (8, 8, 4)


def test_no_arm_in_view_gives_an_empty_picture() -> None:
    empty = np.full((8, 8), -1)
    assert not layers.mask(empty, 1.0)[..., 3].any()
    assert not layers.contour(empty, 1.0)[..., 3].any()
