"""Altered frames of the benchmark."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from carts_core.lab.benchmark.conditions import SHARE, crossed, occlude
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
    frame, original = crossed(recording, 3, "left"), recording.frame(3, "regular", ["left"])
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
    again = crossed(recording, 3, "left")
    assert np.array_equal(frame.images["left"], again.images["left"])
    assert not np.array_equal(frame.images["left"], original.images["left"])
