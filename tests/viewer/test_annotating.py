"""History, review, copied corrections and keypoints: what intents about the project do."""

import math

import numpy as np
import pytest
from viewer_desk import Desk

from carts_core.errors import CartsError
from carts_core.model.keypoints import project_keypoints
from carts_core.project import Figures, Project, ReviewState, Source
from carts_viewer.actions import intents
from carts_viewer.picture.overlay import keypoints_in_image, labelled_keypoints


def _drag(desk: Desk, *values: float, joint: int = 0) -> None:
    desk.do(*(intents.SetJoint("PSM1", joint, value) for value in values), intents.Released())


def test_a_drag_is_saved_when_it_is_let_go_of_and_not_before(desk: Desk) -> None:
    desk.do(intents.SetJoint("PSM1", 0, 0.1))
    assert desk.state.unsaved and not desk.saved.steps
    desk.do(intents.SetJoint("PSM1", 0, 0.2), intents.Released())
    assert not desk.state.unsaved and [step.name for step in desk.saved.steps] == ["Move PSM1 yaw, frame 001"]
    assert desk.saved.joints(0)["PSM1"].provenance.source is Source.HAND


def test_saved_edits_come_with_the_figures_of_the_pose(desk: Desk) -> None:
    _drag(desk, 0.1)
    figures = desk.saved.figures(0)
    assert figures is not None and desk.state.scores is not None and figures.dice == desk.state.scores.dice
    desk.do(intents.SetNote("half hidden"), intents.Released())
    assert desk.saved.figures(0) == figures


def test_looking_at_a_frame_keeps_its_figures_and_is_no_step(desk: Desk) -> None:
    desk.controller.score()
    figures = desk.saved.figures(0)
    assert figures is not None and figures.dice is not None and not desk.saved.steps


def test_a_kept_run_is_one_step_with_loss_settings_and_review(desk: Desk) -> None:
    desk.do(intents.Perturb(2.0, 0), intents.Run())
    desk.advance()
    assert desk.state.unsaved and len(desk.saved.steps) == 1
    desk.finish()
    step, correction = desk.saved.steps[-1], desk.saved.joints(0)["PSM1"]
    assert step.name == "Optimize, frame 001" and len(desk.saved.steps) == 2
    assert '"iterations": 4' in (correction.provenance.settings or "")
    assert correction.provenance.weights_sha256 is not None
    figures = desk.saved.figures(0)
    assert figures is not None and figures.loss == min(desk.state.run.curves.loss)
    assert desk.state.review.state is ReviewState.OPTIMIZED


def test_resetting_a_run_that_goes_on_leaves_no_trace_and_a_finished_one_a_step(desk: Desk) -> None:
    desk.do(intents.Run())
    desk.advance()
    desk.advance()
    desk.do(intents.Reset())
    assert not desk.saved.steps and desk.state.pose.source is Source.MEASURED
    desk.do(intents.Run())
    desk.finish()
    desk.do(intents.Reset())
    assert [step.name.split(",")[0] for step in desk.saved.steps] == ["Optimize", "Reset to the start of the run"]
    assert not desk.state.project.joints(0) and desk.state.review.state is ReviewState.UNTOUCHED


def test_undo_and_redo_go_through_all_frames_and_show_what_changes(desk: Desk) -> None:
    before = desk.joint()
    _drag(desk, 0.1)
    desk.do(intents.MoveFrame(2))
    _drag(desk, 0.2)
    assert desk.do(intents.Undo()).index == 2
    assert desk.do(intents.Undo()).index == 0 and desk.joint() == pytest.approx(before)
    assert desk.do(intents.Redo()).index == 0 and desk.joint() == pytest.approx(0.1)
    assert desk.do(intents.Redo()).index == 2 and desk.joint() == pytest.approx(0.2)
    assert desk.do(intents.GoToStep(0)).project.position == 0 and desk.do(intents.GoToStep(99)).project.position == 2


def test_undo_and_redo_survive_a_restart(desk: Desk) -> None:
    _drag(desk, 0.1)
    _drag(desk, 0.2)
    desk.do(intents.Undo())
    again = desk.reopened()
    assert again.joint() == pytest.approx(0.1)
    again.do(intents.Redo())
    assert again.joint() == pytest.approx(0.2)


def test_undo_of_an_unfinished_drag_takes_back_the_drag(desk: Desk) -> None:
    before = desk.joint()
    desk.do(intents.SetJoint("PSM1", 0, 0.1), intents.Undo())
    assert desk.joint() == pytest.approx(before) and not desk.state.unsaved
    assert desk.do(intents.Redo()) and desk.joint() == pytest.approx(0.1)


def test_accept_and_next_goes_on_until_all_frames_are_reviewed(desk: Desk) -> None:
    desk.do(intents.ShowFrame(1), intents.AcceptAndNext())
    assert desk.state.index == 2
    desk.do(intents.SetReview(ReviewState.REJECTED), intents.ShowUnreviewed())
    assert desk.state.index == 0
    assert desk.do(intents.AcceptAndNext()).index == 0
    with pytest.raises(CartsError, match="Every frame has been reviewed"):
        desk.do(intents.ShowUnreviewed())
    states = [desk.state.project.review(index).state for index in range(3)]
    assert states == [ReviewState.ACCEPTED, ReviewState.ACCEPTED, ReviewState.REJECTED]


def test_a_note_is_one_step_and_stays_when_the_state_changes(desk: Desk) -> None:
    pose = desk.state.pose
    # The picture does not change, so it need not be sent again.
    assert desk.do(intents.SetNote("s")).pose is pose
    desk.do(intents.SetNote("sm"), intents.SetNote("smoke"), intents.SetReview(ReviewState.NEEDS_WORK))
    review = desk.saved.review(0)
    assert (review.state, review.note) == (ReviewState.NEEDS_WORK, "smoke") and len(desk.saved.steps) == 2
    desk.do(intents.SetNote("x" * 100_000), intents.Released())
    assert len(desk.saved.review(0).note) == 10_000


def test_the_worst_frame_that_is_not_settled_comes_first(desk: Desk) -> None:
    project = desk.session.editor.project
    project.record_figures({index: Figures(dice=dice) for index, dice in enumerate((0.9, 0.5, 0.7))}, project.state)
    desk.do(intents.Refresh(), intents.ShowFrame(1))
    visited = [
        desk.state.index,
        *(desk.do(intents.ShowWorse()).index for _ in range(2)),
        desk.do(intents.ShowWorse(-1)).index,
    ]
    assert visited == [1, 2, 0, 2]
    desk.do(intents.ShowFrame(1), intents.SetReview(ReviewState.ACCEPTED), intents.ShowFrame(2))
    assert [desk.do(intents.ShowWorse()).index for _ in range(2)] == [0, 2]


def test_a_copied_correction_is_propagated_and_not_a_keyframe(desk: Desk) -> None:
    measured = desk.session.sequence.measured["PSM1"]
    _drag(desk, measured[0][0] + 0.05)
    desk.do(intents.MoveFrame(1), intents.CopyCorrection(-1))
    assert desk.joint() == pytest.approx(measured[1][0] + 0.05, abs=1e-6)
    assert desk.saved.joints(1)["PSM1"].provenance.source is Source.PROPAGATED
    assert desk.saved.is_keyframe(0) and not desk.saved.is_keyframe(1)
    with pytest.raises(CartsError, match="no correction to copy"):
        desk.do(intents.CopyCorrection(1))


def test_keys_nudge_the_joint_that_was_moved_last_or_chosen(desk: Desk) -> None:
    _drag(desk, 0.1, joint=1)
    desk.do(intents.Nudge(1.0))
    assert np.degrees(desk.joint(1)) == pytest.approx(np.degrees(0.1) + 1.0, abs=1e-4)
    before = desk.joint(2)
    desk.do(intents.ChooseJoint(), intents.Nudge(-0.1))
    assert desk.joint(2) == pytest.approx(before - 1e-4, abs=1e-7)
    with pytest.raises(CartsError, match="no joint"):
        desk.do(intents.ChooseJoint(("PSM9", 0)))
    assert len(desk.saved.steps) == 3


def _pixels(desk: Desk) -> dict[str, list[float]]:
    """Where the keypoints truly are in the shown camera."""
    scene, points = desk.session.scene, labelled_keypoints(desk.session.scene)
    state = scene.state(desk.state.frame.truth or {})
    pixels = project_keypoints(scene, state, list(points.values()), desk.state.camera).tolist()
    return dict(zip(points, pixels, strict=True))


def test_clicks_on_two_keypoints_bring_a_badly_wrong_arm_back(desk: Desk) -> None:
    desk.do(intents.Perturb(5.0, 0))
    desk.controller.score()
    assert desk.state.scores is not None and desk.state.scores.dice is not None and desk.state.scores.dice < 0.6
    for label in ("jaw 1 tip", "wrist pitch joint"):
        u, v = _pixels(desk)[label]
        desk.do(intents.ChooseKeypoint(label), intents.PointAt(u, v), intents.Released())
    assert max(desk.state.keypoints.residuals) < 0.5
    figures = desk.saved.figures(0)
    assert figures is not None and (figures.dice or 0.0) > 0.9
    assert [step.name for step in desk.saved.steps][1:] == [
        "Place jaw 1 tip, frame 001",
        "Place wrist pitch joint, frame 001",
    ]


def test_a_dragged_keypoint_is_the_one_that_was_nearest_and_one_step(desk: Desk) -> None:
    points = labelled_keypoints(desk.session.scene)
    scene = desk.session.scene
    shown = project_keypoints(scene, desk.state.pose.scene, list(points.values()), "left")
    u, v = shown[list(points).index("wrist pitch joint")].tolist()
    desk.do(*(intents.PointAt(u + step, v) for step in (0.5, 3.0, 6.0)), intents.Released())
    (pin,) = desk.state.keypoints.pins
    assert pin.keypoint.name == "wrist pitch joint" and pin.pixel == pytest.approx((u + 6.0, v))
    assert len(desk.saved.steps) == 1 and desk.state.keypoints.residuals[0] < 0.5


@pytest.mark.parametrize(
    "intent", [intents.SetJoint("PSM1", 0, 0.1), intents.MoveFrame(1), intents.Undo(), intents.ForgetPins()]
)
def test_pins_are_forgotten_when_the_pose_is_changed_otherwise(desk: Desk, intent: intents.Intent) -> None:
    desk.do(intents.PointAt(40.0, 30.0), intents.Released())
    assert desk.state.keypoints.pins
    assert not desk.do(intent).keypoints.pins


def test_a_place_that_is_none_is_refused_and_one_outside_the_image_is_at_its_edge(desk: Desk) -> None:
    with pytest.raises(CartsError, match="no place in the image"):
        desk.do(intents.PointAt(float("nan"), 3.0))
    with pytest.raises(CartsError, match="There is no keypoint"):
        desk.do(intents.ChooseKeypoint("elbow"))
    desk.do(intents.PointAt(1e9, -1e9))
    assert desk.state.keypoints.pins[0].pixel == (96.0, 0.0)


def test_keypoints_that_the_image_shows_are_named_with_their_places(desk: Desk) -> None:
    state, scene = desk.state, desk.session.scene
    points = labelled_keypoints(scene)
    pixels = project_keypoints(scene, state.pose.scene, list(points.values()), "left").tolist()
    found = keypoints_in_image(scene, state.pose.scene, "left", points)
    assert found and len(found) <= len(points)
    for label, u, v in found:
        assert (96 * u, 72 * v) == pytest.approx(pixels[list(points).index(label)], abs=1e-2)


def test_clicks_stay_when_the_optimizer_runs_and_say_how_far_off_they_are_then(desk: Desk) -> None:
    desk.do(intents.PointAt(40.0, 30.0), intents.Released())
    (pin,) = desk.state.keypoints.pins
    desk.do(intents.Run())
    state = desk.finish()
    assert state.keypoints.pins == (pin,)
    at = project_keypoints(desk.session.scene, state.pose.scene, [pin.keypoint], "left")[0]
    assert state.keypoints.residuals == pytest.approx([math.dist(at.tolist(), pin.pixel)], abs=1e-3)
    # The next click starts from where the run has ended, not from before it.
    before = state.pose.scene
    desk.do(intents.PointAt(*at.tolist()), intents.Released())
    pairs = zip(before.joint_positions, desk.state.pose.scene.joint_positions, strict=True)
    assert all(np.allclose(one, other, atol=2e-3) for one, other in pairs)


def test_a_click_in_another_camera_is_of_that_camera(desk: Desk) -> None:
    desk.do(intents.PointAt(40.0, 30.0, "right"))
    assert desk.state.keypoints.pins[0].camera == "right" and desk.state.camera == "left"


def test_edits_of_a_project_that_takes_none_are_shown_until_another_frame_is(desk: Desk) -> None:
    _drag(desk, 0.1)
    other = desk.reopened(read_only=True)
    _drag(other, 0.3)
    _drag(other, 0.4, joint=1)
    assert other.state.unsaved and other.joint() == pytest.approx(0.3) and other.joint(1) == pytest.approx(0.4)
    other.do(intents.Undo())
    assert not other.state.unsaved and other.joint() == pytest.approx(0.1)
    with pytest.raises(CartsError, match="cannot be changed"):
        other.do(intents.Undo())
    assert isinstance(other.session.editor.project, Project) and len(other.saved.steps) == 1
