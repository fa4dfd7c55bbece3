"""Looking for frames and reviewing many; comparing poses."""

import numpy as np
import pytest
from viewer_desk import Desk

from carts_core.errors import CartsError
from carts_core.project import Figures, FitVerdict, Key, Review, ReviewState
from carts_viewer.actions import intents
from carts_viewer.actions.frame_filter import BY_HAND, NOT_CHECKED, FrameFilter, found
from carts_viewer.choices import Against, Compare, composed, other_pose


@pytest.fixture
def known(desk: Desk) -> Desk:
    """Frame 0 was moved by hand, 1 has failed and a note, 2 is accepted."""
    desk.do(intents.SetJoint("PSM1", 0, 0.1), intents.Released())
    project = desk.session.editor.project
    edits = {
        Key.verdict(1): FitVerdict("failed", "", "", 0.9),
        Key.review(1): Review(ReviewState.NEEDS_WORK, "Smoke on the left"),
        Key.review(2): Review(ReviewState.ACCEPTED),
    }
    project.apply("Prepare", edits)
    project.record_figures({1: Figures(dice=0.6), 2: Figures(dice=0.95)}, project.state)
    desk.do(intents.Refresh())
    return desk


@pytest.mark.parametrize(
    ("wanted", "frames"),
    [
        (FrameFilter(), [0, 1, 2]),
        (FrameFilter(review=BY_HAND), [0]),
        (FrameFilter(review="accepted"), [2]),
        (FrameFilter(fit="failed"), [1]),
        (FrameFilter(fit=NOT_CHECKED), [0, 2]),
        (FrameFilter(dice=0.9), [0, 1]),
        (FrameFilter(note="SMOKE"), [1]),
        (FrameFilter(arm="PSM1"), [0]),
        (FrameFilter(fit="failed", review="accepted"), []),
    ],
)
def test_frames_are_found_by_what_is_known_of_them(known: Desk, wanted: FrameFilter, frames: list[int]) -> None:
    assert found(known.saved, wanted) == frames


def test_all_found_frames_are_reviewed_in_one_step_and_notes_stay(known: Desk) -> None:
    steps = len(known.saved.steps)
    known.do(intents.SetFilter("fit", "failed"), intents.ReviewFound(ReviewState.REJECTED))
    assert known.saved.review(1) == Review(ReviewState.REJECTED, "Smoke on the left")
    known.do(intents.ClearFilter(), intents.SetFilter("review", "accepted"), intents.ReviewFound(ReviewState.UNTOUCHED))
    assert known.saved.review(2) == Review() and len(known.saved.steps) == steps + 2
    known.do(intents.Undo())
    assert known.saved.review(2).state is ReviewState.ACCEPTED
    with pytest.raises(CartsError, match="No frame is like that"):
        known.do(intents.SetFilter("note", "xyz"), intents.ShowFound())
    with pytest.raises(CartsError, match="cannot be looked for by 'colour'"):
        known.do(intents.SetFilter("colour", "red"))


def test_next_and_previous_go_round_the_found_frames(known: Desk) -> None:
    known.do(intents.SetFilter("fit", NOT_CHECKED), intents.ShowFrame(0))
    assert [known.do(intents.ShowFound(step)).index for step in (1, 1, -1)] == [2, 0, 2]


def test_the_other_pose_is_seen_up_to_the_swipe_or_all_over_while_a_key_is_held(known: Desk) -> None:
    own, other = np.full((4, 10, 4), 1, np.uint8), np.full((4, 10, 4), 2, np.uint8)
    assert composed(own, other, 0.4)[0, :, 0].tolist() == [2, 2, 2, 255, 255, 1, 1, 1, 1, 1]
    assert (composed(own, other, 1.0) == 2).all()
    assert Compare().share == 0.0 and Compare(peek=True).share == 1.0
    state = known.do(intents.ShowFrame(0), intents.CompareWith(Against.MEASURED), intents.SetSwipe(7.0))
    assert state.compare.share == 1.0
    measured = known.session.measured(state.frame)
    assert other_pose(state.compare, measured, None) is measured
    assert other_pose(Compare(Against.BEFORE_RUN), measured, state.pose.scene) is state.pose.scene
