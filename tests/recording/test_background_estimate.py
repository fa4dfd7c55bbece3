"""The estimated background: the scene behind a moving object, and interpolation where it never moves away."""

import numpy as np
import pytest

from carts_core.errors import SequenceError
from carts_core.recording import Sequence
from carts_core.recording.background import background_of_recording, fill, filled_in, uncovered_median
from carts_core.resources import sample_sequence

RNG = np.random.default_rng(5)
SCENE = RNG.integers(30, 220, (60, 80, 3)).astype(np.uint8)


def estimated(views: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    return filled_in(uncovered_median(views)[0], np.all([cover for _, cover in views], axis=0))


def views(columns: list[int], width: int = 10):
    """The scene with a black bar at each of these columns, and the bar as cover."""
    for column in columns:
        image, cover = SCENE.copy(), np.zeros((60, 80), bool)
        image[:, column : column + width] = 0
        cover[:, column : column + width] = True
        yield image, cover


def test_what_is_uncovered_in_some_view_is_found_exactly():
    assert np.array_equal(estimated([*views([0, 5, 70])]), SCENE)


def test_the_median_leaves_out_an_uncovered_outlier():
    given = [(SCENE, np.zeros((60, 80), bool))] * 4 + [(255 - SCENE, np.zeros((60, 80), bool))]
    assert np.array_equal(estimated(given), SCENE)


def test_what_is_never_uncovered_is_filled_in_smoothly():
    x = np.linspace(40, 200, 80)
    ramp = np.tile(np.rint(x).astype(np.uint8)[None, :, None], (60, 1, 3))
    hole = np.zeros((60, 80), bool)
    hole[20:40, 30:50] = True
    filled = fill(np.where(hole[..., None], 0, ramp).astype(np.uint8), hole)
    assert np.array_equal(filled[~hole], ramp[~hole])
    assert np.abs(filled[hole].astype(int) - ramp[hole]).max() < 25


def test_an_arm_that_shows_beside_what_is_always_covered_leaves_no_line():
    grey, cover = np.full((60, 80, 3), 120, np.uint8), np.zeros((60, 80), bool)
    grey[:, 28:41] = 0
    cover[:, 30:40] = True
    # The bar is wider than its cover by 2 and 1 columns: the margin of an image 80 wide is 2.
    assert (estimated([(grey, cover)] * 3) == 120).all()


def test_a_scene_that_is_always_covered_is_refused():
    with pytest.raises(SequenceError, match=r"cover every pixel of every frame. Check T_camera_world"):
        estimated([(SCENE, np.ones((60, 80), bool))])


def test_where_arms_are_near_it_is_known_only_if_views_agree():
    sequence = Sequence.open(sample_sequence())
    camera = sequence.scene.cameras[0]
    frames = range(len(sequence))
    states = [sequence.scene.state({arm: rows[index] for arm, rows in sequence.measured.items()}) for index in frames]
    shades = np.random.default_rng(0).integers(50, 130, len(states))

    def view(place: int) -> np.ndarray:
        image = np.full((camera.height, camera.width, 3), 90, np.uint8)
        image[:, 400:] = shades[place]
        return image

    known = background_of_recording(sequence.scene, camera.name, states, view).known
    assert known[:, :400].mean() > 0.99 and known[:, 400:].mean() < 0.9
