"""A real recording labelled in the browser by keys, from opening it to masks that pycocotools reads."""

import json
from collections import Counter
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from playwright.sync_api import expect
from pycocotools.coco import COCO
from viewer_tab import OpenTab, Tab
from waiting import eventually

from carts_core.evaluation import dice
from carts_core.project import ReviewState
from carts_core.recording.images import read_mask
from carts_viewer.app import ViewerApp
from carts_viewer.jobs.job_list import JobState
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.state import Phase

SEQUENCE = Path(__file__).parents[1] / "sequences" / "dvrk_stereo.toml"


GOOD = 0.945
"""Dice of a frame that the test's reviewer accepts."""


CAMERA = "left"


class Labeller:
    """Presses keys and buttons, and counts them.

    Attributes:
        shared: actions that are about all frames.
        actions: by frame.
    """

    def __init__(self, tab: Tab) -> None:
        self._tab, self.app = tab, tab.app
        self.shared, self.actions = 0, Counter[int]()

    def press(self, key: str) -> None:
        """A key, for the shown frame."""
        self.actions[self.app.state.index] += 1
        self._tab.press(key)

    def optimize_all(self) -> None:
        """Queue a run on every frame, and wait for it."""
        self._tab.open("Jobs")
        self._tab.choose("Which frames", "All")
        self._tab.button("Optimize individually")
        self.shared += 4
        eventually(lambda: self.app.state.jobs, lambda jobs: bool(jobs) and jobs[-1].state is JobState.DONE, 1500)
        expect(self._tab.page.locator(".carts-jobs li.done")).to_be_visible()

    def judge(self) -> None:
        """Accept the shown frame, after another run if it needs one, or leave it for later."""
        app = self.app
        if self._dice() < GOOD:
            self.press("r")
            eventually(lambda: app.state.run, lambda run: run.phase is Phase.IDLE and bool(run.reason), 120)
        before = app.state.index
        if self._dice() >= GOOD:
            self.press("g")
        else:
            self.press("f")
            eventually(lambda: app.state.review.state, lambda state: state is ReviewState.NEEDS_WORK)
            self.press("y")
        judged = (ReviewState.ACCEPTED, ReviewState.NEEDS_WORK)
        eventually(lambda: app.state.project.review(before).state, lambda state: state in judged)

    def _dice(self) -> float:
        scores = eventually(lambda: self.app.state.scores, lambda found: found is not None and found.dice is not None)
        assert scores is not None and scores.dice is not None
        return scores.dice


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.timeout(3000)
def test_thirty_real_frames_take_at_most_two_actions_each_and_are_exported(
    shared_dir: Path, tmp_path: Path, open_tab: OpenTab
) -> None:
    with ViewerApp.open(SEQUENCE, project=tmp_path / "real.carts", port=0) as app:
        app.wait_until_shown()
        tab, frames = open_tab(app), len(app.sequence)
        labeller = Labeller(tab)
        labeller.optimize_all()
        for _ in range(frames):
            labeller.judge()
            app.wait_until_shown()
        reviews = [app.state.project.review(index).state for index in range(frames)]
        accepted = [index for index in range(frames) if reviews[index] is ReviewState.ACCEPTED]
        each = [labeller.actions[index] + labeller.shared / frames for index in range(frames)]
        tab.open("Export")
        tab.choose("Format", "COCO")
        tab.choose("Frames", "Accepted")
        tab.button("Export")
        path = eventually(lambda: app.state.export and app.state.export.path)
        assert path is not None
        found = _read_back(path, app, accepted)
    print(
        f"{len(accepted)} of {frames} frames accepted, mean Dice of the exported masks {np.mean(found):.3f}; "
        f"{labeller.shared} actions for all and {sum(labeller.actions.values())} for single ones: "
        f"median {median(each):.2f} a frame"
    )
    assert set(reviews) <= {ReviewState.ACCEPTED, ReviewState.NEEDS_WORK} and len(accepted) >= frames / 2
    assert median(each) <= 2.0 and min(found) >= GOOD - 1e-6


def _read_back(folder: Path, app: ViewerApp, accepted: list[int]) -> list[float]:
    """Dice with the true masks of the reviewed camera; rendered masks of all cameras are those of the project."""
    file = folder / "annotations" / "instances_default.json"
    coco, renderer = COCO(str(file)), OverlayRenderer(app.sequence)
    content = json.loads(file.read_text(encoding="utf-8"))
    images, recorded = content["images"], Path(content["info"]["image_folder"])
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
            assert image["source"] == "optimized" and (recorded / image["file_name"]).is_file()
            (annotation,) = coco.loadAnns(coco.getAnnIds(imgIds=image["id"]))
            mask = coco.annToMask(annotation).astype(bool)
            beside = folder / "rendered" / f"{camera}_{ids[index]}.png"
            assert image.get("refined", False) == beside.exists()
            rendered = read_mask(beside) if beside.exists() else mask
            assert np.array_equal(rendered, renderer.arm_ids(kept, camera) >= 0)
            if camera == CAMERA:
                assert frame.masks is not None
                found.append(dice(mask, frame.masks[camera]))
    return found
