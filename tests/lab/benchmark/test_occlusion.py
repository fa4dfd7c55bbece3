"""Occluders: how much they cover, where, and that they are the same each time."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from carts_core.lab.benchmark.conditions import SHARE, occlude
from carts_core.recording import Sequence


@pytest.fixture
def picture(tiny_sequence: Callable[..., Path]) -> tuple[np.ndarray, np.ndarray]:
    frame = Sequence.open(tiny_sequence(frames=1, width=320, height=240)).frame(0)
    assert frame.masks is not None
    return frame.images["left"], frame.masks["left"]


@pytest.mark.parametrize("seed", range(4))
def test_occluders_cover_the_wanted_share_of_the_instruments_and_look_unlike_them(picture, seed: int) -> None:
    image, mask = picture
    found = occlude(image, mask, np.random.default_rng(seed))
    assert (found.hidden & mask).sum() / mask.sum() == pytest.approx(SHARE, abs=0.005)
    assert found.hidden.mean() < 0.6
    change = np.abs(found.image.astype(float) - image).mean(-1)
    assert np.median(change[found.hidden]) > 10.0


def test_far_from_occluders_the_picture_is_what_it_was(picture) -> None:
    image, _ = picture
    corner = np.zeros(image.shape[:2], bool)
    corner[:30, :30] = True
    found = occlude(image, corner, np.random.default_rng(1))
    assert found.hidden[:30, :30].any()
    assert np.array_equal(found.image[-60:, -60:], image[-60:, -60:])


def test_the_same_seed_gives_the_same_occluders_and_another_one_others(picture) -> None:
    image, mask = picture
    first, again, other = (occlude(image, mask, np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert np.array_equal(first.image, again.image) and np.array_equal(first.hidden, again.hidden)
    assert not np.array_equal(first.hidden, other.hidden)


def test_a_picture_without_instruments_stays_as_it_is(picture) -> None:
    image, mask = picture
    found = occlude(image, np.zeros_like(mask), np.random.default_rng(0))
    assert np.array_equal(found.image, image) and not found.hidden.any()
