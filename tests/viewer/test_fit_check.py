"""Whether a solved frame is worse than it was, and what people read of a verdict."""

import pytest
from viewer_desk import Desk

from carts_core.project import Figures, FitVerdict, ReviewState, Source, by_hand
from carts_viewer.actions import intents
from carts_viewer.jobs.comparison import Fit
from carts_viewer.panels.fit import fit_text
from carts_viewer.panels.optimize import note, undetermined_lines
from carts_viewer.picture.layers import Layer
from carts_viewer.state import Curves

GOOD, DOUBTFUL = FitVerdict("good", "", "", 0.02), FitVerdict("doubtful", "In part.", "Look.", 0.2)


@pytest.mark.parametrize(
    ("after", "before", "worse"),
    [
        (Fit(GOOD, 0.02), Fit(DOUBTFUL, 0.06), None),
        (Fit(DOUBTFUL, 0.02), Fit(GOOD, 0.06), "doubtful, was good"),
        (Fit(FitVerdict("good", "", "", 0.09), 0.02), Fit(GOOD, 0.02), "probably wrong by 9%, was 2%"),
        (Fit(GOOD, 0.03), Fit(GOOD, 0.02), "loss 0.03, was 0.02"),
        (Fit(GOOD, 0.02, 0.564), Fit(DOUBTFUL, 0.06, 0.701), "Dice 0.564, was 0.701"),
        (Fit(DOUBTFUL, 0.09, 0.95), Fit(GOOD, 0.02, 0.90), None),
    ],
)
def test_a_fit_is_worse_by_what_the_images_say_and_by_the_truth_where_it_is_known(
    after: Fit, before: Fit, worse: str | None
) -> None:
    assert after.worse_than(before) == worse


def test_a_verdict_is_read_with_reason_remedy_and_cameras() -> None:
    verdict = FitVerdict("failed", "Camera right: <no>", "Run again.", 0.8, (("left", 0.01), ("right", 0.8)))
    text = fit_text(verdict, running=False, scores={"left": 0.98, "right": 0.663})
    for part in (
        "<b>Mask failed</b><br>Camera right: &lt;no&gt;",
        "Run again.",
        "left good Dice 0.980",
        "right failed Dice 0.663",
    ):
        assert part in text
    good = FitVerdict("good", "The image supports the fit.")
    text = fit_text(good, running=False, scores={}, undetermined=["PSM1.roll", "PSM1.wrist_yaw"])
    assert '<b>Mask good</b>, <b title="PSM1.roll, PSM1.wrist yaw">2 joints not determined</b>' in text
    assert "all joints determined" in fit_text(good, running=False, scores={}, undetermined=[])
    assert "not checked" in fit_text(None, running=False, scores={})


def test_losses_are_only_said_to_compare_when_they_do() -> None:
    assert "only compare within a stage" in note(Curves(loss=(1.0,)), False)
    ended = note(Curves(loss=(1.0,), comparable=True), False)
    assert "● the result" in ended and "only compare" not in ended
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


def test_two_cameras_are_both_used_unless_somebody_says_otherwise(desk: Desk) -> None:
    state = desk.do(intents.Step())
    assert state.maps is not None and state.maps.cameras == ("left", "right")


def test_the_attention_map_of_a_pose_says_nothing_about_a_run(desk: Desk) -> None:
    desk.do(intents.SetSetting("solver", "surface"), intents.ShowLayer(Layer.ATTENTION))
    desk.controller.map()
    assert desk.state.maps is not None and desk.state.maps.iterate.uncertainty is not None
    assert undetermined_lines(desk.state, desk.session) == ""


def test_the_worst_frame_is_shown_to_whoever_asks_from_any_other(desk: Desk) -> None:
    project = desk.session.editor.project
    project.record_figures({index: Figures(dice=dice) for index, dice in enumerate((0.9, 0.5, 0.7))}, project.state)
    desk.do(intents.Refresh(), intents.ShowFrame(2))
    assert [desk.do(intents.ShowWorse()).index for _ in range(3)] == [1, 2, 0]


def test_a_frame_that_was_moved_by_hand_is_not_untouched(desk: Desk) -> None:
    desk.do(intents.SetJoint("PSM1", 0, 0.1), intents.Released())
    assert by_hand(desk.saved, 0) and not by_hand(desk.saved, 1)
    desk.do(intents.SetReview(ReviewState.ACCEPTED))
    assert not by_hand(desk.saved, 0)
