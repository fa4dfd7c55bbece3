"""Edits of a project: history, keypoints, dragged links, poses of frames, and people who work at the same time."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from viewer_desk import Desk

from carts_core.errors import CartsError
from carts_core.model.keypoints import Keypoint, project_keypoints
from carts_core.model.scene import Scene
from carts_core.project import (
    CorrectedTransform,
    Figures,
    JointCorrection,
    Key,
    Kind,
    Project,
    Provenance,
    Review,
    ReviewState,
    Source,
)
from carts_core.recording import Sequence
from carts_core.settings import FreeParameters
from carts_viewer.actions import intents
from carts_viewer.editing import People
from carts_viewer.picture.overlay import keypoints_in_image, labelled_keypoints
from carts_viewer.session import Session, joint_correction
from carts_viewer.state import Phase, Pose, ViewState


def _drag(desk: Desk, *values: float, joint: int = 0) -> None:
    desk.do(*(intents.SetJoint("PSM1", joint, value) for value in values), intents.Released())


def test_figures_come_with_looking_at_a_frame_and_with_every_edit(desk: Desk) -> None:
    desk.controller.score()
    figures = desk.saved.figures(0)
    assert figures is not None and figures.dice is not None and not desk.saved.steps
    _drag(desk, 0.1)
    assert [step.name for step in desk.saved.steps] == ["Move PSM1 yaw, frame 001"]
    figures = desk.saved.figures(0)
    assert figures is not None and desk.state.scores is not None and figures.dice == desk.state.scores.dice
    desk.do(intents.SetNote("half hidden"), intents.Released())
    assert desk.saved.figures(0) == figures


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
    start = desk.joint()
    desk.do(intents.Run())
    desk.advance()
    desk.advance()
    state = desk.do(intents.Reset())
    assert not desk.saved.steps and state.pose.source is Source.MEASURED and desk.joint() == start
    assert state.run.curves.loss == () and state.run.phase is Phase.IDLE
    desk.do(intents.Run())
    desk.finish()
    desk.do(intents.Reset())
    assert [step.name.split(",")[0] for step in desk.saved.steps] == ["Optimize", "Reset to the start of the run"]
    assert not desk.state.project.joints(0) and desk.state.review.state is ReviewState.UNTOUCHED
    assert desk.joint() == start


def test_a_note_is_limited_and_leaves_the_picture_as_it_is(desk: Desk) -> None:
    pose = desk.state.pose
    assert desk.do(intents.SetNote("x" * 100_000)).pose is pose
    desk.do(intents.Released())
    assert len(desk.saved.review(0).note) == 10_000


def test_the_worst_frame_that_is_not_settled_comes_first(desk: Desk) -> None:
    project = desk.session.editor.project
    project.record_figures({index: Figures(dice=dice) for index, dice in enumerate((0.9, 0.5, 0.7))}, project.state)
    desk.do(intents.Refresh(), intents.ShowFrame(1))
    visited = [
        desk.state.index,
        *(desk.do(intents.ShowWorst()).index for _ in range(2)),
        desk.do(intents.ShowWorst(-1)).index,
    ]
    assert visited == [1, 2, 0, 2]
    desk.do(intents.ShowFrame(1), intents.SetReview(ReviewState.ACCEPTED), intents.ShowFrame(2))
    assert [desk.do(intents.ShowWorst()).index for _ in range(2)] == [0, 2]


def test_keys_nudge_the_joint_that_was_moved_last_or_chosen(desk: Desk) -> None:
    _drag(desk, 0.1, joint=1)
    desk.do(intents.Nudge(1.0))
    assert np.degrees(desk.joint(1)) == pytest.approx(np.degrees(0.1) + 1.0, abs=1e-4)
    before = desk.joint(2)
    desk.do(intents.ChooseJoint(), intents.Nudge(-0.1))
    assert desk.joint(2) == pytest.approx(before - 1e-4, abs=1e-7)
    with pytest.raises(CartsError, match="Unknown joint"):
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
    "intent", [intents.SetJoint("PSM1", 0, 0.1), intents.MoveFrame(1), intents.Undo(), intents.RemovePins()]
)
def test_pins_are_forgotten_when_the_pose_is_changed_otherwise(desk: Desk, intent: intents.Intent) -> None:
    desk.do(intents.PointAt(40.0, 30.0), intents.Released())
    assert desk.state.keypoints.pins
    assert not desk.do(intent).keypoints.pins


def test_a_place_that_is_none_is_refused_and_one_outside_the_image_is_at_its_edge(desk: Desk) -> None:
    with pytest.raises(CartsError, match="not a position in the image"):
        desk.do(intents.PointAt(float("nan"), 3.0))
    with pytest.raises(CartsError, match="Unknown keypoint"):
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


# ---- Links that are dragged -----------------------------------------------------------------------------------------


def _seen(scene: Scene, state: ViewState, point: Keypoint) -> tuple[float, float]:
    u, v = project_keypoints(scene, state.pose.scene, [point], state.camera)[0].tolist()
    return u, v


def _taken(desk: Desk) -> tuple[tuple[float, float], Keypoint]:
    """Position in the image on the arm, and the point of the arm there."""
    rows, columns = np.nonzero(desk.renderer.arm_ids(desk.state.pose.scene, desk.state.camera) == 0)
    place = float(np.median(columns)) + 0.5, float(rows[np.abs(columns - np.median(columns)).argmin()]) + 0.5
    point = desk.renderer.pick(desk.state.pose.scene, desk.state.camera, place, 15.0)
    assert point is not None
    return place, point


def test_the_point_that_was_taken_follows_the_pointer_and_a_gesture_is_one_step(desk: Desk) -> None:
    place, point = _taken(desk)
    before, start = _seen(desk.session.scene, desk.state, point), desk.state.pose.scene
    for share in (0.3, 0.7, 1.0):
        end = place[0] + share * 9.0, place[1] - share * 6.0
        desk.do(intents.DragLink(1.0, "left", place, end))
    after = _seen(desk.session.scene, desk.state, point)
    assert (after[0] - before[0], after[1] - before[1]) == pytest.approx((9.0, -6.0), abs=0.5)
    desk.do(intents.Released())
    assert desk.saved.position == 1 and desk.saved.steps[0].name.startswith("Drag PSM1 ")
    desk.do(intents.Undo())
    for one, other in zip(desk.state.pose.scene.joint_positions, start.joint_positions, strict=True):
        assert np.array_equal(one, other)


def test_a_link_that_is_dragged_beyond_its_limits_and_back_brings_the_joints_back(desk: Desk) -> None:
    place, _ = _taken(desk)
    start = desk.session.joints(desk.state.pose.scene)
    desk.do(intents.DragLink(1.0, "left", place, (1e6, -1e6)))
    away = desk.session.joints(desk.state.pose.scene)
    assert max(np.abs(away[arm] - start[arm]).max() for arm in start) > 0.005
    for arm in desk.session.scene.arms:
        low, high = arm.robot.joint_limits.T
        assert (away[arm.name] >= low - 1e-6).all() and (away[arm.name] <= high + 1e-6).all()
    desk.do(intents.DragLink(1.0, "left", place, place))
    back = desk.session.joints(desk.state.pose.scene)
    assert max(np.abs(back[arm] - start[arm]).max() for arm in start) < 1e-4


def test_where_no_arm_is_that_is_said_once_and_nothing_moves(desk: Desk) -> None:
    ids = desk.renderer.arm_ids(desk.state.pose.scene, "left")
    corners = [(0, 0), (0, ids.shape[1] - 1), (ids.shape[0] - 1, 0), (ids.shape[0] - 1, ids.shape[1] - 1)]
    row, column = next((r, c) for r, c in corners if (ids[max(r - 20, 0) : r + 20, max(c - 20, 0) : c + 20] < 0).all())
    with pytest.raises(CartsError, match="no arm under the pointer"):
        desk.do(intents.DragLink(1.0, "left", (column + 0.5, row + 0.5), (column + 9.0, row + 9.0)))
    desk.do(intents.DragLink(1.0, "left", (column + 0.5, row + 0.5), (column + 30.0, row + 9.0)))
    assert desk.saved.position == 0 and not desk.state.unsaved


def _calibrate(desk: Desk, by: float = 0.01) -> CorrectedTransform:
    """Move a base frame by `by` [m], as another tab or a job does."""
    transform = np.array(desk.session.measured(desk.state.frame).T_world_base[0], np.float64)
    transform[0, 3] += by
    value = CorrectedTransform(tuple(map(tuple, transform.tolist())), HAND)
    desk.session.editor.project.apply("Calibrate", {Key.base_frame("PSM1"): value})
    desk.controller.follow()
    return value


def test_a_calibration_during_a_run_or_between_pins_stays(desk: Desk) -> None:
    desk.do(intents.Run())
    desk.advance()
    moved = _calibrate(desk)
    desk.finish()
    assert desk.saved.steps[-1].name == "Optimize, frame 001"
    assert desk.saved.get(Key.base_frame("PSM1")) == moved
    desk.do(intents.ChooseKeypoint("wrist pitch joint"), intents.PointAt(40.0, 30.0), intents.Released())
    moved = _calibrate(desk)
    desk.do(intents.ChooseKeypoint("jaw 1 tip"), intents.PointAt(45.0, 36.0), intents.Released())
    assert desk.saved.get(Key.base_frame("PSM1")) == moved
    # The pins are fitted with the new calibration.
    pins, shown = desk.state.keypoints.pins, desk.state.pose.scene
    at = [project_keypoints(desk.session.scene, shown, [pin.keypoint], pin.camera)[0] for pin in pins]
    distances = [math.dist(place.tolist(), pin.pixel) for place, pin in zip(at, pins, strict=True)]
    assert len(pins) == 2 and max(distances) < 1.0


def test_a_reset_takes_back_only_the_calibration_of_its_run(desk: Desk) -> None:
    base, other = Key.base_frame("PSM1"), Key.extrinsics("right")
    desk.do(intents.Run())
    desk.finish()
    moved = _calibrate(desk)
    desk.do(intents.Reset())
    assert desk.saved.get(base) == moved and not desk.saved.joints(0)
    # The run changes both; the base frame is changed again.
    desk.do(*(intents.SetFreeGroup(group, True) for group in ("base_frames", "extrinsics")), intents.Run())
    desk.finish()
    assert desk.saved.get(base) != moved and desk.saved.get(other) is not None
    moved = _calibrate(desk)
    desk.do(intents.Reset())
    assert desk.saved.get(base) == moved and desk.saved.get(other) is None


# ---- Poses of frames ------------------------------------------------------------------------------------------------


HAND = Provenance(Source.HAND)


@pytest.fixture
def session(tiny_sequence: Callable[..., Path]) -> Session:
    sequence = Sequence.open(tiny_sequence(cameras=("left", "right"), domains=("regular", "smoke")))
    return Session(sequence, People(Project.open(sequence)))


def _pose(session: Session, index: int, camera: str = "left", domain: str = "regular") -> Pose:
    return session.pose(session.frame(index, domain, camera))


def _first_joint(session: Session, index: int, camera: str = "left", domain: str = "regular") -> float:
    return float(session.joints(_pose(session, index, camera, domain).scene)["PSM1"][0])


def _correct(session: Session, index: int, value: float, provenance: Provenance = HAND) -> None:
    frame = session.frame(index, "regular", "left")
    scene = session.with_joint(session.pose(frame).scene, "PSM1", 0, value)
    session.editor.project.apply("Correct", session.edits(frame, scene, provenance))


def test_a_correction_is_of_its_frame_in_every_camera_and_domain(session: Session) -> None:
    _correct(session, 1, 0.25)
    assert _first_joint(session, 1) == pytest.approx(0.25)
    assert _first_joint(session, 1, "right", "smoke") == pytest.approx(0.25)
    assert _first_joint(session, 0) != pytest.approx(0.25)


def test_a_pose_as_measured_needs_no_correction_and_one_as_saved_keeps_its_provenance(session: Session) -> None:
    optimizer = Provenance.made_by_optimizer({}, "0" * 64)
    _correct(session, 1, 0.25, optimizer)
    frame = session.frame(1, "regular", "left")
    assert session.edits(frame, session.measured(frame), HAND) == {Key.joints(1, "PSM1"): None}
    edits = session.edits(frame, session.pose(frame).scene, HAND)
    assert edits[Key.joints(1, "PSM1")].provenance == optimizer and len(edits) == 1
    assert session.pose(frame).source is Source.OPTIMIZER


def test_a_corrected_calibration_holds_in_every_frame(session: Session) -> None:
    frame = session.frame(1, "regular", "left")
    state = session.pose(frame).scene
    extrinsics, intrinsics, bases = state.T_camera_world.copy(), state.intrinsics.copy(), state.T_world_base.copy()
    extrinsics[1, 0, 3] += 0.01
    intrinsics[0, 0] += 5.0
    bases[0, 1, 3] += 0.02
    moved = replace(state, T_camera_world=extrinsics, intrinsics=intrinsics, T_world_base=bases)
    # An edit by hand never changes the calibration.
    assert {key.kind for key in session.edits(frame, moved, HAND)} == {Kind.JOINTS}
    free = FreeParameters(base_frames=True, extrinsics=True, intrinsics=True)
    edits = session.edits(frame, moved, HAND, free=free)
    assert {key.name for key in edits if key.kind in (Kind.EXTRINSICS, Kind.INTRINSICS)} == {"right", "left"}
    session.editor.project.apply("Calibrate", edits)
    other = _pose(session, 0).scene
    np.testing.assert_allclose(other.T_camera_world, extrinsics, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(other.T_world_base, bases, rtol=0.0, atol=1e-7)
    assert np.array_equal(other.intrinsics, intrinsics)


# ---- People at the same time ----------------------------------------------------------------------------------------


ACCEPTED, REJECTED = Review(ReviewState.ACCEPTED), Review(ReviewState.REJECTED)


@pytest.fixture
def people(tiny_sequence) -> People:
    path: Path = tiny_sequence(frames=4)
    return People(Project.open(Sequence.open(path)))


def _reviews(people: People) -> list[str]:
    return [str(people.project.state.review(frame).state) for frame in range(4)]


def _two_arms(text: str) -> str:
    arm = text[text.index("[[arms]]") : text.index("[[cameras]]")]
    return text.replace(arm, arm + arm.replace("PSM1", "PSM2"))


def test_gestures_runs_and_notes_leave_what_another_tab_changes_meanwhile(
    tiny_sequence: Callable[..., Path], untrained_weights: Path
) -> None:
    desk = Desk.open(tiny_sequence(edit=_two_arms), weights=(untrained_weights,))
    people, joints = desk.session.editor.people, desk.session.joints(desk.state.pose.scene)
    bob, own, other = people.join(), "PSM1", "PSM2"

    def correct(value: float) -> JointCorrection:
        correction = joint_correction(np.array([value, *joints[other][1:]]), HAND)
        people.apply(bob, "Correct", {Key.joints(0, other): correction})
        return correction

    # The second arm is moved out of the way of the first one.
    correct(0.4)
    desk.controller.follow()
    place, point = _taken(desk)
    assert point.arm == own

    def drag(by: float) -> intents.Intent:
        return intents.DragLink(1.0, "left", place, (place[0] + by, place[1]))

    def move(by: float) -> intents.Intent:
        return intents.SetJoint(own, 0, joints[own][0] + by / 100)

    for number, gesture in enumerate((drag, move), start=2):
        desk.do(gesture(5.0))
        correct(0.4 + 0.01 * number)
        desk.do(gesture(8.0))
        expected = correct(0.5 + 0.01 * number)
        desk.do(gesture(9.0), intents.Released())
        assert desk.saved.joints(0)[other] == expected and desk.saved.position == 3 * number - 2
    desk.do(*(intents.SetFreeJoint(other, name, False) for name in desk.session.scene.arm(other).robot.joint_names))
    desk.do(intents.Run())
    desk.advance()
    expected = correct(0.6)
    desk.finish()
    assert desk.saved.joints(0)[other] == expected and "Optimize" in desk.saved.steps[-1].name
    # State and note of a review are separate.
    desk.do(intents.SetNote("half"))
    people.apply(bob, "Accept", {Key.review(0): ACCEPTED})
    desk.do(intents.SetNote("half hidden"))
    people.apply(bob, "Reject", {Key.review(0): REJECTED})
    desk.do(intents.Released())
    assert desk.saved.review(0) == Review(ReviewState.REJECTED, "half hidden")


def test_what_somebody_else_has_changed_since_is_not_taken_back(people: People) -> None:
    ann, bob = people.join(), people.join()
    people.apply(ann, "Accept", {Key.review(1): ACCEPTED})
    people.apply(ann, "Accept", {Key.review(0): ACCEPTED})
    people.apply(bob, "Reject", {Key.review(0): REJECTED})
    with pytest.raises(CartsError, match=r"step 3 \(Tab 2: Reject\) has changed the same values since.*Undo again"):
        people.undo(ann)
    assert _reviews(people)[:2] == ["rejected", "accepted"]
    people.undo(ann)
    assert _reviews(people)[:2] == ["rejected", "untouched"]


def test_nobody_goes_back_over_the_steps_of_somebody_at_work(people: People) -> None:
    ann, bob = people.join(), people.join()
    people.apply(ann, "Accept", {Key.review(0): ACCEPTED})
    people.apply(bob, "Reject", {Key.review(2): REJECTED})
    with pytest.raises(CartsError, match="steps of other active users: Tab 2"):
        people.go_to(ann, 0)
    bob.present = False
    people.go_to(ann, 0)
    assert people.project.state.position == 0


def test_a_user_alone_undoes_the_newest_step_even_if_its_maker_has_left(people: People) -> None:
    ann, bob = people.join(), people.join()
    people.apply(ann, "Accept", {Key.review(0): ACCEPTED})
    people.apply(bob, "Reject", {Key.review(2): REJECTED})
    people.leave(bob)
    people.undo(ann)
    assert _reviews(people)[:3] == ["accepted", "untouched", "untouched"]
    people.undo(ann)
    assert _reviews(people)[0] == "untouched"


def test_a_user_alone_undoes_the_newest_step_of_a_closed_page(people: People) -> None:
    people.project.apply("Accept", {Key.review(0): ACCEPTED})
    gone, new = people.join(), people.join()
    people.apply(gone, "Reject", {Key.review(1): REJECTED})
    gone.present = False
    people.undo(new)
    assert _reviews(people)[:2] == ["accepted", "untouched"]
    people.undo(new)
    assert _reviews(people)[0] == "untouched"


def test_nobody_redoes_a_step_that_was_replaced_by_one_of_somebody_else(people: People) -> None:
    ann, bob = people.join(), people.join()
    people.apply(ann, "Accept", {Key.review(0): ACCEPTED})
    people.apply(bob, "Reject", {Key.review(1): REJECTED})
    people.undo(ann)
    ann.present = False
    people.go_to(bob, 2)
    people.apply(bob, "Reject", {Key.review(2): REJECTED})
    ann.present = True
    assert not people.can_redo(ann) and people.redo(ann) is None
    assert _reviews(people) == ["accepted", "rejected", "rejected", "untouched"]


def test_beside_others_ones_last_step_from_before_the_viewer_started_is_taken_back_and_theirs_are_not(
    people: People,
) -> None:
    people.project.apply("Ann: Accept", {Key.review(0): ACCEPTED})
    people.project.apply("Accept", {Key.review(1): ACCEPTED})
    people.project.apply("Bob: Reject", {Key.review(2): REJECTED})
    ann, bob = people.join(), people.join()
    ann.chosen, bob.chosen = "Ann", "Bob"
    people.apply(bob, "Reject", {Key.review(3): REJECTED})
    for expected in (["accepted", "untouched"], ["untouched", "untouched"]):
        assert people.can_undo(ann)
        people.undo(ann)
        assert _reviews(people) == [*expected, "rejected", "rejected"]
    assert not people.can_undo(ann) and people.undo(ann) is None
    people.redo(ann)
    people.undo(bob)
    people.undo(bob)
    assert _reviews(people) == ["accepted", "untouched", "untouched", "untouched"] and not people.can_undo(bob)
