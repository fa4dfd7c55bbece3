"""Arms that cross: one hides a part of the other, and image, mask and joints belong together."""

import numpy as np
import pytest

from carts_core.errors import SettingsError
from carts_core.lab.benchmark.conditions import crossed
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence


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


def test_a_recording_of_one_arm_has_none(tiny_sequence) -> None:
    with pytest.raises(SettingsError, match="two arms"):
        crossed(Sequence.open(tiny_sequence(frames=2)), 0, "left")
