"""What painting does: layers in the project, steps of undo, corrected masks, and what the optimizer is given."""

from typing import Any

import cv2
import numpy as np
import pytest
from viewer_desk import Desk

from carts_core.evaluation.evaluate import dice
from carts_core.optimization import SurfaceSolver
from carts_core.project import IgnoreRegion, Key, MaskCorrection
from carts_viewer.actions import intents
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.picture.strokes import Stroke, Target, Tool

CORNERS = ((5.0, 5.0), (60.0, 5.0), (60.0, 40.0), (5.0, 40.0))


def _polygon(target: Target, *, erase: bool = False, frame: int = 0, camera: str = "left", number: int = 1) -> Any:
    return intents.Paint(7, Stroke(number, frame, camera, target, erase, True, 1, np.array(CORNERS)))


def _pixels(desk: Desk) -> np.ndarray:
    return _polygon(Target.MASK).stroke.covers(desk.session.scene.camera("left"))


def _correction(desk: Desk, frame: int = 0, camera: str = "left") -> MaskCorrection | None:
    return desk.saved.get(Key.mask_correction(frame, camera))


def _region(desk: Desk, frame: int = 0, camera: str = "left") -> IgnoreRegion | None:
    return desk.saved.get(Key.ignore_region(frame, camera))


def test_each_stroke_is_saved_at_once_as_one_step_that_undo_takes_back(desk: Desk) -> None:
    desk.do(_polygon(Target.MASK), _polygon(Target.IGNORE, number=2), _polygon(Target.IGNORE, erase=True, number=3))
    assert [step.name for step in desk.saved.steps] == [
        "Add to the mask, frame 001",
        "Ignore pixels, frame 001",
        "Ignore fewer pixels, frame 001",
    ]
    assert not desk.state.unsaved and _region(desk) is None and desk.state.brush.painted == {7: 3}
    desk.do(intents.Undo())
    region = _region(desk)
    assert region is not None and np.array_equal(region.region(), _pixels(desk)) and desk.state.ignore_region == region
    desk.do(intents.Undo(), intents.Undo())
    assert _region(desk) is None and _correction(desk) is None and desk.state.mask_correction is None
    desk.do(intents.Redo())
    assert _correction(desk) is not None


def test_a_stroke_that_changes_nothing_is_no_step_but_is_answered(desk: Desk) -> None:
    desk.do(_polygon(Target.IGNORE, erase=True, number=4))
    assert not desk.saved.steps and desk.state.brush.painted == {7: 4}


def test_a_stroke_stays_with_the_frame_and_camera_that_it_was_drawn_over(desk: Desk) -> None:
    desk.do(intents.ShowFrame(2), _polygon(Target.MASK, frame=1, camera="right"))
    assert desk.state.index == 2 and desk.state.camera == "left" and desk.state.mask_correction is None
    assert _correction(desk, 1, "right") is not None and _correction(desk, 2) is None
    assert desk.saved.steps[0].name == "Add to the mask, frame 002"
    rendered = desk.renderer.mask(desk.session.pose(desk.session.frame(1, "regular", "right")).scene, "right")
    correction = _correction(desk, 1, "right")
    assert correction is not None and np.array_equal(correction.added(), _pixels(desk) & ~rendered)


def test_dice_is_that_of_the_corrected_mask(desk: Desk) -> None:
    desk.controller.score()
    before = desk.state.scores
    desk.do(_polygon(Target.MASK))
    desk.controller.score()
    scores, masks = desk.state.scores, desk.state.frame.masks
    assert before is not None and scores is not None and masks is not None
    corrected = desk.renderer.mask(desk.state.pose.scene, "left") | _pixels(desk)
    assert scores.dice == pytest.approx(dice(corrected, masks["left"])) and scores.dice != before.dice
    figures = desk.saved.figures(0)
    assert figures is not None and figures.dice == scores.dice
    desk.do(intents.Undo())
    desk.controller.score()
    assert desk.state.scores == before


def test_a_corrected_mask_keeps_the_optimizers_loss_and_an_ignore_region_does_not(desk: Desk) -> None:
    desk.do(intents.Run())
    desk.finish()
    loss = desk.saved.figures(0)
    desk.do(_polygon(Target.MASK))
    after = desk.saved.figures(0)
    assert loss is not None and after is not None and after.loss == loss.loss is not None
    desk.do(_polygon(Target.IGNORE, number=2))
    after = desk.saved.figures(0)
    assert after is not None and after.loss is None and after.dice is not None


def test_exports_hold_the_corrected_mask(desk: Desk) -> None:
    desk.do(_polygon(Target.MASK), _polygon(Target.MASK, erase=True, frame=1, number=2), intents.ExportMask(3))
    wanted = desk.renderer.mask(desk.state.pose.scene, "left") | _pixels(desk)
    assert np.array_equal(_image(desk.delivered[-1][2]), wanted)
    desk.do(intents.Export("masks", "All", "arms", False, False))
    export = desk.finish().export
    assert export is not None and export.path is not None
    found = {path.stem: _image(path.read_bytes()) for path in (export.path / "binary").iterdir()}
    assert np.array_equal(found["left_001"], wanted)
    rendered = desk.renderer.mask(desk.session.pose(desk.session.frame(1, "regular", "left")).scene, "left")
    assert np.array_equal(found["left_002"], rendered & ~_pixels(desk))
    # The other camera's masks are as rendered.
    assert np.array_equal(found["right_001"], desk.renderer.mask(desk.state.pose.scene, "right"))


def _image(png: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image > 0


def test_the_optimizer_is_given_the_ignore_region_of_its_cameras(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    make = OptimizerFactory.make

    def watched(self: OptimizerFactory, *arguments: Any) -> Any:
        given.append(arguments[-1].ignore)
        return make(self, *arguments)

    monkeypatch.setattr(OptimizerFactory, "make", watched)
    desk.do(intents.SetCameras(False))
    desk.do(_polygon(Target.IGNORE), _polygon(Target.IGNORE, frame=1, number=2), intents.Step())
    assert list(given[-1]) == ["left"] and np.array_equal(given[-1]["left"], _pixels(desk))
    desk.do(intents.ShowCamera("right"), intents.Step())
    assert given[-1] == {}
    desk.do(intents.SetCameras(True), intents.Step())
    assert list(given[-1]) == ["left"]


def test_ignored_pixels_change_the_surface_loss(desk: Desk) -> None:
    for name, value in {"solver": "surface", "iterations": 2, "working_width": 96}.items():
        desk.do(intents.SetSetting(name, value))
    assert desk.state.settings == SurfaceSolver(iterations=2, working_width=96)
    desk.do(intents.Step())
    loss = desk.state.run.curves.loss[0]
    desk.do(intents.Reset(), _polygon(Target.IGNORE), intents.Step())
    assert desk.state.run.curves.loss[0] != loss


def test_painting_ends_a_run_and_keeps_what_it_reached(desk: Desk) -> None:
    desk.do(intents.Run())
    desk.advance()
    desk.advance()
    desk.do(_polygon(Target.IGNORE))
    assert [step.name.split(",")[0] for step in desk.saved.steps] == ["Optimize", "Ignore pixels"]
    assert "painted" in (desk.state.run.reason or "")


def test_clearing_is_one_step_and_touches_one_layer_of_one_frame(desk: Desk) -> None:
    desk.do(_polygon(Target.MASK), _polygon(Target.IGNORE, number=2), _polygon(Target.IGNORE, frame=1, number=3))
    desk.do(intents.SetTarget(Target.IGNORE), intents.ClearLayer())
    assert _region(desk) is None and _correction(desk) is not None and _region(desk, 1) is not None
    assert desk.saved.steps[-1].name == "Clear the ignore region, frame 001"
    desk.do(intents.ClearLayer())
    assert len(desk.saved.steps) == 4
    desk.do(intents.ClearLayer(Target.MASK))
    assert _correction(desk) is None


def test_painted_layers_survive_a_restart(desk: Desk) -> None:
    desk.do(_polygon(Target.MASK))
    before = _correction(desk)
    again = desk.reopened()
    assert again.state.mask_correction == before is not None
    assert np.array_equal(again.do(intents.Undo()).project.position, 0) and again.state.mask_correction is None


def test_the_brush_grows_and_shrinks_within_its_limits(desk: Desk) -> None:
    assert desk.do(intents.ToggleTool(Tool.BRUSH)).brush.tool is Tool.BRUSH
    assert desk.do(intents.ToggleTool(Tool.BRUSH)).brush.tool is Tool.OFF
    assert desk.do(intents.SetDiameter(1e9)).brush.diameter == 300
    assert desk.do(intents.SetDiameter(-5.0)).brush.diameter == 1
    sizes = [desk.do(intents.ScaleBrush(1.25)).brush.diameter for _ in range(40)]
    assert sizes[:3] == [2, 3, 4] and sizes[-1] == 300
    assert [desk.do(intents.ScaleBrush(0.8)).brush.diameter for _ in range(40)][-1] == 1
    assert desk.do(intents.SetTarget()).brush.target is Target.IGNORE
    assert desk.do(intents.SetTarget()).brush.target is Target.MASK


def test_a_project_that_takes_no_edits_shows_strokes_until_another_frame_is(desk: Desk) -> None:
    reader = desk.reopened(read_only=True)
    reader.do(_polygon(Target.IGNORE))
    assert reader.state.ignore_region is not None and not reader.saved.steps
    reader.do(intents.MoveFrame(1), intents.MoveFrame(-1))
    assert reader.state.ignore_region is None
