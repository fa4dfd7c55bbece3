"""From raw files to a calibrated overlay, in a browser, as a person does it."""

import csv
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from clicked_points import clicked
from playwright.sync_api import Browser, expect
from scipy.spatial.transform import Rotation
from swaying import write_log, write_swaying
from viewer_canvas import eventually
from visitor import Visitor, write_lab_files
from waiting import wait_in

from carts_core.evaluation.evaluate import dice
from carts_core.imaging.working_image import Window
from carts_core.model.camera import HALF_PIXEL
from carts_core.model.psm_kinematics import JOINT_NAMES
from carts_core.model.robot import Robot
from carts_core.model.scene import Scene
from carts_core.networks import FeatureExtractor
from carts_core.optimization import CalibrationOptimizer, ImagePredictor
from carts_core.project.identity import data_dir
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_viewer.start.site import Site
from carts_viewer.wizard.calibration import CalibrationJob
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
            context = browser.new_context(viewport={"width": 1280, "height": 800})
            stack.callback(context.close)
            return Visitor(site, context.new_page())

        yield make


def place_of(visitor: Visitor) -> RecordingWizard:
    visitor.site.wait()
    assert isinstance(visitor.site.shown, RecordingWizard)
    return visitor.site.shown


def click_what_is_asked_for(visitor: Visitor, scene: Scene, measured: dict[str, np.ndarray], noise: float) -> None:
    """Click each landmark where a calibration says that it is, until no more is asked for."""
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
        visitor.point_at(point.pixel, (camera.width, camera.height))
        eventually(lambda: len(place_of(visitor).draft.points), lambda count, before=before: count == before + 1)
    raise AssertionError("there is no end to what is asked for")


def test_two_folders_a_table_and_calibrations_become_a_sequence_with_its_arm_in_place(
    tiny_sequence: Callable[..., Path],
    tmp_path: Path,
    visit: Callable[[Path], Visitor],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = Sequence.open(tiny_sequence(frames=8, cameras=("left", "right"), width=320, height=240))
    assert made.truth is not None
    true = {"PSM1": made.truth["PSM1"]}
    root = tmp_path / "labs"
    for camera in ("left", "right"):
        shutil.copytree(made.path.parent / "regular" / camera, root / "day 3" / f"{camera}_images")
    lenses = [(camera.name, (camera.width, camera.height), camera.K - SHIFT) for camera in made.scene.cameras]
    write_lab_files(root / "day 3", range(1, 9), true["PSM1"], lenses)
    visitor = visit(root)
    visitor.press("New recording")
    visitor.press_folder("day 3")
    visitor.press("Choose this folder")
    visitor.reads("Each row belongs to one image.", 90)
    visitor.press("Continue to hand-eye")
    visitor.reads("Click the tip")
    visitor.dismiss_warning()
    click_what_is_asked_for(visitor, made.scene, true, 0.5)
    visitor.reads("All points are there")
    # Taken back and done again, and still there after a restart.
    points = place_of(visitor).draft.points
    visitor.press("Undo")
    eventually(lambda: place_of(visitor).draft.points, lambda now: now == points[:-1])
    expect(visitor.page.locator("main").get_by_text("All points are there")).to_have_count(0, timeout=60_000)
    visitor.press("All recordings")
    visitor.press("Go on with day 3")
    visitor.reads("Click the shaft edge")
    click_what_is_asked_for(visitor, made.scene, true, 0.5)
    # After its first step it waits to be stopped, however slow the browser is.
    stopped, cancel, step = threading.Event(), CalibrationJob.cancel, CalibrationOptimizer.step
    monkeypatch.setattr(CalibrationJob, "cancel", lambda job: (cancel(job), stopped.set()))
    monkeypatch.setattr(
        CalibrationOptimizer,
        "step",
        lambda optimizer: (bool(optimizer.history) and stopped.wait(120), step(optimizer))[1],
    )
    visitor.press("Calibrate")
    visitor.reads("Stage 1 of", 120)
    visitor.press("Stop")
    visitor.reads("Stopped; the calibration from your points is as it was.", 120)
    visitor.press("Save and open")
    app = eventually(lambda: visitor.site.app, lambda now: now is not None, 120)
    assert app is not None
    wait_in(visitor.page, "window.__viserMutable?.nodeRefFromName['/overlay']")
    saved = app.sequence
    assert saved.path == root / "day 3_sequence" / "sequence.toml"
    overlap = [agreement(saved.scene, made, camera) for camera in ("left", "right")]
    assert min(overlap) > 0.85, overlap
    text = saved.path.read_text()
    assert "points clicked in carts view" in text and "no base frame" not in text
    visitor.page.get_by_role("button", name="All recordings", exact=True).click()
    visitor.reads("0 of 8 frames reviewed")
    assert not (data_dir() / "drafts").exists() or not list((data_dir() / "drafts").glob("*.json"))


def agreement(found: Scene, truth: Sequence, camera: str) -> float:
    """Mean Dice of rendered masks of two calibrations over all frames."""
    renderers = [Renderer(scene, cameras=[camera]) for scene in (found, truth.scene)]
    scores = []
    for index in range(len(truth)):
        joints = {arm: rows[index] for arm, rows in (truth.truth or {}).items()}
        masks = [
            renderer.segment(scene.state(joints))[0] >= 0
            for renderer, scene in zip(renderers, (found, truth.scene), strict=True)
        ]
        scores.append(dice(*masks))
    return float(np.mean(scores))


def test_a_wrong_column_is_explained_where_it_is_and_mended_there(
    tiny_sequence: Callable[..., Path], tmp_path: Path, visit: Callable[[Path], Visitor]
) -> None:
    made = Sequence.open(tiny_sequence(frames=3, cameras=("left",), width=96, height=72))
    root = tmp_path / "labs"
    shutil.copytree(made.path.parent / "regular" / "left", root / "run")
    write_lab_files(root, range(1, 4), made.measured["PSM1"], [])
    table = root / "robot_log.csv"
    table.write_text(table.read_text().replace("axis_3", "depth of insertion").replace("axis_4", "spin"))
    visitor = visit(root)
    visitor.press("New recording")
    visitor.press("Choose this folder")
    visitor.press("Other table …")
    visitor.press_entry("robot_log.csv")
    visitor.reads("Six joints are not recognized")
    assert visitor.button("Continue to hand-eye").is_disabled()
    names = dict(zip(JOINT_NAMES, ("axis_1", "axis_2", "depth of insertion", "spin", "axis_5", "axis_6"), strict=True))
    for joint, column in names.items():
        visitor.page.get_by_label(joint.replace("_", " "), exact=True).select_option(column)
        eventually(
            lambda joint=joint: place_of(visitor).draft.options.columns.get(joint), lambda found: found is not None
        )
    wait_in(visitor.page, "!document.querySelector('main').innerText.includes('not recognized')")
    place = place_of(visitor)
    assert place.draft.options.columns == names
    assert visitor.button("Continue to hand-eye").is_enabled()
    # A sign that is the other way round.
    visitor.page.get_by_label("other sign").first.check()
    eventually(lambda: place.draft.options.flip, lambda flip: flip == ("yaw",))
    visitor.press("Undo")
    eventually(lambda: place.draft.options.flip, lambda flip: flip == ())


def test_a_delay_between_video_and_log_is_proposed_taken_and_undone(
    tmp_path: Path, shipped_psm: Robot, visit: Callable[[Path], Visitor]
) -> None:
    folder = write_swaying(tmp_path / "labs" / "run", shipped_psm, 3, 7.0).parent
    write_log(folder / "log.csv", shipped_psm, 3, 7.0, late=0.12)
    (folder / "sequence.toml").unlink()
    visitor = visit(tmp_path / "labs")
    visitor.press("New recording")
    visitor.press_folder("run")
    visitor.press("Choose this folder")
    visitor.press("Estimate from the motion", 90)
    visitor.reads("Proposed.", 90)
    place = place_of(visitor)
    assert place.draft.options.time_offset is None
    visitor.page.locator("main").get_by_role("button", name="Use 0.1").click()
    eventually(lambda: place.draft.options.time_offset or 0.0, lambda offset: abs(offset - 0.12) < 0.010)
    visitor.press("Estimate from the motion", 90)
    visitor.reads("Images and kinematics fit as they are", 90)
    visitor.press("Undo")
    eventually(lambda: place.draft.options.time_offset, lambda offset: offset is None)


class Truths(ImagePredictor):
    """Predicts the true surface map of one of three frames: the red, the green or the blue one."""

    device = torch.device("cpu")
    stride = 16

    def __init__(self, made: Sequence) -> None:
        renderer = Renderer(made.scene, width=640, height=480)
        frames = map(made.frame, range(len(made)))
        maps = [renderer.surface(made.scene.state(frame.measured)).maps for frame in frames]
        self.maps = [torch.nn.functional.avg_pool2d(each, 2) for each in maps]

    def predict(self, images: torch.Tensor, given: torch.Tensor, window: Window) -> torch.Tensor:
        """The truth in a window."""
        return window.of(self.maps[int(images[0].mean((1, 2)).argmax())])[: len(images)]


@pytest.mark.parametrize("agreeing", [True, False])
def test_a_calibration_shows_its_figures_and_is_kept_where_clicked_points_agree(
    tiny_sequence: Callable[..., Path],
    tmp_path: Path,
    visit: Callable[[Path], Visitor],
    monkeypatch: pytest.MonkeyPatch,
    agreeing: bool,
) -> None:
    made = Sequence.open(tiny_sequence(frames=3, cameras=("left",), width=320, height=240))
    folder = tmp_path / "labs" / "day"
    (folder / "left").mkdir(parents=True)
    for number in range(3):
        cv2.imwrite(str(folder / f"left/{number}.png"), np.full((240, 320, 3), 200 * np.eye(3)[2 - number], np.uint8))
    write_lab_files(folder, range(3), made.measured["PSM1"], [("left", (320, 240), made.scene.cameras[0].K - SHIFT)])
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, 0.0 if agreeing else 6.0, 0.0], degrees=True).as_matrix()
    (arm,) = made.scene.arms
    seen = replace(made.scene, arms=(replace(arm, T_world_base=turn @ arm.T_world_base),))
    points = tuple(clicked(seen, made.measured, range(3), ("left",), noise=1.0))
    DraftFile().write(Draft(Step.HAND_EYE, str(folder), "day", points=points))
    monkeypatch.setattr(FeatureExtractor, "load", lambda *_, **__: Truths(made))
    visitor = visit(tmp_path / "labs")
    visitor.press("Go on with day")
    visitor.reads("Of the calibration from points", 90)
    visitor.dismiss_warning()
    known = visitor.page.locator("main").get_by_text("±").all_inner_texts()
    visitor.press("Calibrate")
    visitor.reads("Calibrated" if agreeing else "Calibration not kept", 240)
    visitor.reads("Loss")
    if (pictures := os.environ.get("CARTS_PICTURES")) is not None:
        visitor.page.screenshot(path=f"{pictures}/calibrated_{agreeing}.png")
    assert visitor.page.locator("main").get_by_text("±").all_inner_texts() != known
    assert visitor.page.locator("main details tr").count() >= 1 + len(points)
    draft = place_of(visitor).draft
    assert draft.report is not None
    print(draft.report)
    if agreeing:
        assert draft.calibration is not None and not draft.report.disagreeing
        return
    assert draft.calibration is None and visitor.page.locator("tr.wrong").count() == len(draft.report.disagreeing) > 0
    visitor.press("Keep anyway")
    visitor.reads("Kept by choice")
    visitor.press("Undo")
    visitor.press("Discard")
    visitor.reads("Of the calibration from points")
    assert place_of(visitor).draft.calibration is None


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
    visitor.dismiss_warning()
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
    wait_in(visitor.page, "window.__viserMutable?.nodeRefFromName['/overlay']")
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
