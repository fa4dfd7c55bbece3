"""From raw files to a calibrated overlay, in a browser."""

import csv
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import pytest
from clicked_points import clicked
from playwright.sync_api import Browser, expect
from viewer_tab import READY, dismiss_warning, new_context
from visitor import Visitor, write_lab_files
from waiting import eventually, wait_in

from carts_core.evaluation.metrics import dice
from carts_core.model.camera import HALF_PIXEL
from carts_core.model.psm_kinematics import JOINT_NAMES
from carts_core.model.scene import Scene
from carts_core.project.identity import data_dir
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_viewer.start.site import Site
from carts_viewer.wizard.draft import Draft, DraftFile, Step
from carts_viewer.wizard.wizard import RecordingWizard

pytestmark = pytest.mark.browser

SHIFT = np.array([[0.0, 0.0, HALF_PIXEL], [0.0, 0.0, HALF_PIXEL], [0.0, 0.0, 0.0]])
"""From our K to OpenCV's."""


@pytest.fixture
def visit(browser: Browser) -> Iterator[Callable[[Path], Visitor]]:
    """Opens the start page for the recordings below a folder, in a window of 1280 x 800."""
    with ExitStack() as stack:

        def make(root: Path) -> Visitor:
            site = stack.enter_context(Site([root], port=0))
            context = stack.enter_context(closing(new_context(browser)))
            return Visitor(site, context.new_page())

        yield make


def place_of(visitor: Visitor) -> RecordingWizard:
    visitor.site.wait()
    assert isinstance(visitor.site.shown, RecordingWizard)
    return visitor.site.shown


def click_what_is_asked_for(visitor: Visitor, scene: Scene, measured: dict[str, np.ndarray], noise: float) -> None:
    """Click each landmark at its position under a calibration, until there are no more prompts."""
    for number in range(60):
        place = place_of(visitor)
        prompt = place.prompt
        if prompt is None:
            return
        camera = scene.camera(prompt.camera)
        points = clicked(
            scene, measured, [prompt.frame], [prompt.camera], noise=noise, seed=number, names=(prompt.landmark,)
        )
        point = next(point for point in points if point.arm == prompt.arm)
        before = len(place.draft.points)
        visitor.page.locator(f'[data-click="click {prompt.key}"]').wait_for()
        visitor.point_at(point.pixel, (camera.width, camera.height))
        eventually(lambda: len(place_of(visitor).draft.points), lambda count, before=before: count == before + 1)
    raise AssertionError("there is no end to what is asked for")


def test_two_folders_a_table_and_calibrations_become_a_sequence_with_its_arm_in_place(
    tiny_sequence: Callable[..., Path], tmp_path: Path, visit: Callable[[Path], Visitor]
) -> None:
    made = Sequence.open(tiny_sequence(frames=4, cameras=("left", "right"), width=320, height=240))
    assert made.truth is not None
    true = {"PSM1": made.truth["PSM1"]}
    root = tmp_path / "labs"
    for camera in ("left", "right"):
        shutil.copytree(made.path.parent / "regular" / camera, root / "day 3" / f"{camera}_images")
    lenses = [(camera.name, (camera.width, camera.height), camera.K - SHIFT) for camera in made.scene.cameras]
    write_lab_files(root / "day 3", range(1, 5), true["PSM1"], lenses)
    visitor = visit(root)
    visitor.press("New recording")
    visitor.press_folder("day 3")
    visitor.press("Choose this folder")
    visitor.reads("Each row belongs to one image.", 90)
    visitor.press("Continue to hand-eye")
    visitor.reads("Click the tip")
    dismiss_warning(visitor.page)
    click_what_is_asked_for(visitor, made.scene, true, 0.5)
    visitor.reads("All planned points have been clicked")
    # Taken back and done again, and still there after a restart.
    points = place_of(visitor).draft.points
    visitor.press("Undo")
    eventually(lambda: place_of(visitor).draft.points, lambda now: now == points[:-1])
    expect(visitor.page.locator("main").get_by_text("All planned points have been clicked")).to_have_count(0)
    visitor.press("All recordings")
    visitor.press("Continue day 3")
    visitor.reads("Click the shaft edge")
    click_what_is_asked_for(visitor, made.scene, true, 0.5)
    visitor.press("Save and open")
    app = eventually(lambda: visitor.site.app, lambda now: now is not None, 120)
    assert app is not None
    wait_in(visitor.page, READY)
    saved = app.sequence
    assert saved.path == root / "day 3_sequence" / "sequence.toml"
    overlap = [agreement(saved.scene, made, camera) for camera in ("left", "right")]
    assert min(overlap) > 0.85, overlap
    text = saved.path.read_text()
    assert "points clicked in carts view" in text and "no base frame" not in text
    visitor.page.get_by_role("button", name="All recordings", exact=True).click()
    visitor.reads("0 of 4 frames reviewed")
    assert not (data_dir() / "drafts").exists() or not list((data_dir() / "drafts").glob("*.json"))


@pytest.fixture
def hand_eye(
    tiny_sequence: Callable[..., Path], tmp_path: Path, visit: Callable[[Path], Visitor]
) -> Iterator[tuple[Visitor, RecordingWizard]]:
    """At the step Hand-eye, without points."""
    made = Sequence.open(tiny_sequence(frames=2, width=320, height=240))
    folder = tmp_path / "labs" / "day 3"
    shutil.copytree(made.path.parent / "regular" / "left", folder / "left_images")
    (left,) = made.scene.cameras
    write_lab_files(folder, range(1, 3), made.measured["PSM1"], [("left", (320, 240), left.K - SHIFT)])
    file = DraftFile()
    file.write(Draft(Step.HAND_EYE, str(folder), "day 3"))
    visitor = visit(folder.parent)
    visitor.site.post(lambda: visitor.site.show_recording(file.key))
    visitor.reads("Click the tip")
    dismiss_warning(visitor.page)
    yield visitor, place_of(visitor)


def test_a_double_click_places_one_point(hand_eye: tuple[Visitor, RecordingWizard]) -> None:
    visitor, place = hand_eye
    wait_in(visitor.page, "window.carts && carts.imageOnScreen()")
    for count in (1, 2):
        visitor.page.locator("canvas[data-engine]").dblclick(position={"x": 200 + 100 * count, "y": 360})
        visitor.page.locator(".clicks tr").nth(count).wait_for()
        visitor.page.wait_for_timeout(500)
        assert len(place.draft.points) == count


def test_a_held_arrow_key_moves_a_point_by_all_its_steps_as_one_undo_step(
    hand_eye: tuple[Visitor, RecordingWizard],
) -> None:
    visitor, place = hand_eye
    page = visitor.page
    visitor.point_at((160.0, 120.0), (320, 240))
    visitor.button("tip").click()
    (point,) = place.draft.points
    page.locator(".mark").click()
    page.wait_for_timeout(200)
    for _ in range(20):
        page.keyboard.down("ArrowRight")
    page.keyboard.up("ArrowRight")
    eventually(lambda: place.draft.points[0].pixel[0], lambda u: u == pytest.approx(point.pixel[0] + 10.0))
    for _ in range(4):
        page.keyboard.press("ArrowDown")
    eventually(lambda: place.draft.points[0].pixel[1], lambda v: v == pytest.approx(point.pixel[1] + 2.0))
    for _ in range(5):
        visitor.site.post(lambda: place.choose("undo", ""))
    visitor.site.wait()
    assert place.draft.points == (point,)


def test_a_held_delete_key_and_a_second_click_on_remove_take_away_one_point(
    hand_eye: tuple[Visitor, RecordingWizard],
) -> None:
    visitor, place = hand_eye
    page = visitor.page
    for count, u in enumerate((120.0, 150.0, 180.0, 210.0), start=1):
        visitor.point_at((u, 120.0), (320, 240))
        page.locator(".clicks tr").nth(count).wait_for()
    points = place.draft.points
    page.locator(".mark").first.focus()
    for _ in range(5):
        page.keyboard.down("Delete")
    page.keyboard.up("Delete")
    eventually(lambda: len(place.draft.points), lambda count: count < len(points))
    visitor.site.wait()
    kept = place.draft.points
    assert len(kept) == len(points) - 1
    page.locator(".clicks tr").nth(len(kept) + 1).wait_for(state="detached")
    page.locator(".clicks button[data-do=remove-point]").first.evaluate(
        "(button) => { button.click(); button.click(); }"
    )
    eventually(lambda: len(place.draft.points), lambda count: count < len(kept))
    # A later choice has been carried out after both clicks.
    page.get_by_role("textbox", name="Name", exact=True).fill("after")
    page.get_by_role("textbox", name="Name", exact=True).blur()
    eventually(lambda: place.draft.name == "after")
    assert place.draft.points == kept[1:]


def test_a_text_that_is_typed_while_the_document_is_replaced_is_reported_once_the_field_is_left(
    hand_eye: tuple[Visitor, RecordingWizard],
) -> None:
    visitor, place = hand_eye
    field = visitor.page.get_by_role("textbox", name="Name", exact=True)
    field.click()
    field.press("Control+a")
    visitor.page.keyboard.type("day 4")
    visitor.page.evaluate("document.querySelector('main input[type=text]').old = true")
    visitor.site.post(place.show)
    wait_in(visitor.page, "!document.querySelector('main input[type=text]').old")
    assert place.draft.name == "day 3"
    expect(field).to_have_value("day 4")
    expect(field).to_be_focused()
    field.blur()
    eventually(lambda: place.draft.name, lambda name: name == "day 4", 30.0)


def agreement(found: Scene, truth: Sequence, camera: str) -> float:
    """Mean Dice of rendered masks of two calibrations over every third frame."""
    renderers = [Renderer(scene, cameras=[camera]) for scene in (found, truth.scene)]
    scores = []
    for index in range(0, len(truth), 3):
        joints = {arm: rows[index] for arm, rows in (truth.truth or {}).items()}
        masks = [
            renderer.segment(scene.state(joints))[0] >= 0
            for renderer, scene in zip(renderers, (found, truth.scene), strict=True)
        ]
        scores.append(dice(*masks))
    return float(np.mean(scores))


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_real_stereo_frames_without_any_hand_eye_are_calibrated_within_25_clicks(
    shared_dir: Path, tmp_path: Path, visit: Callable[[Path], Visitor]
) -> None:
    data = shared_dir / "data" / "dvrk_stereo"
    reference = Sequence.open(Path(__file__).parent.parent / "sequences" / "dvrk_stereo.toml")
    root = tmp_path / "labs"
    for side in ("left", "right"):
        shutil.copytree(data / side, root / "day 3" / f"{side}_camera")
    with (data / "kinematics.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    values = np.array([[float(row[name]) for name in JOINT_NAMES] for row in rows])
    lenses = [(camera.name, (camera.width, camera.height), camera.K - SHIFT) for camera in reference.scene.cameras]
    write_lab_files(root / "day 3", range(1, 31), values, lenses)
    visitor = visit(root)
    visitor.press("New recording")
    visitor.press_folder("day 3")
    visitor.press("Choose this folder")
    visitor.press("Continue to hand-eye", 90)
    visitor.reads("Click the tip", 90)
    dismiss_warning(visitor.page)
    click_what_is_asked_for(visitor, reference.scene, dict(reference.measured), 2.0)
    visitor.press("Calibrate")
    visitor.reads("Calibrated", 900)
    assert visitor.clicks <= 25
    place = place_of(visitor)
    shown = place.shown_scene
    assert shown is not None
    scores = {camera: masks_agreement(shown, reference, camera) for camera in ("left", "right")}
    print(f"{visitor.clicks} clicks, Dice {scores}")
    assert scores["left"] >= 0.94 and scores["right"] >= 0.95, scores
    visitor.press("Save and open")
    app = eventually(lambda: visitor.site.app, lambda now: now is not None, 120)
    assert app is not None
    wait_in(visitor.page, READY)
    saved = app.sequence.scene
    assert masks_agreement(saved, reference, "left") == pytest.approx(scores["left"], abs=0.002)


def masks_agreement(scene: Scene, reference: Sequence, camera: str) -> float:
    """Mean Dice against the masks of all frames, joints as measured."""
    renderer, scores = Renderer(scene, cameras=[camera]), []
    for index in range(len(reference)):
        frame = reference.frame(index, cameras=[camera])
        assert frame.masks is not None
        scores.append(dice(renderer.segment(scene.state(frame.measured))[0] >= 0, frame.masks[camera]))
    return float(np.mean(scores))
