"""Recordings with a moving camera, or with separate clocks of images and kinematics."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from clicked_points import clicked
from moving import Motion, let_camera_move, swing
from viewer_desk import Desk

from carts_core.errors import CartsError
from carts_core.evaluation.metrics import dice
from carts_core.optimization import StopReason
from carts_core.optimization.hand_eye import moved_cameras
from carts_core.project import CorrectedTransform, Key, Project, Provenance, Source, TimeOffset
from carts_core.recording import Sequence
from carts_viewer.actions import intents
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.jobs.solver import Calibrated, Calibration, scene_at
from carts_viewer.wizard.calibration import report_of
from carts_viewer.wizard.points import Clicking

FRAMES = 4


@pytest.fixture
def moving(tiny_sequence: Callable[..., Path], untrained_weights: Path) -> Desk:
    path = let_camera_move(tiny_sequence(frames=FRAMES, width=160, height=120), swing(FRAMES, 3.0, 0.002))
    sequence = Sequence.open(path)
    return Desk(sequence, Project.open(sequence), OptimizerFactory(weights=(untrained_weights,), report=lambda _: None))


def overlap(desk: Desk) -> float:
    """Of the overlay at the true joints with the mask of the frame."""
    frame = desk.state.frame
    assert frame.truth is not None and frame.masks is not None
    pose = desk.session.with_joints(desk.state.pose.scene, frame.truth)
    return dice(desk.renderer.mask(pose, "left"), frame.masks["left"])


def test_the_overlay_follows_the_camera_from_frame_to_frame(moving: Desk) -> None:
    for index in range(FRAMES):
        moving.do(intents.ShowFrame(index))
        assert overlap(moving) > 0.98
    seen = moving.state.pose.scene.T_view_world[0]
    moving.do(intents.ShowFrame(1))
    assert np.abs(moving.state.pose.scene.T_view_world[0] - seen).max() > 1e-3


def test_a_correction_of_the_camera_is_one_of_its_place_on_the_mount_in_all_frames(moving: Desk) -> None:
    shift = np.eye(4)
    shift[:3, 3] = 0.001, 0.0, 0.002
    corrected = shift @ moving.session.scene.cameras[0].T_camera_world
    value = CorrectedTransform(tuple(map(tuple, corrected.tolist())), Provenance(Source.HAND))
    moving.session.editor.project.apply("Move the camera", {Key.extrinsics("left"): value})
    for index in (1, 3):
        moving.do(intents.ShowFrame(index))
        state = moving.state.pose.scene
        wanted = corrected @ moving.session.sequence.mounts(index)["left"]
        np.testing.assert_allclose(state.T_view_world[0], wanted, atol=1e-6)
        # Moving a joint by hand changes no calibration.
        before = moving.saved.get(Key.extrinsics("left"))
        moving.do(intents.SetJoint("PSM1", 0, 0.02), intents.Released())
        assert moving.saved.get(Key.extrinsics("left")) == before
        scene = scene_at(moving.session.scene, state)
        np.testing.assert_allclose(scene.cameras[0].T_camera_world, corrected, atol=1e-6)


def test_a_run_that_does_not_free_the_camera_leaves_it_where_it_is(moving: Desk) -> None:
    moving.do(intents.ShowFrame(1))
    before = moving.state.pose.scene
    moving.do(intents.Step(), intents.Pause())
    after = moving.state.pose.scene
    assert np.array_equal(before.T_mount_world, after.T_mount_world)
    assert np.array_equal(before.T_camera_world, after.T_camera_world)
    assert moving.saved.get(Key.extrinsics("left")) is None


@pytest.fixture
def desk(tiny_sequence: Callable[..., Path]) -> Desk:
    """Frames 0.05 s after the rows of the table, which are 0.1 s apart."""

    def describe(text: str) -> str:
        frames = '[frames]\ntable = "frames.csv"\nframe_id = "{frame:03d}"\n'
        return text.replace('frame_id = "{frame:03d}"\n', "").replace("[[arms]]", frames + "[[arms]]", 1)

    path = tiny_sequence(edit=describe)
    (path.parent / "frames.csv").write_text("frame,timestamp\n1,0.05\n2,0.15\n3,0.2\n")
    sequence = Sequence.open(path)
    return Desk(sequence, Project.open(sequence), OptimizerFactory(report=lambda line: None))


def rows(desk: Desk) -> np.ndarray:
    """The table's joint positions."""
    return desk.session.sequence.with_time_offset(0.05).measured["PSM1"]


def test_a_new_offset_moves_the_measured_joints_of_the_shown_frame_and_the_truth(desk: Desk) -> None:
    image, truth = desk.state.frame.images["left"], (desk.state.frame.truth or {})["PSM1"]
    desk.controller.score()
    state = desk.do(intents.SetTimeOffset(0.05))
    assert state.pose.scene.joint_positions[0] == pytest.approx(rows(desk)[0], abs=1e-6)
    assert state.frame.measured["PSM1"] == pytest.approx(rows(desk)[0]) and state.scores is None
    assert not np.allclose((state.frame.truth or {})["PSM1"], truth)
    assert np.array_equal(state.frame.images["left"], image)


def test_typing_an_offset_is_one_step_that_undo_takes_back_and_a_restart_keeps(desk: Desk) -> None:
    before = desk.joint()
    desk.do(intents.SetTimeOffset(0.0), intents.SetTimeOffset(0.03), intents.SetTimeOffset(0.035), intents.Released())
    assert [step.name for step in desk.saved.steps] == ["Time offset"] and desk.joint() != before
    desk.do(intents.Undo())
    assert desk.joint() == before and desk.session.time_offset == 0.0
    desk.do(intents.Redo())
    moved = desk.joint()
    again = desk.reopened()
    assert again.session.time_offset == 0.035 and again.joint() == moved


def test_corrections_by_hand_stay_where_they_are(desk: Desk) -> None:
    desk.do(intents.SetJoint("PSM1", 0, 0.2), intents.SetTimeOffset(0.05), intents.Released())
    assert desk.joint() == pytest.approx(0.2)


def test_an_offset_without_joint_positions_is_told_without_an_alarm_and_changes_nothing(desk: Desk) -> None:
    before = desk.joint()
    state = desk.do(intents.SetTimeOffset(17.0))
    assert "The offset remains 0 s" in (state.time_error or "") and state.error is None and desk.joint() == before
    assert not desk.saved.steps and desk.do(intents.SetTimeOffset(0.01)).time_error is None
    state = desk.do(intents.SetTimeOffset(17.0), intents.Released())
    assert "The offset remains 0.01 s" in (state.error or "") and state.time_error is None
    with pytest.raises(CartsError, match="not a finite number"):
        desk.do(intents.SetTimeOffset(float("nan")))


def test_figures_of_another_offset_do_not_count(desk: Desk) -> None:
    desk.controller.score()
    before = desk.saved.figures(0)
    desk.do(intents.SetTimeOffset(0.05), intents.Released())
    after = desk.saved.figures(0)
    assert desk.saved.get(Key.time_offset()) == TimeOffset(0.05)
    assert before is not None and after is not None and after.dice != before.dice


def test_a_recording_without_times_has_no_offset(tiny_sequence: Callable[..., Path]) -> None:
    sequence = Sequence.open(tiny_sequence())
    desk = Desk(sequence, Project.open(sequence), OptimizerFactory(report=lambda line: None))
    assert desk.session.time_offset is None
    with pytest.raises(CartsError, match="a time offset does not apply"):
        desk.do(intents.SetTimeOffset(0.1))


def test_points_of_a_moving_camera_are_planned_solved_and_reported_at_one_pose(
    tiny_sequence: Callable[..., Path],
) -> None:
    motion = Motion(swing(FRAMES, 3.0, 0.002).Ts_world_mount[[0, 1, 1, 1]])
    sequence = Sequence.open(let_camera_move(tiny_sequence(frames=FRAMES, width=160, height=120), motion))
    clicking = Clicking(sequence)
    assert {prompt.frame for prompt in clicking.plan} == {1, 2, 3}
    there = moved_cameras(sequence.scene, sequence.mounts(1))
    points = clicked(there, sequence.measured, (1, 2, 3), ("left",), noise=0.0)
    clicking.solve(points)
    assert clicking.result is not None
    for found, true in zip(clicking.scene.arms, sequence.scene.arms, strict=True):
        np.testing.assert_allclose(found.T_world_base, true.T_world_base, atol=1e-5)
    calibration = Calibration.of(sequence.scene)
    deviations = clicking.result.deviations
    refined = Calibrated(calibration, StopReason.CONVERGED, 0.5, 0.25, deviations, (), "", "", "", "")
    report = report_of(refined, clicking, points)
    assert not report.objection and not report.disagreeing
    assert report.after == pytest.approx([0.0] * len(points), abs=0.01)
    clicking.solve(clicked(there, sequence.measured, (0, 1), ("left",), noise=0.0))
    assert clicking.result is None and "moves between frames" in clicking.problem
