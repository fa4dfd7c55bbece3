"""Which frame to look at next."""

from project_model import HAND

from carts_core.project import (
    Figures,
    JointCorrection,
    Key,
    Keyframe,
    Project,
    Review,
    ReviewState,
    between_kept,
    frames_in,
    next_unreviewed,
    worst_first,
)


def test_the_worst_frame_comes_first_and_unknown_ones_last(project: Project) -> None:
    assert worst_first(project.state) == [0, 1, 2]
    project.record_figures({1: Figures(loss=0.1), 2: Figures(loss=0.4)}, project.state)
    assert worst_first(project.state) == [2, 1, 0]
    project.record_figures({1: Figures(loss=0.1, dice=0.5), 2: Figures(loss=0.4, dice=0.9)}, project.state)
    assert worst_first(project.state) == [1, 2, 0]
    assert worst_first(project.state, [0, 2]) == [2, 0]


def test_a_frame_is_unknown_again_when_its_joint_positions_change(project: Project) -> None:
    project.record_figures({1: Figures(loss=0.1), 2: Figures(loss=0.4)}, project.state)
    project.apply("Drag", {Key.joints(2, "PSM2"): JointCorrection((0.0, 0.0), HAND)})
    assert worst_first(project.state) == [1, 0, 2]


def test_the_next_unreviewed_frame_comes_round_at_the_end(project: Project) -> None:
    assert next_unreviewed(project.state, 0) == 1
    assert next_unreviewed(project.state, 0, step=-1) == 2
    project.apply("Mark", {Key.review(1): Review(ReviewState.ACCEPTED), Key.review(2): Review(ReviewState.NEEDS_WORK)})
    assert next_unreviewed(project.state, 1) == 0
    assert next_unreviewed(project.state, 0) == 0
    project.apply("Mark", {Key.review(0): Review(ReviewState.OPTIMIZED)})
    assert next_unreviewed(project.state, 2) == 0
    project.apply("Mark", {Key.review(0): Review(ReviewState.REJECTED)})
    assert next_unreviewed(project.state, 2) is None


def test_frames_are_found_by_their_review_state(project: Project) -> None:
    project.apply("Mark", {Key.review(2): Review(ReviewState.ACCEPTED)})
    assert frames_in(project.state, {ReviewState.ACCEPTED}) == [2]
    assert frames_in(project.state, {ReviewState.UNTOUCHED, ReviewState.REJECTED}) == [0, 1]


def test_kept_frames_are_keyframes_and_accepted_ones_and_say_where_between_is(project: Project) -> None:
    assert project.state.kept_frames == () and between_kept(project.state, 1) == range(3)
    project.apply("Drag", {Key.joints(2, "PSM2"): JointCorrection((0.0, 0.0), HAND)})
    project.apply("Mark", {Key.review(0): Review(ReviewState.ACCEPTED), Key.review(1): Review(ReviewState.REJECTED)})
    assert project.state.kept_frames == (0, 2)
    # From a kept frame, between reaches to either side of it.
    assert [between_kept(project.state, frame) for frame in range(3)] == [range(3), range(3), range(3)]
    project.apply("Mark", {Key.keyframe(1): Keyframe(True)})
    assert [between_kept(project.state, frame) for frame in range(3)] == [range(2), range(3), range(1, 3)]
    project.apply("Mark", {Key.keyframe(2): Keyframe(False)})
    assert project.state.kept_frames == (0, 1)
