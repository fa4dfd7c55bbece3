"""A real recording reviewed in the browser, from opening it to masks that pycocotools reads."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import expect
from pycocotools.coco import COCO
from viewer_canvas import eventually
from viewer_tab import Tab

from carts_core.evaluation import dice
from carts_core.project import ReviewState
from carts_viewer.app import ViewerApp
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.state import Phase

SEQUENCE = Path(__file__).parents[1] / "sequences" / "dvrk_stereo.toml"
GOOD = 0.945
"""Dice of a frame that the test's reviewer accepts."""
CAMERA = "left"


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_thirty_real_frames_are_reviewed_by_keys_and_exported(
    shared_dir: Path, tmp_path: Path, open_tab: Callable[..., Tab], record_property: Callable[[str, object], None]
) -> None:
    with ViewerApp.open(SEQUENCE, project=tmp_path / "real.carts", port=0) as app:
        app.wait_until_shown(120)
        tab = open_tab(app)
        tab.page.get_by_text("Review", exact=True).first.click()
        frames = len(app.sequence)
        for number in range(frames):
            assert app.state.index == number
            fitted = _fit(tab)
            if number in (0, frames // 2):
                tab.page.screenshot(path=tmp_path / f"frame_{number + 1}.png")
            if fitted >= GOOD:
                tab.page.keyboard.press("g")
            else:
                tab.page.keyboard.press("f")
                eventually(lambda: app.state.review.state, lambda state: state is ReviewState.NEEDS_WORK)
                tab.page.keyboard.press("y")
            eventually(lambda: app.state, lambda state, number=number: state.index != number or _all_reviewed(app))
        project = app.state.project
        reviews = [project.review(index).state for index in range(frames)]
        accepted = [index for index in range(frames) if reviews[index] is ReviewState.ACCEPTED]
        assert set(reviews) <= {ReviewState.ACCEPTED, ReviewState.NEEDS_WORK} and len(accepted) >= frames / 2
        expect(tab.page.get_by_text(f"{len(accepted)} accepted")).to_be_visible()
        tab.page.screenshot(path=tmp_path / "reviewed.png")
        folder = _export_coco(tab)
        tab.page.screenshot(path=tmp_path / "exported.png")
        found = _read_back(folder, app, accepted)
    record_property("accepted", len(accepted))
    print(f"{len(accepted)} of {frames} frames accepted, mean Dice of the exported masks {np.mean(found):.3f}")
    assert min(found) >= GOOD - 1e-6


def _fit(tab: Tab) -> float:
    """Run the optimizer on the shown frame, and give the Dice that the page then shows."""
    app = tab.app
    tab.page.keyboard.press("r")
    eventually(lambda: app.state.run, lambda run: run.phase is Phase.IDLE and run.reason is not None, timeout=120)
    shown = eventually(lambda: app.state, lambda state: not state.unsaved and _known(state.scores))
    assert shown.scores is not None and shown.scores.dice is not None
    expect(tab.page.locator(".carts-caption b").filter(has_text=f"{shown.scores.dice:.3f}")).to_be_visible()
    return shown.scores.dice


def _known(scores) -> bool:
    return scores is not None and scores.dice is not None


def _all_reviewed(app: ViewerApp) -> bool:
    project = app.state.project
    open_ones = (ReviewState.UNTOUCHED, ReviewState.OPTIMIZED)
    return all(project.review(index).state not in open_ones for index in range(len(app.sequence)))


def _export_coco(tab: Tab) -> Path:
    tab.page.get_by_text("Export", exact=True).first.click()
    tab.choose("Format", "COCO")
    tab.choose("Frames", "Accepted")
    tab.button("Export")
    path = eventually(lambda: tab.app.state.export and tab.app.state.export.path, bool, timeout=120)
    assert path is not None
    return path


def _read_back(folder: Path, app: ViewerApp, accepted: list[int]) -> list[float]:
    """Dice with the true masks of the reviewed camera; masks of all cameras are to the pixel what the project holds."""
    file = folder / "annotations" / "instances_default.json"
    coco, renderer = COCO(str(file)), OverlayRenderer(app.sequence)
    images = json.loads(file.read_text(encoding="utf-8"))["images"]
    by_view = {(image["frame"], image["camera"]): image for image in images}
    cameras = [camera.name for camera in app.scene.cameras]
    ids = app.sequence.frame_ids
    assert len(images) == len(by_view) and set(by_view) == {
        (ids[index], name) for index in accepted for name in cameras
    }
    found = []
    for index in accepted:
        frame = app.sequence.frame(index, cameras=cameras)
        joints = {arm: value.joint_positions for arm, value in app.state.project.joints(index).items()}
        kept = app.scene.state({**frame.measured, **joints})
        for camera in cameras:
            image = by_view[ids[index], camera]
            assert image["source"] == "optimized" and (folder / "images" / image["file_name"]).is_file()
            (annotation,) = coco.loadAnns(coco.getAnnIds(imgIds=image["id"]))
            mask = coco.annToMask(annotation).astype(bool)
            assert np.array_equal(mask, renderer.arm_ids(kept, camera) >= 0)
            if camera == CAMERA:
                assert frame.masks is not None
                found.append(dice(mask, frame.masks[camera]))
    return found
