"""Altered frames of the benchmark: occluders, other domains and other rooms."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from carts_core.lab.benchmark.conditions import SHARE, crossing_frame, occlude
from carts_core.lab.benchmark.counterfactual import Counterfactual
from carts_core.lab.benchmark.rooms import AnotherRoom, Room, synthetic_rooms
from carts_core.lab.synthesis import DOMAINS
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence


@pytest.fixture
def picture(tiny_sequence: Callable[..., Path]) -> tuple[np.ndarray, np.ndarray]:
    frame = Sequence.open(tiny_sequence(frames=1, width=320, height=240)).frame(0)
    assert frame.masks is not None
    return frame.images["left"], frame.masks["left"]


@pytest.mark.parametrize("seed", range(2))
def test_occluders_cover_the_wanted_share_of_the_instruments_and_look_unlike_them(picture, seed: int) -> None:
    image, mask = picture
    found = occlude(image, mask, np.random.default_rng(seed))
    assert (found.hidden & mask).sum() / mask.sum() == pytest.approx(SHARE, abs=0.005)
    assert found.hidden.mean() < 0.6
    change = np.abs(found.image.astype(float) - image).mean(-1)
    assert np.median(change[found.hidden]) > 10.0


def test_one_arm_hides_a_part_of_the_other_which_stays_in_view() -> None:
    recording = Sequence.open(sample_sequence())
    frame, original = crossing_frame(recording, 3, "left"), recording.frame(3, "regular", ["left"])
    scene = recording.scene.with_cameras(["left"])
    assert frame.masks is not None and frame.truth is not None and original.truth is not None
    labels = Renderer(scene).segment(scene.state(frame.truth))[0]
    assert np.array_equal(labels >= 0, frame.masks["left"])
    shares = []
    for number, arm in enumerate(scene.arms):
        alone = scene.with_arms([arm.name])
        whole = Renderer(alone).segment(alone.state({arm.name: frame.truth[arm.name]}))[0] >= 0
        shares.append((labels == number).sum() / whole.sum())
        error = frame.measured[arm.name] - frame.truth[arm.name]
        assert np.allclose(error, original.measured[arm.name] - original.truth[arm.name])
    assert 0.08 < min(shares) < 0.87
    again = crossing_frame(recording, 3, "left")
    assert np.array_equal(frame.images["left"], again.images["left"])
    assert not np.array_equal(frame.images["left"], original.images["left"])


SIZE = {"width": 160, "height": 120}


@pytest.fixture
def counterfactual(sequence: Sequence) -> Counterfactual:
    other = np.full((SIZE["height"], SIZE["width"], 3), (40, 160, 90), np.uint8)
    return Counterfactual(sequence, "left", other, seed=1)


def _image(recording: Counterfactual | Sequence, index: int, domain: str | None = None) -> np.ndarray:
    return recording.frame(index, domain, ["left"]).images["left"].astype(float)


def test_domains_alter_images_and_nothing_else(sequence: Sequence, counterfactual: Counterfactual) -> None:
    plain = sequence.frame(1, cameras=["left"])
    for domain in DOMAINS[1:]:
        frame = counterfactual.frame(1, domain)
        assert frame.domain == domain
        assert frame.masks is not None and plain.masks is not None
        assert np.array_equal(frame.masks["left"], plain.masks["left"])
        assert np.array_equal(frame.measured["PSM1"], plain.measured["PSM1"])
        assert np.abs(frame.images["left"].astype(float) - plain.images["left"]).mean() > 4.0, domain
        change = counterfactual.background("left", domain).astype(float) - sequence.background("left")
        assert np.abs(change).mean() > 4.0, domain
        assert np.array_equal(_image(counterfactual, 1, domain), _image(counterfactual, 1, domain)), domain


def test_another_background_leaves_the_instrument(sequence: Sequence, counterfactual: Counterfactual) -> None:
    masks = sequence.frame(0).masks
    assert masks is not None
    mask, seam = masks["left"].astype(np.uint8), np.ones((9, 9), np.uint8)
    inside, outside = cv2.erode(mask, seam).astype(bool), ~cv2.dilate(mask, seam).astype(bool)
    image = _image(counterfactual, 0, "background_change")
    assert inside.any() and np.abs(image - _image(sequence, 0))[inside].max() <= 1
    assert outside.any() and np.abs(image - (40, 160, 90))[outside].max() <= 1


GREEN = Room("green", "tuning", lambda width, height: np.full((height, width, 3), (40, 160, 90), np.uint8))


def test_no_kind_of_room_serves_tuning_and_is_held_out() -> None:
    kinds = {
        half: {room.name.split()[0] for room in synthetic_rooms() if room.half == half}
        for half in ("tuning", "held-out")
    }
    assert kinds["tuning"] and kinds["held-out"] and not kinds["tuning"] & kinds["held-out"]


def test_the_instrument_is_put_into_the_room_and_nothing_else_is_left_of_the_old_one(sequence: Sequence) -> None:
    recording = AnotherRoom(sequence, [GREEN], seed=1)
    before, frame = sequence.frame(1, cameras=["left"]), recording.frame(1, GREEN.domain, ["left"])
    assert before.masks is not None and frame.masks is not None
    mask, seam = before.masks["left"], np.ones((9, 9), np.uint8)
    assert np.array_equal(frame.masks["left"], mask)
    inside, outside = cv2.erode(mask.astype(np.uint8), seam) > 0, cv2.dilate(mask.astype(np.uint8), seam) == 0
    old, new = before.images["left"].astype(float), frame.images["left"].astype(float)
    assert np.abs(new[outside] - (40, 160, 90)).mean() < 8
    assert np.corrcoef(new[inside].ravel(), old[inside].ravel())[0, 1] > 0.9
    assert np.abs(recording.background("left", GREEN.domain).astype(float) - (40, 160, 90)).mean() < 6
