"""What is said about a frame follows what it is: a judgement is on what was seen, the rest on who made the joints."""

from dataclasses import replace

import numpy as np
import pytest
from viewer_desk import Desk

from carts_core.project import ReviewState
from carts_viewer.actions import intents
from carts_viewer.actions.exchange import FRAME_CHOICES
from carts_viewer.actions.frame_filter import BY_HAND, SOLVED, UNJUDGED, FrameFilter, copied, found, review_name
from carts_viewer.picture.strokes import Stroke, Target

CORNERS = np.array(((5.0, 5.0), (60.0, 5.0), (60.0, 40.0), (5.0, 40.0)))
ACCEPT = intents.SetReview(ReviewState.ACCEPTED)
MOVES = {
    "a slider": (intents.SetJoint("PSM1", 0, 0.1), intents.Released()),
    "a nudge": (intents.Nudge(1.0),),
    "a keypoint": (intents.PointAt(40.0, 30.0), intents.Released()),
    "a stroke": (intents.Paint(7, Stroke(1, 0, "left", Target.MASK, False, True, 1, CORNERS)),),
}


def _name(desk: Desk, index: int = 0) -> str:
    return review_name(desk.state.project, index)


@pytest.mark.parametrize("change", MOVES)
def test_a_frame_that_changes_after_it_was_accepted_must_be_accepted_again(desk: Desk, change: str) -> None:
    desk.do(intents.SetNote("smoke"), ACCEPT)
    for intent in MOVES[change]:
        desk.do(intent)
    assert desk.state.review.state is not ReviewState.ACCEPTED and desk.saved.review(0).note == "smoke"
    assert found(desk.saved, FrameFilter(review="accepted")) == []
    steps = len(desk.saved.steps)
    assert desk.do(intents.Undo()).review.state is ReviewState.ACCEPTED and len(desk.saved.steps) == steps
    assert desk.do(intents.Redo()).review.state is not ReviewState.ACCEPTED
    assert desk.do(ACCEPT).review.state is ReviewState.ACCEPTED


def test_a_frame_under_the_hand_is_not_accepted_and_is_again_when_it_is_put_back(desk: Desk) -> None:
    before = desk.joint()
    desk.do(intents.SetJoint("PSM1", 0, 0.1), intents.Released(), ACCEPT)
    assert desk.do(intents.SetJoint("PSM1", 0, 0.2)).review.state is ReviewState.UNTOUCHED
    assert desk.do(intents.SetJoint("PSM1", 0, 0.1), intents.Released()).review.state is ReviewState.ACCEPTED
    assert desk.joint() != before


def test_a_run_from_an_accepted_frame_ends_that_and_its_reset_brings_it_back(desk: Desk) -> None:
    desk.do(intents.Perturb(2.0, 0), ACCEPT, intents.Run())
    desk.finish()
    assert _name(desk) == "optimized"
    assert desk.do(intents.Reset()).review.state is ReviewState.ACCEPTED


def test_the_calibration_is_part_of_what_was_accepted_in_every_frame(desk: Desk) -> None:
    desk.do(ACCEPT, intents.ShowFrame(1), intents.SetReview(ReviewState.REJECTED), intents.ShowFrame(2))
    scene = desk.state.pose.scene
    moved = scene.T_world_base.clone()
    moved[0, 0, 3] += 0.001
    desk.controller._context.set_pose("Move the base", replace(scene, T_world_base=moved))
    assert [desk.saved.review(i).state for i in range(3)] == ["untouched", "rejected", "untouched"]
    desk.do(intents.Undo())
    assert [desk.saved.review(i).state for i in range(3)] == ["accepted", "rejected", "untouched"]


def test_what_is_said_of_a_frame_that_nobody_judged_follows_who_made_its_joints(desk: Desk) -> None:
    desk.do(intents.Perturb(2.0, 0), intents.Run())
    desk.finish()
    assert _name(desk) == "optimized" and found(desk.saved, FrameFilter(review="optimized")) == [0]
    desk.do(intents.Nudge(1.0))
    assert _name(desk) == BY_HAND and found(desk.saved, FrameFilter(review="optimized")) == []
    desk.do(intents.BackToMeasured())
    assert _name(desk) == "untouched" and desk.state.review.state is ReviewState.UNTOUCHED
    desk.do(intents.Undo(), intents.Undo())
    assert _name(desk) == "optimized"


def test_frames_that_were_solved_together_say_so_and_a_copy_says_what_it_is(desk: Desk) -> None:
    desk.do(intents.SetSetting("solver", "surface"), intents.Solve(whole=True))
    desk.finish()
    assert [_name(desk, index) for index in range(3)] == [SOLVED] * 3 and not copied(desk.saved, 0)
    desk.do(intents.Nudge(1.0), intents.MoveFrame(1), intents.CopyCorrection(-1))
    assert copied(desk.saved, 1) and _name(desk, 1) == "untouched"


def test_unreviewed_means_the_same_in_find_in_exports_and_in_next_unreviewed(desk: Desk) -> None:
    desk.do(ACCEPT, intents.ShowFrame(1), intents.Nudge(1.0))
    assert found(desk.saved, FrameFilter(review=UNJUDGED)) == [1, 2]
    states = FRAME_CHOICES["Unreviewed"]
    assert [index for index in range(3) if desk.saved.review(index).state in states] == [1, 2]
    assert [desk.do(intents.ShowUnreviewed()).index for _ in range(2)] == [2, 1]


def test_accept_and_next_stays_in_the_range_and_says_when_it_is_done(desk: Desk) -> None:
    desk.do(intents.SetRange((1, 2)), intents.ShowFrame(2))
    assert desk.do(intents.AcceptAndNext()).index == 1 and desk.state.notice is None
    assert desk.do(intents.AcceptAndNext()).index == 1
    assert desk.state.notice == "All 2 frames of the range are reviewed." and desk.state.error is None
    assert desk.do(intents.ShowFrame(0)).notice is None
    # Outside of the range, and without one, it is about the whole sequence.
    assert desk.do(intents.AcceptAndNext()).notice == "All 3 frames are reviewed."
