"""What is said before frames are exported."""

from viewer_desk import Desk

from carts_core.project import FitVerdict, Key, ReviewState
from carts_viewer.actions import intents
from carts_viewer.actions.exchange import export_warnings


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
        "1 of these frames failed: 002",
        "1 of these frames are doubtful: 003",
        "1 of these frames were fitted to fewer cameras than are exported: 001",
    ]
    assert export_warnings(desk.saved, [0], ["left"]) == ["1 of 1 frames is not accepted"]
