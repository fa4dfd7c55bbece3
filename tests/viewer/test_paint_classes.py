"""Parts of instruments as classes: painted, undone, shown in a layer of their own, and exported."""

import json
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from playwright.sync_api import expect
from test_paint_page import Hand
from viewer_canvas import eventually
from viewer_desk import Desk
from viewer_tab import Tab

from carts_core.errors import CartsError
from carts_core.model.parts import part_classes
from carts_core.project import Key
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.picture.layers import Layer, label_color
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.picture.strokes import Stroke, Target, Tool

CORNERS = ((5.0, 5.0), (60.0, 5.0), (60.0, 40.0), (5.0, 40.0))


def _paint(number: int, label: int, *, erase: bool = False) -> intents.Paint:
    return intents.Paint(7, Stroke(number, 0, "left", Target.MASK, erase, True, 1, np.array(CORNERS), label))


def _labels(desk: Desk) -> np.ndarray:
    found = desk.saved.get(Key.part_labels(0, "left"))
    return np.zeros(desk.state.frame.images["left"].shape[:2], np.uint8) if found is None else found.labels()


def test_a_painted_class_is_part_of_the_mask_and_one_step_of_undo(desk: Desk) -> None:
    jaws = next(one for one in part_classes(desk.session.scene.arms) if one.part == "jaws")
    covered = _paint(1, 0).stroke.covers(desk.session.scene.camera("left"))
    desk.do(intents.SetPaintClass(jaws.number))
    assert desk.state.layer is Layer.PARTS and desk.state.brush.label == jaws.number
    desk.do(_paint(1, jaws.number))
    assert [step.name for step in desk.saved.steps] == ["Paint PSM1 jaws, frame 001"]
    np.testing.assert_array_equal(_labels(desk) == jaws.number, covered)
    shown = desk.renderer.classes(
        desk.state.pose.scene, "left", desk.state.mask_correction, desk.state.part_labels_of("left")
    )
    assert (shown[covered] == jaws.number).all()
    assert desk.renderer.mask(desk.state.pose.scene, "left", desk.state.mask_correction)[covered].all()
    # A stroke without a class leaves the class alone, one that erases takes both out.
    desk.do(_paint(2, 0))
    assert (_labels(desk)[covered] == jaws.number).all() and desk.saved.position == 1
    desk.do(_paint(3, 0, erase=True))
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


def test_a_class_that_does_not_exist_is_refused(desk: Desk) -> None:
    with pytest.raises(CartsError, match="no class 99"):
        desk.do(intents.SetPaintClass(99))


def test_what_was_painted_as_a_class_is_exported_as_that_part(desk: Desk) -> None:
    jaws = next(one for one in part_classes(desk.session.scene.arms) if one.part == "jaws")
    desk.do(_paint(1, jaws.number), intents.Export("masks", "All", "parts", False, True))
    exported = desk.finish().export
    assert exported is not None and exported.path is not None
    meaning = json.loads((exported.path / "labels.json").read_text())["parts"]
    value = next(int(key) for key, name in meaning.items() if name == "PSM1.jaws")
    image = cv2.imread(str(sorted((exported.path / "parts").iterdir())[0]), cv2.IMREAD_UNCHANGED)
    covered = _paint(1, 0).stroke.covers(desk.session.scene.camera("left"))
    assert image is not None and (image[covered] == value).all()


@pytest.mark.browser
def test_a_class_is_chosen_painted_and_seen_in_the_page(
    open_marked: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_marked()
    tab = open_tab(app)
    tab.page.get_by_text("Paint", exact=True).click()
    wrist = next(one for one in part_classes(app.scene.arms) if one.part == "wrist")
    tab.choose("Class", wrist.name)
    eventually(lambda: tab.state.layer, lambda layer: layer is Layer.PARTS)
    for one in part_classes(app.scene.arms):
        expect(tab.page.locator(".carts-legend").get_by_text(one.name, exact=True)).to_be_visible()
    hand = Hand(tab)
    hand.take("Shift+B", Tool.BRUSH)
    hand.holds(label=wrist.number)
    before = _coloured(tab.canvas.screenshot(), label_color(wrist.number))
    hand.draw((30.0, 30.0), (30.0, 120.0))
    hand.steps(1)
    found = app.project.state.get(Key.part_labels(0, "left"))
    assert found is not None and (found.labels() == wrist.number).sum() > 1500
    eventually(
        lambda: _coloured(tab.canvas.screenshot(), label_color(wrist.number)), lambda count: count > before + 2000
    )
    assert OverlayRenderer(app.sequence).classes(tab.state.pose.scene, "left", None, found)[75, 30] == wrist.number
    tab.page.keyboard.press("Control+z")
    eventually(lambda: app.project.state.get(Key.part_labels(0, "left")), lambda layer: layer is None)


def _coloured(image: np.ndarray, color: tuple[int, int, int]) -> int:
    return int((np.linalg.norm(image.astype(float) - color, axis=-1) < 30).sum())
