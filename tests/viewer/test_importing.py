"""Masks and keypoints of others in an open project: brought in, shown, compared with, undone."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from viewer_canvas import eventually
from viewer_desk import Desk
from viewer_tab import Tab

from carts_core.errors import CartsError
from carts_core.evaluation.evaluate import dice
from carts_core.project import Key, MaskCorrection, Project
from carts_core.recording import Sequence
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.editing import People
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.picture.layers import Layer, imported, label_color
from carts_viewer.picture.overlay import with_imported
from carts_viewer.session import Session


@pytest.fixture
def plain(tiny_sequence: Callable[..., Path], untrained_weights: Path) -> Desk:
    """A desk for a recording without masks of its own."""
    sequence = Sequence.open(tiny_sequence(frames=3, masks=False))
    factory = OptimizerFactory(weights=(untrained_weights,), report=lambda line: None)
    return Desk(sequence, Project.open(sequence), factory)


def write_theirs(folder: Path, frames: tuple[int, ...] = (1, 2)) -> np.ndarray:
    """A COCO file of others beside the recording, with a rectangle and a keypoint in some frames; gives the mask."""
    images = [{"id": n, "file_name": f"{n:03d}.png", "width": 96, "height": 72} for n in frames]
    square = [[30, 20, 60, 20, 60, 50, 30, 50]]
    marked = [
        {"id": n, "image_id": n, "category_id": 1, "segmentation": square, "keypoints": [40.0, 30.0, 2]} for n in frames
    ]
    categories = [{"id": 1, "name": "grasper", "keypoints": ["tip"]}]
    content = {"images": images, "annotations": marked, "categories": categories}
    (folder / "theirs.json").write_text(json.dumps(content))
    mask = np.zeros((72, 96), bool)
    mask[20:50, 30:60] = True
    return mask


def bring_in(desk: Desk, **options) -> np.ndarray:
    mask = write_theirs(desk.session.sequence.path.parent)
    desk.do(intents.ImportMasks("theirs.json", **options))
    return mask


def test_an_import_is_one_step_shown_at_once_and_undone(plain: Desk) -> None:
    bring_in(plain)
    assert plain.state.layer is Layer.IMPORTED and plain.state.imported.startswith("Imported 2 masks and keypoints")
    assert [step.name for step in plain.saved.steps] == ["Import from theirs.json"]
    layer = plain.saved.get(Key.imported_mask(0, "left"))
    assert layer is not None and layer.mask().sum() == 900
    plain.do(intents.Undo())
    assert plain.saved.get(Key.imported_mask(0, "left")) is None
    plain.do(intents.Redo())
    assert plain.reopened().saved.get(Key.imported_mask(1, "left")) is not None


def test_without_masks_of_its_own_a_recording_is_compared_with_the_imported_ones(plain: Desk) -> None:
    plain.controller.score()
    assert plain.state.scores is not None and plain.state.scores.dice is None
    mask = bring_in(plain)
    plain.controller.score()
    rendered = plain.renderer.mask(plain.state.pose.scene, "left")
    assert plain.state.scores.dice == pytest.approx(dice(rendered, mask))
    figures = plain.saved.figures(0)
    assert figures is not None and figures.dice == plain.state.scores.dice
    plain.do(intents.Undo())
    plain.controller.score()
    assert plain.state.scores.dice is None


def test_masks_of_the_recording_itself_stay_the_truth(desk: Desk) -> None:
    before = desk.session.frame(0, "regular", "left")
    bring_in(desk, camera="left")
    after = with_imported(before, desk.session.scene, desk.session.editor.view)
    assert before.masks is not None and after.masks is not None
    assert np.array_equal(after.masks["left"], before.masks["left"])


def test_an_import_replaces_neither_what_was_painted_nor_silently_what_was_imported(plain: Desk) -> None:
    painted = MaskCorrection.of(np.eye(72, 96, dtype=bool), np.zeros((72, 96), bool))
    plain.session.editor.project.apply("Paint", {Key.mask_correction(0, "left"): painted})
    bring_in(plain)
    folder = plain.session.sequence.path.parent
    (folder / "others").mkdir()
    cv2.imwrite(str(folder / "others" / "001.png"), np.full((72, 96), 255, np.uint8))
    with pytest.raises(CartsError, match="1 layer imported before would be replaced"):
        plain.do(intents.ImportMasks("others"))
    assert plain.saved.get(Key.imported_mask(0, "left")).mask().sum() == 900  # type: ignore[union-attr]
    plain.do(intents.ImportMasks("others", replace=True))
    assert plain.saved.get(Key.imported_mask(0, "left")).mask().all()  # type: ignore[union-attr]
    assert plain.saved.get(Key.mask_correction(0, "left")) == painted


@pytest.mark.parametrize("place", ["", "/etc", "../elsewhere", "nothing.json", "linked"])
def test_nothing_outside_of_the_allowed_folders_is_read(plain: Desk, tmp_path: Path, place: str) -> None:
    folder = plain.session.sequence.path.parent
    (folder / "linked").symlink_to("/etc")
    with pytest.raises(CartsError, match=r"Type where|outside of the allowed|cannot be opened|is a link"):
        plain.do(intents.ImportMasks(place))
    assert not plain.saved.steps


def test_folders_that_were_allowed_may_be_imported_from(plain: Desk, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("allowed")
    write_theirs(folder)
    with pytest.raises(CartsError, match="outside of the allowed folders"):
        plain.do(intents.ImportMasks(str(folder / "theirs.json")))
    session = Session(plain.session.sequence, People(plain.session.editor.project), folders=[folder])
    assert session.roots.checked(folder / "theirs.json") == folder / "theirs.json"


def test_labels_have_colours_and_keypoints_are_crosses() -> None:
    labels = np.zeros((40, 60), np.uint8)
    labels[5:10], labels[20:25] = 1, 9
    picture = imported(labels, [("tip", 30.5, 32.5), ("far", -5.0, 1e9)], (40, 60), 0.5)
    assert picture[0, 0, 3] == 0 and tuple(picture[7, 0]) == (*label_color(1), 128)
    assert tuple(picture[22, 0]) == (*label_color(9), 128)
    assert tuple(picture[32, 30]) == (*label_color(1), 255)
    assert len({label_color(number) for number in range(1, 40)}) == 39


@pytest.mark.browser
def test_somebody_types_where_the_masks_are_and_sees_them(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(prepare=write_theirs, frames=3, masks=False, width=96, height=72)
    tab = open_tab(app)
    tab.page.get_by_role("tab", name="Review").click()
    tab.page.get_by_text("Masks of others", exact=True).click()
    label = tab.page.locator(f"label[for='{app.page.element_id(tab.find('From'))}']")
    field = label.locator("xpath=ancestor::div[1]/following-sibling::div//input")
    field.fill("theirs.json")
    field.press("Tab")
    eventually(lambda: tab.find("From").value, lambda value: value == "theirs.json")
    tab.button("Import masks")
    tab.page.get_by_text("Imported 2 masks and keypoints of 2 images from COCO (grasper).").wait_for(timeout=30_000)
    tab.page.locator(".carts-legend").get_by_text("grasper").wait_for(timeout=30_000)
    assert app.state.layer is Layer.IMPORTED
    tab.button("Undo")
    tab.page.get_by_text("Nothing was imported yet.").wait_for(timeout=30_000)


def test_masks_below_an_allowed_folder_are_imported(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    path = tiny_sequence(masks=False)
    folder = path.parent.rename(tmp_path.parent / f"{tmp_path.name}_recording")
    elsewhere = tmp_path.parent / f"{tmp_path.name}_elsewhere"
    elsewhere.mkdir()
    assert cv2.imwrite(str(elsewhere / "001.png"), np.full((72, 96), 255, np.uint8))
    for allowed, said in ((), "outside of the allowed folders"), ((elsewhere,), "Imported 1 mask"):
        with ViewerApp.open(folder / path.name, port=0, folders=allowed) as app:
            app.queue.put(intents.ImportMasks(str(elsewhere)))
            state = app.wait_until_shown(60)
            assert said in (state.error or state.imported)
