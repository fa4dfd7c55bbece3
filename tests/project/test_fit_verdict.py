"""Verdicts on fits: kept, undone and redone with the pose that they are of, and void when that changes."""

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
    MaskCorrection,
    Project,
    Review,
    ReviewState,
    TimeOffset,
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
        assert again.writable and again.incident is None and again.state.verdict(0) == FAILED
        again.go_to(0)
        assert again.state.verdict(0) == GOOD
        again.apply("Optimize", {Key.joints(0, "PSM1"): _joints(0.3), Key.verdict(0): GOOD})
        again.record_verdict(0, FAILED)
        assert again.state.verdict(0) == FAILED
    with Project(IDENTITY, project_path) as again:
        assert again.incident is None and again.state.verdict(0) == FAILED and len(again.history()) == 1


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
