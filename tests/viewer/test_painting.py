"""Painting: strokes from browsers, layers of the project, classes, prompts, and inputs of the optimizer."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from viewer_desk import Desk
from viewer_tab import decoded

from carts_core.errors import CartsError, SettingsError
from carts_core.evaluation.metrics import dice
from carts_core.model.camera import Camera
from carts_core.model.parts import part_classes
from carts_core.optimization import FrameOptimizer
from carts_core.project import IgnoreRegion, Key, MaskCorrection
from carts_core.segmentation import Prompt
from carts_viewer.actions import intents
from carts_viewer.actions.live import LiveHandler
from carts_viewer.picture.layers import (
    ADDED_COLOR,
    IGNORED_COLOR,
    REMOVED_COLOR,
    Layer,
    paint_over,
    transparent,
)
from carts_viewer.picture.strokes import (
    MAX_STROKE_POINTS,
    Painted,
    Stroke,
    Target,
    Tool,
    corrected,
    ignored,
    read_stroke,
)

CAMERA = Camera("left", 64, 48, (60.0, 60.0, 32.0, 24.0), np.eye(4))


GOOD: dict[str, Any] = {
    "number": 1,
    "frame": 2,
    "camera": "left",
    "target": "Mask",
    "erase": False,
    "polygon": False,
    "diameter": 7,
    "points": [[10.0, 12.0], [40.5, 30.5]],
}


def _read(**changes: Any) -> Stroke:
    painted = msgspec.json.decode(json.dumps({"type": "Painted", **GOOD, **changes}), type=Painted)
    return read_stroke(painted, 3, {"left": CAMERA})


def test_a_stroke_covers_the_pixels_within_its_radius_or_a_filled_polygon() -> None:
    covered = _read(points=[[20.5, 20.5]], diameter=9).covers(CAMERA)
    y, x = np.mgrid[:48, :64] + 0.5
    distance = np.hypot(x - 20.5, y - 20.5)
    assert covered[distance < 4.25].all() and not covered[distance > 4.75].any()
    for start, end in (((10.5, 12.5), (40.5, 30.5)), ((10.0, 12.0), (40.2, 12.0)), ((20.7, 40.0), (20.7, 9.3))):
        covered, along = _read(points=[start, end]).covers(CAMERA), np.subtract(end, start)
        share = np.clip(((x - start[0]) * along[0] + (y - start[1]) * along[1]) / (along @ along), 0, 1)
        distance = np.hypot(x - start[0] - share * along[0], y - start[1] - share * along[1])
        assert covered[distance < 3.25].all() and not covered[distance > 3.75].any()
    covered = _read(polygon=True, points=[[10, 10], [50, 10], [50, 40], [10, 40]], diameter=200).covers(CAMERA)
    assert covered[11:39, 11:49].all() and covered.sum() <= 41 * 31


@pytest.mark.parametrize("start", [(-4.0, -10.0), (68.0, -10.0), (-10.0, -5.0), (-10.0, 53.0)])
def test_a_stroke_beside_the_image_covers_the_border_within_its_radius(start: tuple[float, float]) -> None:
    end = (start[0], 60.0) if start[1] == -10.0 else (80.0, start[1])
    covered = _read(points=[start, end], diameter=15).covers(CAMERA)
    y, x = np.mgrid[:48, :64] + 0.5
    distance = np.abs(x - start[0]) if end[0] == start[0] else np.abs(y - start[1])
    assert covered.shape == (48, 64) and (distance < 7.25).any()
    assert covered[distance < 7.25].all() and not covered[distance > 7.75].any()


def test_points_far_outside_and_brushes_too_thick_are_clamped() -> None:
    stroke = _read(points=[[-1e9, 20], [1e300, 20]], diameter=1e9)
    assert stroke.points.tolist() == [[-64, 20], [128, 20]] and stroke.diameter == 300
    assert stroke.covers(CAMERA).all()


def test_what_no_page_would_send_is_refused() -> None:
    far = [[1, 2]] * (MAX_STROKE_POINTS + 1)
    for name, values in (
        ("points", ([[float("nan"), 1.0]], [[1.0, float("inf")]], [], far, [[10**400, 1]])),
        ("points", ([[1, 2, 3]], [[1, 2], [3]], [None], {"0": [1, 2]})),
        ("diameter", (-3, float("nan"), "5")),
        ("frame", (3, -1, 1.5, True)),
        ("number", (None,)),
        ("camera", ("../left", ["left"])),
        ("target", ("Review",)),
        ("polygon", (True,)),
    ):
        for value in values:
            with pytest.raises((SettingsError, msgspec.DecodeError)):
                _read(**{name: value})


def test_a_later_stroke_wins_and_what_is_rendered_needs_no_adding() -> None:
    rendered, stroke = np.zeros((4, 6), bool), np.zeros((4, 6), bool)
    rendered[:, :3], stroke[1] = True, True
    added = corrected(None, stroke, rendered, erase=False)
    assert added is not None and not added.removed().any()
    assert np.array_equal(added.added(), stroke & ~rendered)
    # Erasing the same takes the addition back and the rendered part out.
    removed = corrected(added, stroke, rendered, erase=True)
    assert removed is not None and not removed.added().any()
    assert np.array_equal(removed.removed(), stroke & rendered)
    assert np.array_equal(removed.applied_to(rendered), rendered & ~stroke)
    # And painting it again leaves the rendered mask with the addition.
    again = corrected(removed, stroke, rendered, erase=False)
    assert again is not None and np.array_equal(again.applied_to(rendered), rendered | stroke)
    # A layer of which nothing is left is removed.
    assert corrected(corrected(None, ~rendered, rendered, erase=False), ~rendered, rendered, erase=True) is None
    assert ignored(ignored(None, stroke, erase=False), stroke, erase=True) is None


def test_painted_pixels_are_seen_in_their_colours() -> None:
    added, removed, region = np.zeros((3, 40, 60), bool)
    added[:20, :20], removed[:20, 20:40], region[25:38, 10:50] = True, True, True
    picture = transparent(40, 60)
    paint_over(picture, MaskCorrection.of(added, removed), IgnoreRegion.of(region), 0.5)
    assert (picture[added] == (*ADDED_COLOR, 128)).all() and (picture[removed] == (*REMOVED_COLOR, 128)).all()
    hatched = picture[region][:, 3] > 0
    assert 0.3 < hatched.mean() < 0.9 and (picture[region][hatched][:, :3] == IGNORED_COLOR).all()
    rest = ~(added | removed | region)
    assert not picture[rest].any()


# ---- Layers of the project ------------------------------------------------------------------------------------------


CORNERS = ((5.0, 5.0), (60.0, 5.0), (60.0, 40.0), (5.0, 40.0))


def _polygon(
    target: Target, *, erase: bool = False, frame: int = 0, camera: str = "left", number: int = 1, label: int = 0
) -> intents.Paint:
    return intents.Paint(7, Stroke(number, frame, camera, target, erase, True, 1, np.array(CORNERS), label))


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
    # A stroke that changes nothing is no step, but it is answered.
    desk.do(_polygon(Target.IGNORE, erase=True, number=4))
    assert not desk.saved.position and desk.state.brush.painted == {7: 4}


def test_a_stroke_during_a_stream_is_refused_and_answered(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LiveHandler, "active", True)
    with pytest.raises(CartsError, match="cannot be edited"):
        desk.do(_polygon(Target.MASK, number=5))
    assert not desk.saved.steps and desk.state.brush.painted == {7: 5}


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


def test_the_optimizer_is_given_the_ignore_region_of_its_cameras(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    make = FrameOptimizer.__init__

    def watched(self: FrameOptimizer, *arguments: Any, **options: Any) -> None:
        given.append(options["ignore"])
        make(self, *arguments, **options)

    monkeypatch.setattr(FrameOptimizer, "__init__", watched)
    desk.do(intents.SetCameras(False))
    desk.do(_polygon(Target.IGNORE), _polygon(Target.IGNORE, frame=1, number=2), intents.Step())
    assert list(given[-1]) == ["left"] and np.array_equal(given[-1]["left"], _pixels(desk))
    desk.do(intents.ShowCamera("right"), intents.Step())
    assert given[-1] == {}
    desk.do(intents.SetCameras(True), intents.Step())
    assert list(given[-1]) == ["left"]


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


def test_the_brush_grows_and_shrinks_within_its_limits(desk: Desk) -> None:
    assert desk.do(intents.ToggleTool(Tool.BRUSH)).brush.tool is Tool.BRUSH
    assert desk.do(intents.ToggleTool(Tool.BRUSH)).brush.tool is Tool.SELECT
    assert desk.do(intents.SetDiameter(1e9)).brush.diameter == 300
    assert desk.do(intents.SetDiameter(-5.0)).brush.diameter == 1
    sizes = [desk.do(intents.ScaleBrush(1.25)).brush.diameter for _ in range(40)]
    assert sizes[:3] == [2, 3, 4] and sizes[-1] == 300
    assert [desk.do(intents.ScaleBrush(0.8)).brush.diameter for _ in range(40)][-1] == 1
    assert desk.do(intents.SetTarget()).brush.target is Target.IGNORE
    assert desk.do(intents.SetTarget()).brush.target is Target.MASK


# ---- Classes --------------------------------------------------------------------------------------------------------


def _labels(desk: Desk) -> np.ndarray:
    found = desk.saved.get(Key.part_labels(0, "left"))
    return np.zeros(desk.state.frame.images["left"].shape[:2], np.uint8) if found is None else found.labels()


def test_a_painted_class_is_part_of_the_mask_and_one_step_of_undo(desk: Desk) -> None:
    jaws = next(one for one in part_classes(desk.session.scene.arms) if one.part == "jaws")
    covered = _pixels(desk)
    with pytest.raises(CartsError, match="Unknown class 99"):
        desk.do(intents.SetPaintClass(99))
    desk.do(intents.SetPaintClass(jaws.number))
    assert desk.state.layer is Layer.PARTS and desk.state.brush.label == jaws.number
    desk.do(_polygon(Target.MASK, number=1, label=jaws.number))
    assert [step.name for step in desk.saved.steps] == ["Paint PSM1 jaws, frame 001"]
    np.testing.assert_array_equal(_labels(desk) == jaws.number, covered)
    shown = desk.renderer.classes(
        desk.state.pose.scene, "left", desk.state.mask_correction, desk.state.part_labels_of("left")
    )
    assert (shown[covered] == jaws.number).all()
    assert desk.renderer.mask(desk.state.pose.scene, "left", desk.state.mask_correction)[covered].all()
    desk.do(intents.Export("masks", "All", "parts", False, True))
    exported = desk.finish().export
    assert exported is not None and exported.path is not None
    meaning = json.loads((exported.path / "labels.json").read_text())["parts"]
    value = next(int(key) for key, name in meaning.items() if name == "PSM1.jaws")
    assert (decoded((exported.path / "parts" / "left_001.png").read_bytes())[covered] == value).all()
    # A stroke without a class leaves the class alone, one that erases takes both out.
    desk.do(_polygon(Target.MASK, number=2))
    assert (_labels(desk)[covered] == jaws.number).all() and desk.saved.position == 1
    desk.do(_polygon(Target.MASK, number=3, erase=True))
    assert not _labels(desk).any() and desk.saved.position == 2
    desk.do(intents.Undo())
    assert (_labels(desk)[covered] == jaws.number).all()
    desk.do(intents.Undo())
    assert not _labels(desk).any() and desk.state.mask_correction is None


def test_the_layer_of_parts_shows_what_the_links_of_the_robot_say(desk: Desk) -> None:
    rendered = desk.renderer.arm_ids(desk.state.pose.scene, "left")
    classes = desk.renderer.classes(desk.state.pose.scene, "left", None, None)
    np.testing.assert_array_equal(classes > 0, rendered >= 0)
    assert set(np.unique(classes)) == {0, *(one.number for one in part_classes(desk.session.scene.arms))}


# ---- Prompts --------------------------------------------------------------------------------------------------------


RADIUS = 9.0


class Discs:
    """A plug-in: discs around the points, without those around the points beside it; or the box."""

    def __init__(self) -> None:
        self.asked: list[Prompt] = []

    def segment(self, image: np.ndarray, prompt: Prompt) -> np.ndarray:
        self.asked.append(prompt)
        rows, columns = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
        mask = np.zeros(image.shape[:2], bool)
        if prompt.box is not None:
            left, top, right, low = prompt.box
            mask |= (columns > left) & (columns < right) & (rows > top) & (rows < low)
        for u, v in prompt.inside:
            mask |= np.hypot(columns - u, rows - v) < RADIUS
        for u, v in prompt.outside:
            mask &= np.hypot(columns - u, rows - v) >= RADIUS
        return mask


@pytest.fixture
def discs() -> Discs:
    return Discs()


@pytest.fixture
def prompted(tiny_sequence: Callable[..., Path], untrained_weights: Path, discs: Discs) -> Desk:
    """A desk whose segmenter is a plug-in."""
    return Desk.open(tiny_sequence(frames=2), weights=(untrained_weights,), segmenter=discs)


def _ignored(desk: Desk) -> np.ndarray:
    region = _region(desk)
    return np.zeros(desk.state.frame.images["left"].shape[:2], bool) if region is None else region.region()


def _point(number: int, *points: tuple[float, float], erase: bool = False) -> intents.Paint:
    stroke = Stroke(number, 0, "left", Target.IGNORE, erase, False, 1, np.array(points), prompt=True)
    return intents.Paint(7, stroke)


def test_clicks_are_about_one_thing_until_it_is_finished_and_each_is_a_step(prompted: Desk, discs: Discs) -> None:
    prompted.do(_point(1, (20.0, 20.0)))
    first = _ignored(prompted)
    prompted.do(_point(2, (34.0, 20.0)))
    prompted.do(_point(3, (20.0, 12.0), erase=True))
    assert discs.asked[-1] == Prompt(inside=((20.0, 20.0), (34.0, 20.0)), outside=((20.0, 12.0),))
    assert not _ignored(prompted)[12, 20] and _ignored(prompted)[24, 20] and _ignored(prompted)[20, 34]
    assert [step.name for step in prompted.saved.steps] == ["Segment with a prompt, frame 001"] * 3
    # The next one begins anew and adds to what is there.
    before = _ignored(prompted)
    prompted.do(intents.NextObject(), _point(4, (50.0, 40.0)))
    assert discs.asked[-1] == Prompt(inside=((50.0, 40.0),))
    assert (_ignored(prompted) & before).sum() == before.sum() < _ignored(prompted).sum()
    for _ in range(3):
        prompted.do(intents.Undo())
    np.testing.assert_array_equal(_ignored(prompted), first)
    # After undo, a click is about something new.
    prompted.do(_point(5, (40.0, 30.0)))
    assert discs.asked[-1] == Prompt(inside=((40.0, 30.0),))


def test_shift_on_something_new_takes_it_away_and_a_box_adds(prompted: Desk, discs: Discs) -> None:
    prompted.do(_point(1, (50.0, 40.0), (10.0, 10.0)))
    assert discs.asked[-1] == Prompt(box=(10.0, 10.0, 50.0, 40.0))
    assert _ignored(prompted).sum() == 40 * 30
    prompted.do(intents.NextObject(), _point(2, (30.0, 25.0), erase=True))
    assert not _ignored(prompted)[25, 30] and _ignored(prompted)[12, 12]


def test_in_a_box_the_mask_becomes_what_is_segmented_whatever_is_rendered(prompted: Desk, discs: Discs) -> None:
    rendered = prompted.renderer.mask(prompted.state.pose.scene, "left")
    height, width = rendered.shape
    corners = np.array([[0.0, 0.0], [float(width), float(height)]])
    wanted = np.zeros_like(rendered)
    wanted[5:15, 5:15] = True
    discs.segment = lambda image, prompt: wanted  # type: ignore[method-assign]
    prompted.do(intents.Paint(7, Stroke(1, 0, "left", Target.MASK, False, False, 1, corners, prompt=True)))
    mask = prompted.renderer.mask(prompted.state.pose.scene, "left", prompted.state.mask_correction)
    assert rendered.any()
    np.testing.assert_array_equal(mask, wanted)


def test_a_mask_and_its_class_come_from_one_prompt(prompted: Desk) -> None:
    stroke = Stroke(1, 0, "left", Target.MASK, False, False, 1, np.array([[20.0, 20.0]]), 3, prompt=True)
    prompted.do(intents.Paint(7, stroke))
    labels = prompted.saved.get(Key.part_labels(0, "left"))
    disc = Discs().segment(prompted.state.frame.images["left"], Prompt(inside=((20.0, 20.0),)))
    assert labels is not None and (labels.labels() == 3).sum() == disc.sum()
    assert prompted.renderer.mask(prompted.state.pose.scene, "left", prompted.state.mask_correction)[20, 20]
    prompted.do(intents.Undo())
    assert prompted.saved.get(Key.part_labels(0, "left")) is None and prompted.state.mask_correction is None


def test_the_shipped_network_segments_the_arm_under_a_click_and_in_a_box(tiny_sequence: Callable[..., Path]) -> None:
    desk = Desk.open(tiny_sequence(frames=1, width=640, height=480))
    assert desk.state.frame.masks is not None
    truth = desk.state.frame.masks["left"]
    rows, columns = np.nonzero(truth)
    middle = int(np.median(np.arange(len(rows))))
    desk.do(_point(1, (columns[middle] + 0.5, rows[middle] + 0.5)))
    assert dice(_ignored(desk), truth) > 0.8
    desk.do(intents.Undo(), _point(2, (600.0, 440.0), (40.0, 40.0)))
    inside = np.zeros_like(truth)
    inside[40:440, 40:600] = True
    assert dice(_ignored(desk), truth & inside) > 0.8
