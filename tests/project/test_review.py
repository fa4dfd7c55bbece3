"""Verdicts on fits, review states, and the order in which frames are reviewed."""

from pathlib import Path

import numpy as np
import pytest
from project_model import HAND, IDENTITY

from carts_core.errors import ProjectError
from carts_core.project import (
    Figures,
    FitVerdict,
    JointCorrection,
    Key,
    Keyframe,
    MaskCorrection,
    Project,
    Review,
    ReviewState,
    TimeOffset,
    between_kept,
    frames_in,
    next_unreviewed,
    worst_first,
)

GOOD = FitVerdict("good", "The image supports the fit.", "", 0.01)
FAILED = FitVerdict("failed", "The image contradicts the fit.", "Run again.", 0.9)
PAINTED = np.eye(IDENTITY.cameras["left"][1], IDENTITY.cameras["left"][0], dtype=bool)


def _joints(value: float) -> JointCorrection:
    return JointCorrection((value, 0.2, 0.03), HAND)


def test_a_verdict_holds_until_the_pose_changes_and_comes_back_with_undo(project: Project, project_path: Path) -> None:
    project.apply("Optimize", {Key.joints(0, "PSM1"): _joints(0.1), Key.verdict(0): GOOD})
    project.apply("Accept", {Key.review(0): Review(ReviewState.ACCEPTED)})
    assert project.state.verdict(0) == GOOD
    project.apply("Move", {Key.joints(0, "PSM1"): _joints(0.2)})
    assert project.state.verdict(0) is None
    project.undo()
    assert project.state.verdict(0) == GOOD
    project.close()
    with Project(IDENTITY, project_path, read_only=True) as again:
        assert again.state.verdict(0) == GOOD and again.state.verdict(1) is None


def test_a_check_is_no_step_and_its_verdict_comes_and_goes_with_the_pose(project: Project, project_path: Path) -> None:
    project.record_verdict(0, GOOD)
    project.apply("Move", {Key.joints(0, "PSM1"): _joints(0.1)})
    assert project.state.verdict(0) is None
    project.record_verdict(0, GOOD)
    project.record_verdict(0, FAILED)
    project.apply("Accept", {Key.review(0): Review(ReviewState.ACCEPTED)})
    assert project.state.verdict(0) == FAILED and len(project.history()) == 2
    project.go_to(0)
    assert project.state.verdict(0) == GOOD
    project.go_to(2)
    assert project.state.verdict(0) == FAILED
    project.close()
    with Project(IDENTITY, project_path) as again:
        assert again.writable and again.storage_failure is None and again.state.verdict(0) == FAILED
        again.go_to(0)
        assert again.state.verdict(0) == GOOD
        again.apply("Optimize", {Key.joints(0, "PSM1"): _joints(0.3), Key.verdict(0): GOOD})
        again.record_verdict(0, FAILED)
        assert again.state.verdict(0) == FAILED
    with Project(IDENTITY, project_path) as again:
        assert again.storage_failure is None and again.state.verdict(0) == FAILED and len(again.history()) == 1


@pytest.mark.parametrize(
    ("key", "value"),
    [
        (Key.mask_correction(0, "left"), MaskCorrection.of(PAINTED, ~PAINTED)),
        (Key.joints(0, "PSM1"), _joints(0.3)),
        (Key.time_offset(), TimeOffset(0.5)),
    ],
)
def test_reverting_a_step_restores_verdict_and_figures(project: Project, key: Key, value: object) -> None:
    project.apply("Optimize", {Key.joints(0, "PSM1"): _joints(0.1), Key.verdict(0): GOOD}, {0: Figures(0.4, 0.9)})
    project.apply("Edit", {key: value})
    project.apply("Accept", {Key.review(1): Review(ReviewState.ACCEPTED)})
    project.apply("Undo", *project.reverting(2))
    assert project.state.verdict(0) == GOOD and project.state.figures(0) == Figures(0.4, 0.9)
    project.apply("Redo", *project.reverting(4))
    assert project.state.verdict(0) is None and project.state.figures(0) is None


def test_a_step_below_another_edit_of_its_frame_is_taken_back_without_its_verdict(project: Project) -> None:
    project.apply("Optimize", {Key.joints(0, "PSM1"): _joints(0.1), Key.verdict(0): GOOD})
    project.apply("Paint", {Key.mask_correction(0, "left"): MaskCorrection.of(PAINTED, ~PAINTED)})
    project.apply("Optimize", {Key.joints(0, "PSM1"): _joints(0.2), Key.verdict(0): FAILED})
    project.apply("Undo", *project.reverting(2))
    assert project.state.get(Key.mask_correction(0, "left")) is None and project.state.verdict(0) is None
    # The verdict of step 1 was void when step 3 began.
    project.apply("Undo", *project.reverting(3))
    assert project.state.verdict(0) is None


def test_without_truth_the_worst_frame_is_the_one_that_most_probably_failed(project: Project) -> None:
    project.apply("Assess", {Key.verdict(0): GOOD, Key.verdict(1): FAILED})
    assert worst_first(project.state)[:2] == [1, 0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("fine",), "must be one of: good, doubtful, failed"),
        (("good", "", "", 1.5), "Give a number from 0 to 1"),
        (("good", "x" * 3000), "at most 2000 characters"),
    ],
)
def test_what_is_no_verdict_is_refused(arguments: tuple, message: str) -> None:
    with pytest.raises(ProjectError, match=message):
        FitVerdict(*arguments)


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
