"""A camera that moves, with a predictor that is never wrong."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from moving import let_camera_move, swing
from perfect_predictor import NumberedTruths, PerfectPredictor, numbered

from carts_core.errors import SettingsError
from carts_core.evaluation.metrics import dice
from carts_core.model.scene import SceneState
from carts_core.optimization import CalibrationOptimizer, FrameOptimizer, FreeParameters, SequenceOptimizer
from carts_core.optimization.calibration import with_fixed_gauge
from carts_core.optimization.hand_eye import ImagePoint, mounts_of_points, moved_cameras
from carts_core.recording import Frame, Sequence
from carts_core.rendering import Renderer
from carts_core.settings import CALIBRATION_SETTINGS
from carts_core.settings.stages import Descend, Observe

FRAMES = 4
# Colours stay as they are, because they number the frames.
STAGES = (Observe(margin=27, attention=27), Descend(6.0), Descend(2.0), Descend(0.8))
BY_COLOUR = replace(CALIBRATION_SETTINGS, frame_prior_deg=10.0, stages=STAGES, dehaze=0.0)


class Truths(PerfectPredictor):
    """Predicts the truth of the frame that was read last."""

    def __init__(self, sequence: Sequence) -> None:
        self._sequence = sequence
        frames = [sequence.frame(index) for index in range(len(sequence))]
        self.all = [PerfectPredictor(sequence, true_state(sequence, frame)).maps for frame in frames]
        self.maps = self.all[0]

    def load(self, index: int) -> Frame:
        self.maps = self.all[index]
        return self._sequence.frame(index)


def true_state(sequence: Sequence, frame: Frame) -> SceneState:
    return sequence.scene.state(frame.truth or {}, mounts=frame.mounts)


def overlap(sequence: Sequence, frame: Frame, state: SceneState) -> float:
    assert frame.masks is not None
    return dice(Renderer(sequence.scene).segment(state)[0] >= 0, frame.masks["left"])


@pytest.fixture
def moving(tiny_sequence: Callable[..., Path]) -> Sequence:
    path = tiny_sequence(frames=FRAMES, width=320, height=240)
    return Sequence.open(let_camera_move(path, swing(FRAMES, 3.0, 0.002)))


def without_motion(sequence: Sequence) -> Sequence:
    path = sequence.path.with_name("without.toml")
    path.write_text(sequence.path.read_text().replace('motion = "ecm.csv"', ""))
    return Sequence.open(path)


def test_the_truth_covers_its_masks_only_with_the_motion(moving: Sequence) -> None:
    still = without_motion(moving)
    for index in (1, 3):
        frame = moving.frame(index)
        assert overlap(moving, frame, true_state(moving, frame)) > 0.99
        assert overlap(still, frame, true_state(still, still.frame(index))) < 0.9


def test_a_frame_of_a_moving_camera_is_corrected_as_one_of_a_fixed_one(moving: Sequence) -> None:
    truths = Truths(moving)
    frame = truths.load(1)
    optimizer = FrameOptimizer(moving.scene, frame, {}, truths)
    list(optimizer)
    assert optimizer.best is not None
    assert overlap(moving, frame, optimizer.best.state) > 0.985
    assert np.allclose(optimizer.best.state.T_mount_world[0].numpy(), frame.mounts["left"], atol=1e-6)


def test_frames_of_a_moving_camera_are_corrected_together(moving: Sequence) -> None:
    truths = Truths(moving)
    optimizer = SequenceOptimizer(moving.scene, truths.load, {index: index / 10 for index in range(FRAMES)}, truths)
    list(optimizer)
    for index, estimate in optimizer.estimates.items():
        assert overlap(moving, moving.frame(index), estimate.state) > 0.985


def test_a_camera_that_moves_is_calibrated_on_its_mount(moving: Sequence) -> None:
    """The hand-eye transform of the endoscope comes back."""
    frames = [numbered(moving.frame(index)) for index in range(FRAMES)]
    predictor = NumberedTruths(moving.scene, frames)
    (camera,) = moving.scene.cameras
    T = np.eye(4)
    T[:3, 3] = 0.002, -0.001, 0.0015
    wrong = replace(moving.scene, cameras=(replace(camera, T_camera_world=T @ camera.T_camera_world),))
    optimizer = CalibrationOptimizer(
        wrong, frames, predictor, free=FreeParameters(joints=False, extrinsics=True), settings=BY_COLOUR
    )
    list(optimizer)
    found = optimizer.result().scene.cameras[0].T_camera_world
    assert np.linalg.norm(found[:3, 3] - camera.T_camera_world[:3, 3]) < 0.0005
    both = FreeParameters(joints=False, base_frames=True, extrinsics=True)
    assert CalibrationOptimizer(wrong, frames, predictor, free=both).free == both
    assert with_fixed_gauge(wrong, both).locked_cameras == ("left",)


def test_points_clicked_while_the_camera_moves_are_refused_and_others_are_used_where_it_was(moving: Sequence) -> None:
    points = [ImagePoint(frame, "left", "PSM1", "tip", (10.0, 10.0)) for frame in (1, 1)]
    mounts = mounts_of_points(moving, points)
    there = moved_cameras(moving.scene, mounts)
    assert np.allclose(there.cameras[0].T_camera_world, moving.scene.cameras[0].T_camera_world @ mounts["left"])
    back = moved_cameras(there, mounts, back=True)
    assert np.allclose(back.cameras[0].T_camera_world, moving.scene.cameras[0].T_camera_world)
    with pytest.raises(SettingsError, match=r"moves between frames '002' and '004'.*stationary camera"):
        mounts_of_points(moving, [*points, replace(points[0], frame=3)])
