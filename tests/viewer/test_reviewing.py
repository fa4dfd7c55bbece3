"""Reviews, verdicts, filters and warnings of frames."""

from dataclasses import replace

import numpy as np
import pytest
from viewer_desk import Desk

from carts_core.errors import CartsError
from carts_core.optimization import BASE_FRAME_GAIN, FreeParameters, undetermined_joints
from carts_core.project import Figures, FitVerdict, Key, Provenance, Review, ReviewState, Source
from carts_viewer.actions import intents
from carts_viewer.actions.frame_filter import (
    BY_HAND,
    NO_REVIEW,
    NOT_CHECKED,
    SOLVED,
    FrameFilter,
    is_copied,
    matching_frames,
    review_name,
)
from carts_viewer.actions.import_export import FRAME_CHOICES, export_warnings
from carts_viewer.jobs.comparison import worse_than
from carts_viewer.jobs.solver import Fit
from carts_viewer.panels.fit import fit_text
from carts_viewer.panels.joints import value_rows
from carts_viewer.panels.optimize import note
from carts_viewer.panels.sequence import calibration_line
from carts_viewer.picture.comparison import compared_pose, composed
from carts_viewer.picture.layers import Layer
from carts_viewer.picture.strokes import Stroke, Target
from carts_viewer.state import Compare, ComparedPose, CompareMode, Curves

CORNERS = np.array(((5.0, 5.0), (60.0, 5.0), (60.0, 40.0), (5.0, 40.0)))


ACCEPT = intents.SetReview(ReviewState.ACCEPTED)


MOVES = (
    (intents.SetJoint("PSM1", 0, 0.1), intents.Released()),
    (intents.Nudge(1.0),),
    (intents.PointAt(40.0, 30.0), intents.Released()),
    (intents.Paint(7, Stroke(1, 0, "left", Target.MASK, False, True, 1, CORNERS)),),
)


def _name(desk: Desk, index: int = 0) -> str:
    return review_name(desk.state.project, index)


def test_a_frame_that_changes_after_it_was_accepted_must_be_accepted_again(desk: Desk) -> None:
    desk.do(intents.SetNote("smoke"))
    for moves in MOVES:
        desk.do(ACCEPT, *moves)
        assert desk.state.review.state is not ReviewState.ACCEPTED and desk.saved.review(0).note == "smoke", moves
        assert matching_frames(desk.saved, FrameFilter(review="accepted")) == []
        steps = len(desk.saved.steps)
        assert desk.do(intents.Undo()).review.state is ReviewState.ACCEPTED and len(desk.saved.steps) == steps
        assert desk.do(intents.Redo()).review.state is not ReviewState.ACCEPTED
    # While it is dragged it is not accepted; back where it was it is again, as it is after the reset of a run.
    start = desk.joint()
    assert desk.do(ACCEPT, intents.SetJoint("PSM1", 0, 0.2)).review.state is ReviewState.UNTOUCHED
    assert desk.do(intents.SetJoint("PSM1", 0, start), intents.Released()).review.state is ReviewState.ACCEPTED
    desk.do(intents.Perturb(2.0, 0), ACCEPT, intents.Run())
    desk.finish()
    assert _name(desk) == "optimized"
    assert desk.do(intents.Reset()).review.state is ReviewState.ACCEPTED


def test_the_calibration_is_part_of_what_was_accepted_in_every_frame(desk: Desk) -> None:
    desk.do(ACCEPT, intents.ShowFrame(1), intents.SetReview(ReviewState.REJECTED), intents.ShowFrame(2))
    scene = desk.state.pose.scene
    moved = scene.T_world_base.copy()
    moved[0, 0, 3] += 0.001
    pose, free = replace(scene, T_world_base=moved), FreeParameters(base_frames=True)
    edits = desk.session.edits(desk.state.frame, pose, Provenance(Source.HAND), free=free)
    desk.controller._context.edit("Move the base", edits)
    assert [desk.saved.review(i).state for i in range(3)] == ["untouched", "rejected", "untouched"]
    desk.do(intents.Undo())
    assert [desk.saved.review(i).state for i in range(3)] == ["accepted", "rejected", "untouched"]


def test_what_is_said_of_a_frame_that_nobody_judged_follows_who_made_its_joints(desk: Desk) -> None:
    desk.do(intents.Perturb(2.0, 0), intents.Run())
    desk.finish()
    assert _name(desk) == "optimized" and matching_frames(desk.saved, FrameFilter(review="optimized")) == [0]
    desk.do(intents.Nudge(1.0))
    assert _name(desk) == BY_HAND and matching_frames(desk.saved, FrameFilter(review="optimized")) == []
    desk.do(intents.BackToMeasured())
    assert _name(desk) == "untouched" and desk.state.review.state is ReviewState.UNTOUCHED
    desk.do(intents.Undo(), intents.Undo())
    assert _name(desk) == "optimized"


def test_frames_that_were_solved_together_say_so_and_a_copy_says_what_it_is(desk: Desk) -> None:
    desk.do(intents.SetSetting("solver", "surface"), intents.Solve(whole=True))
    desk.finish()
    assert [_name(desk, index) for index in range(3)] == [SOLVED] * 3 and not is_copied(desk.saved, 0)
    desk.do(intents.Nudge(1.0), intents.MoveFrame(1), intents.CopyCorrection(-1))
    assert is_copied(desk.saved, 1) and _name(desk, 1) == "untouched"


def test_unreviewed_means_the_same_in_find_in_exports_and_in_next_unreviewed(desk: Desk) -> None:
    desk.do(ACCEPT, intents.ShowFrame(1), intents.Nudge(1.0))
    assert matching_frames(desk.saved, FrameFilter(review=NO_REVIEW)) == [1, 2]
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
    with pytest.raises(CartsError, match="All frames are reviewed"):
        desk.do(intents.ShowUnreviewed())


# ---- Frames that are looked for, and poses that are compared --------------------------------------------------------


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


def test_frames_are_found_by_what_is_known_of_them(known: Desk) -> None:
    for wanted, frames in (
        (FrameFilter(), [0, 1, 2]),
        (FrameFilter(review=BY_HAND), [0]),
        (FrameFilter(review="accepted"), [2]),
        (FrameFilter(fit="failed"), [1]),
        (FrameFilter(fit=NOT_CHECKED), [0, 2]),
        (FrameFilter(dice=0.9), [0, 1]),
        (FrameFilter(note="SMOKE"), [1]),
        (FrameFilter(arm="PSM1"), [0]),
        (FrameFilter(fit="failed", review="accepted"), []),
    ):
        assert matching_frames(known.saved, wanted) == frames, wanted
    known.do(intents.SetFilter("fit", NOT_CHECKED), intents.ShowFrame(0))
    assert [known.do(intents.ShowMatching(step)).index for step in (1, 1, -1)] == [2, 0, 2]


def test_all_found_frames_are_reviewed_in_one_step_and_notes_stay(known: Desk) -> None:
    steps = len(known.saved.steps)
    known.do(intents.SetFilter("fit", "failed"), intents.ReviewMatching(ReviewState.REJECTED))
    assert known.saved.review(1) == Review(ReviewState.REJECTED, "Smoke on the left")
    known.do(
        intents.ClearFilter(), intents.SetFilter("review", "accepted"), intents.ReviewMatching(ReviewState.UNTOUCHED)
    )
    assert known.saved.review(2) == Review() and len(known.saved.steps) == steps + 2
    known.do(intents.Undo())
    assert known.saved.review(2).state is ReviewState.ACCEPTED
    with pytest.raises(CartsError, match="No frame matches the filter"):
        known.do(intents.SetFilter("note", "xyz"), intents.ShowMatching())
    with pytest.raises(CartsError, match="cannot be filtered by 'colour'"):
        known.do(intents.SetFilter("colour", "red"))


def test_the_other_pose_is_seen_up_to_the_swipe_or_all_over_while_a_key_is_held(known: Desk) -> None:
    own, other = np.full((4, 10, 4), 1, np.uint8), np.full((4, 10, 4), 2, np.uint8)
    assert composed(own, other, 0.4)[0, :, 0].tolist() == [2, 2, 2, 255, 255, 1, 1, 1, 1, 1]
    assert (composed(own, other, 1.0) == 2).all()
    assert Compare().share == 0.0 and Compare(peek=True).share == 1.0
    state = known.do(intents.ShowFrame(0), intents.CompareWith(CompareMode.SWIPE), intents.SetSwipe(7.0))
    assert state.compare.share == 1.0
    assert compared_pose(ComparedPose.CURRENT, state, known.session) is state.pose.scene
    assert compared_pose(ComparedPose.BEFORE_RUN, state, known.session) is None


# ---- Verdicts -------------------------------------------------------------------------------------------------------


GOOD, DOUBTFUL = FitVerdict("good", "", "", 0.02), FitVerdict("doubtful", "In part.", "Look.", 0.2)


def test_a_fit_is_worse_by_what_the_images_say_and_by_the_truth_where_it_is_known() -> None:
    for after, before, worse in (
        (Fit(GOOD, 0.02), Fit(DOUBTFUL, 0.06), None),
        (Fit(DOUBTFUL, 0.02), Fit(GOOD, 0.06), "doubtful, before good"),
        (Fit(FitVerdict("good", "", "", 0.09), 0.02), Fit(GOOD, 0.02), "probability of failure 9%, before 2%"),
        (Fit(GOOD, 0.03), Fit(GOOD, 0.02), "loss 0.03, before 0.02"),
        (Fit(GOOD, 0.02, 0.564), Fit(DOUBTFUL, 0.06, 0.701), "Dice 0.564, before 0.701"),
        (Fit(DOUBTFUL, 0.09, 0.95), Fit(GOOD, 0.02, 0.90), None),
    ):
        assert worse_than(after, before) == worse


def test_a_verdict_is_read_with_reason_remedy_and_cameras() -> None:
    verdict = FitVerdict("failed", "Camera right: <no>", "Run again.", 0.8, (("left", 0.01), ("right", 0.8)))
    text = fit_text(verdict, running=False, scores={"left": 0.98, "right": 0.663})
    for part in (
        "<b>Mask failed</b><small>Camera right: &lt;no&gt;</small>",
        "<p>Camera right: &lt;no&gt;</p>",
        "Run again.",
        "left good Dice 0.980",
        "right failed Dice 0.663",
    ):
        assert part in text
    good = FitVerdict("good", "The image supports the fit.")
    text = fit_text(good, running=False, scores={}, undetermined=["PSM1.roll", "PSM1.wrist_yaw"])
    assert '<b>Mask good</b><small title="PSM1.roll, PSM1.wrist yaw">2 joints not determined</small>' in text
    assert "all joints determined" in fit_text(good, running=False, scores={}, undetermined=[])
    assert "not checked" in fit_text(None, running=False, scores={})


def test_losses_are_only_said_to_compare_when_they_do() -> None:
    assert "comparable only within a stage" in note(Curves(loss=(1.0,)), False)
    ended = note(Curves(loss=(1.0,), comparable=True), False)
    assert "● result" in ended and "only within a stage" not in ended
    assert "changed since" in note(Curves(loss=(1.0,), comparable=True), True)


def test_a_check_says_what_every_camera_sees_and_moves_nothing(desk: Desk) -> None:
    before = desk.joint()
    state = desk.do(intents.Assess())
    assert state.verdict is not None and [name for name, _ in state.verdict.cameras] == ["left", "right"]
    assert desk.joint() == before and state.pose.source is Source.MEASURED
    assert not desk.saved.steps and not state.unsaved and desk.saved.verdict(0) == state.verdict
    # It is of this pose alone, and a run says it anew.
    assert desk.do(intents.SetJoint("PSM1", 0, 0.1), intents.Released()).verdict is None
    desk.do(intents.Run())
    assert desk.state.verdict is None
    state = desk.finish()
    assert state.verdict is not None and state.run.curves.comparable and not state.run_outdated
    assert desk.saved.verdict(0) == state.verdict
    assert desk.do(intents.SetJoint("PSM1", 0, 0.1)).run_outdated


def test_the_attention_map_of_a_pose_says_nothing_about_a_run(desk: Desk) -> None:
    desk.do(intents.SetSetting("solver", "surface"), intents.ShowLayer(Layer.ATTENTION))
    desk.controller.map()
    assert desk.state.maps is not None and desk.state.maps.iterate.uncertainty is not None
    assert "no</span>" not in "".join(value_rows(desk.state, desk.session))


def test_the_table_of_values_shows_what_a_run_moved_and_which_joints_the_image_determines(desk: Desk) -> None:
    def table() -> str:
        return "".join(value_rows(desk.state, desk.session))

    assert ">Change</th>" in table() and ">Run</th>" not in table() and ">Image</th>" not in table()
    desk.do(intents.SetSetting("solver", "surface"), intents.Perturb(2.0, 0), intents.Run())
    state = desk.finish()
    assert state.run.start is not None
    limits = desk.session.ranges["PSM1"][0]
    before, now = (limits.to_shown(desk.session.joints(s)["PSM1"][0]) for s in (state.run.start, state.pose.scene))
    known = {arm: value.standard_deviations or () for arm, value in state.project.joints(0).items()}
    undetermined = undetermined_joints(desk.session.scene, known)
    assert undetermined is not None
    assert f"<td>{now - before:+.2f}</td>" in table() and table().count(">no</span>") == len(undetermined)
    assert table().count(">yes</span>") + len(undetermined) == sum(map(len, desk.session.ranges.values()))
    # The run is that of the shown frame alone.
    desk.do(intents.ShowFrame(1))
    assert ">Run</th>" not in table()


def test_base_frames_are_named_only_above_the_threshold() -> None:
    for gain, said in ((None, False), (BASE_FRAME_GAIN - 0.01, False), (BASE_FRAME_GAIN + 0.01, True)):
        line = calibration_line(gain)
        assert ("13 %" in line) == said and bool(line) == said


def test_frames_that_failed_or_were_fitted_to_one_camera_are_named_before_an_export(desk: Desk) -> None:
    cameras = ["left", "right"]
    desk.do(intents.ShowFrame(2), intents.SetReview(ReviewState.ACCEPTED))
    assert export_warnings(desk.saved, range(3), cameras) == ["2 of 3 frames are not accepted"]
    assert export_warnings(desk.saved, range(1, 3), cameras) == ["1 of 2 frames is not accepted"]
    assert export_warnings(desk.saved, [2], cameras) == []
    desk.do(intents.ShowFrame(0))
    desk.do(intents.SetCameras(False), intents.Step(), intents.Pause(), intents.MoveFrame(1))
    project = desk.session.editor.project
    verdicts = {1: FitVerdict("failed", "", "", 0.9), 2: FitVerdict("doubtful", "", "", 0.2)}
    project.apply("Check", {Key.verdict(index): verdict for index, verdict in verdicts.items()})
    assert export_warnings(desk.saved, range(3), cameras) == [
        "2 of 3 frames are not accepted",
        "1 of the exported frames has the verdict failed: 002",
        "1 of the exported frames has the verdict doubtful: 003",
        "1 of the exported frames was fitted to only some of the exported cameras: 001",
    ]
    assert export_warnings(desk.saved, [0], ["left"]) == ["1 of 1 frames is not accepted"]
    project.apply("Check", {Key.verdict(1): FitVerdict("doubtful", "", "", 0.2)})
    found = export_warnings(desk.saved, range(3), cameras)
    assert "2 of the exported frames have the verdict doubtful: 002, 003" in found
