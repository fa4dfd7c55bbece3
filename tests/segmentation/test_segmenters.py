"""Masks of what a person points at, by the segmenter that ships."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from carts_core.errors import SettingsError
from carts_core.evaluation.evaluate import dice
from carts_core.networks import FeatureExtractor
from carts_core.recording import Sequence
from carts_core.segmentation import NetworkSegmenter, Prompt, Segmenter

HEIGHT, WIDTH = 120, 160
LEFT, RIGHT = (slice(30, 90), slice(20, 60)), (slice(20, 100), slice(100, 140))


def _two_bars() -> np.ndarray:
    """Two grey bars on red, with some noise."""
    image = np.full((HEIGHT, WIDTH, 3), (150, 50, 40), np.uint8)
    image[LEFT] = image[RIGHT] = (130, 140, 145)
    noise = np.random.default_rng(0).integers(-6, 7, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def _mask(*parts: tuple[slice, slice]) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    for part in parts:
        mask[part] = True
    return mask


def _roughly(*parts: tuple[slice, slice]) -> Segmenter:
    """As if a network saw these parts, a pixel too small all round."""
    seen = cv2.erode(_mask(*parts).astype(np.uint8), np.ones((3, 3), np.uint8))
    return NetworkSegmenter(lambda image: seen.astype(np.float32))


def test_a_click_gives_the_whole_thing_along_its_edges_and_nothing_else() -> None:
    found = _roughly(LEFT, RIGHT).segment(_two_bars(), Prompt(inside=((40.5, 60.5),)))
    assert dice(found, _mask(LEFT)) > 0.99 and not (found & _mask(RIGHT)).any()


def test_two_clicks_give_both_things_and_a_point_beside_takes_one_away_again() -> None:
    segmenter, image = _roughly(LEFT, RIGHT), _two_bars()
    both = ((40.5, 60.5), (120.5, 60.5))
    assert dice(segmenter.segment(image, Prompt(inside=both)), _mask(LEFT, RIGHT)) > 0.99
    one = segmenter.segment(image, Prompt(inside=both[:1], outside=both[1:]))
    assert dice(one, _mask(LEFT)) > 0.99 and not (one & _mask(RIGHT)).any()


def test_a_box_gives_what_is_in_it() -> None:
    found = _roughly(LEFT, RIGHT).segment(_two_bars(), Prompt(box=(95.0, 15.0, 145.0, 105.0)))
    assert dice(found, _mask(RIGHT)) > 0.99


@pytest.mark.parametrize("prompt", [Prompt(inside=((40.5, 60.5),)), Prompt(box=(12.0, 22.0, 68.0, 98.0))])
def test_where_the_network_sees_nothing_colour_and_edges_decide(prompt: Prompt) -> None:
    found = _roughly().segment(_two_bars(), prompt)
    assert dice(found, _mask(LEFT)) > 0.97


def test_the_network_is_asked_once_for_an_image() -> None:
    asked: list[np.ndarray] = []

    def probability(image: np.ndarray) -> np.ndarray:
        asked.append(image)
        return _mask(LEFT).astype(np.float32)

    segmenter, image = NetworkSegmenter(probability), _two_bars()
    for u in (30.5, 40.5, 50.5):
        segmenter.segment(image, Prompt(inside=((u, 60.5),)))
    assert len(asked) == 1
    segmenter.segment(_two_bars(), Prompt(inside=((40.5, 60.5),)))
    assert len(asked) == 2


def test_a_click_on_each_instrument_of_the_shipped_recording_gives_its_mask(sample_sequence_path: Path) -> None:
    sequence = Sequence.open(sample_sequence_path)
    camera = sequence.scene.cameras[0].name
    frame = sequence.frame(0, "regular", [camera])
    assert frame.masks is not None
    image, truth = frame.images[camera], frame.masks[camera]
    count, labels, stats, _ = cv2.connectedComponentsWithStats(truth.astype(np.uint8))
    things = [labels == number for number in range(1, count) if stats[number, cv2.CC_STAT_AREA] > 3000]
    assert len(things) == 2
    segmenter = NetworkSegmenter.of(FeatureExtractor.load())
    for thing in things:
        depth = cv2.distanceTransform(thing.astype(np.uint8), cv2.DIST_L2, 5)
        row, column = np.unravel_index(int(depth.argmax()), depth.shape)
        found = segmenter.segment(image, Prompt(inside=((float(column) + 0.5, float(row) + 0.5),)))
        assert dice(found, thing) > 0.88


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (Prompt, "needs a point"),
        (lambda: Prompt(outside=((1.0, 2.0),)), "needs a point"),
        (lambda: Prompt(inside=((1.0, float("nan")),)), "not finite"),
        (lambda: Prompt(box=(5.0, 5.0, 5.0, 9.0)), "is empty"),
        (lambda: Prompt(inside=((1.0, 1.0),) * 101), "at most 100"),
    ],
)
def test_a_prompt_that_says_nothing_is_refused(make: Callable[[], Prompt], reason: str) -> None:
    with pytest.raises(SettingsError, match=reason):
        make()
