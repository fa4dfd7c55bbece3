"""The tracker follows an arm, says when it has lost it, and finds it again."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from carts_core.evaluation import dice
from carts_core.imaging.window import Window
from carts_core.live import Effort, LiveTracker, LiveVerdict
from carts_core.model.scene import SceneState
from carts_core.optimization import ImagePredictor
from carts_core.recording import Frame, Sequence
from carts_core.rendering import Renderer

SECONDS = 0.1
ERROR = 0.01
"""Of the tiny sequence's measured joints [rad]."""


class Seeing(ImagePredictor):
    """Sees the arm where it is; nothing while something hides it."""

    device = torch.device("cpu")
    stride = 16

    def __init__(self, sequence: Sequence) -> None:
        self._renderer = Renderer(sequence.scene, width=640, height=512)
        self.hidden, self.maps = False, torch.empty(0)

    def look(self, truth: SceneState) -> None:
        """The arm has moved."""
        self.maps = self._renderer.surface(truth).maps

    def predict(self, images: torch.Tensor, given: torch.Tensor, window: Window) -> torch.Tensor:
        """The truth in a window."""
        whole = torch.nn.functional.interpolate(self.maps, images.shape[-2:], mode="area")
        return torch.zeros_like(window.of(whole)) if self.hidden else window.of(whole).clone()


class Stream:
    """An arm that sways, at so many frames a second, and a tracker that follows it."""

    def __init__(self, path: Path) -> None:
        self.sequence = Sequence.open(path)
        self.predictor = Seeing(self.sequence)
        self.renderer = Renderer(self.sequence.scene, width=640, height=512)
        self.camera = Renderer(self.sequence.scene)
        self.tracker = LiveTracker(self.sequence.scene, self.predictor)
        self.count, self.slip = 0, 0.0

    def picture(self) -> np.ndarray:
        """What the camera sees, before a grey wall."""
        wall = np.full((128, 160, 3), 140, np.uint8)
        if self.predictor.hidden:
            return wall
        with torch.no_grad():
            rendering = self.camera(self.truth)
        cover = rendering.silhouette[0].numpy()[..., None]
        image = 255.0 * rendering.image[0].permute(1, 2, 0).numpy() + (1.0 - cover) * wall
        return np.rint(image.clip(0, 255)).astype(np.uint8)

    def overlap(self) -> float:
        """Dice of the last estimate and the truth."""
        return dice(*(self.renderer.segment(state)[0] >= 0 for state in (self.estimate.state, self.truth)))

    def next(self, seconds: float = SECONDS) -> tuple[LiveVerdict, Effort, float]:
        """Track the next frame: verdict, effort, and the largest error of yaw and pitch [deg]."""
        self.count += 1
        frame = self.sequence.frame(self.count % 2)
        assert frame.truth is not None
        truth = {name: values.copy() for name, values in frame.truth.items()}
        truth["PSM1"][:2] += self.slip
        self.truth = self.sequence.scene.state(truth)
        self.predictor.look(self.truth)
        self.time = getattr(self, "time", 0.0) + seconds
        measured = {name: values.copy() for name, values in frame.measured.items()}
        images = {"left": self.picture()}
        found = self.tracker.track(replace(frame, images=images, measured=measured, timestamp=self.time))
        self.estimate = found
        error = np.abs(found.joint_positions["PSM1"] - truth["PSM1"])[[0, 1]].max()
        return found.verdict, found.effort, float(np.rad2deg(error))


@pytest.fixture
def stream(tiny_sequence: Callable[..., Path]) -> Stream:
    return Stream(tiny_sequence(frames=2, width=160, height=128))


def test_the_first_frame_is_searched_and_later_ones_take_little(stream: Stream) -> None:
    found = [stream.next() for _ in range(6)]
    assert [verdict for verdict, _, _ in found] == [LiveVerdict.GOOD] * 6
    assert [effort for _, effort, _ in found] == [Effort.SEARCH] + [Effort.SMALL] * 5
    assert max(error for _, _, error in found) < 0.4 < np.rad2deg(ERROR)
    std = stream.estimate.joint_std["PSM1"]
    assert np.isfinite(std).all() and (std[:2] < np.deg2rad(2.0)).all(), "less than before any image"


def test_a_hidden_arm_is_lost_and_found_again_where_it_was(stream: Stream) -> None:
    for _ in range(3):
        stream.next()
    stream.predictor.hidden = True
    hidden = [stream.next() for _ in range(8)]
    assert hidden[0][0] is LiveVerdict.DOUBTFUL and hidden[-1][0] is LiveVerdict.LOST
    assert all(verdict is not LiveVerdict.GOOD for verdict, _, _ in hidden)
    assert max(error for _, _, error in hidden) < 0.5, "what was known of the error still holds"
    stream.predictor.hidden = False
    verdict, effort, error = stream.next()
    assert verdict is LiveVerdict.GOOD and effort is Effort.SMALL and error < 0.3


def test_after_an_error_that_jumps_the_arm_is_found_within_a_second(stream: Stream) -> None:
    for _ in range(3):
        stream.next()
    stream.predictor.hidden = True
    for _ in range(8):
        stream.next()
    stream.predictor.hidden, stream.slip = False, float(np.deg2rad(4.0))
    found = [stream.next() for _ in range(10)]
    assert found[-1][0] is LiveVerdict.GOOD and stream.overlap() > 0.97
    assert any(effort is Effort.SEARCH for _, effort, _ in found)


def test_a_camera_that_moves_is_followed(stream: Stream) -> None:
    stream.next()
    T = np.array(stream.sequence.scene.cameras[0].T_camera_world)
    turn = np.deg2rad(2.0)
    T_moved = np.array(
        [[np.cos(turn), -np.sin(turn), 0, 0], [np.sin(turn), np.cos(turn), 0, 0], [0, 0, 1, 0.0], [0] * 4]
    )
    T_moved[3, 3] = 1.0
    frame = stream.sequence.frame(0)
    assert frame.truth is not None
    state = stream.sequence.scene.state(frame.truth)
    stream.predictor.look(replace(state, T_camera_world=torch.tensor((T_moved @ T)[None], dtype=torch.float32)))
    found = stream.tracker.track(replace(frame, timestamp=0.2), {"left": T_moved @ T})
    assert found.verdict is LiveVerdict.GOOD
    assert np.rad2deg(np.abs(found.joint_positions["PSM1"] - frame.truth["PSM1"])[:2].max()) < 0.3
    np.testing.assert_allclose(found.state.T_view_world[0].numpy(), T_moved @ T, atol=1e-6)


def test_before_anything_is_seen_the_verdict_is_lost_and_values_are_as_measured(stream: Stream) -> None:
    stream.predictor.hidden = True
    verdict, effort, _ = stream.next()
    frame: Frame = stream.sequence.frame(stream.count % 2)
    assert verdict is LiveVerdict.LOST and effort is Effort.SEARCH
    np.testing.assert_allclose(stream.estimate.joint_positions["PSM1"], frame.measured["PSM1"], atol=1e-6)
