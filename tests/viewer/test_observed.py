"""What the page fits: predictions of the network, masks of the recording, of others, or painted ones."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import expect
from viewer_canvas import eventually
from viewer_desk import Desk
from viewer_tab import Tab

from carts_core.errors import CartsError
from carts_core.evaluation import dice
from carts_core.project import (
    IgnoreRegion,
    ImportedLabels,
    ImportedMask,
    Key,
    MaskCorrection,
    Project,
    Provenance,
    Source,
    import_annotations,
)
from carts_core.recording import Sequence
from carts_core.recording.annotations import read_annotations
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.jobs.optimizers import OptimizerFactory

SIZE = {"width": 160, "height": 128}


@pytest.fixture
def recording(tiny_sequence: Callable[..., Path]) -> Sequence:
    """Two frames of a recording without masks; those that are right lie in its folder."""
    return Sequence.open(tiny_sequence(frames=2, masks=False, **SIZE))


@pytest.fixture
def at_desk(recording: Sequence, tmp_path: Path) -> Desk:
    """A desk whose networks cannot be loaded."""
    factory = OptimizerFactory(weights=(tmp_path / "missing.safetensors",), report=lambda line: None)
    desk = Desk(recording, Project.open(recording), factory)
    desk.do(intents.SetSetting("solver", "surface"))
    return desk


def right_mask(recording: Sequence, index: int = 0) -> np.ndarray:
    file = recording.path.parent / "masks" / "left" / f"{recording.frame_ids[index]}.png"
    image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image > 0


def bring_in(desk: Desk, recording: Sequence) -> None:
    found = read_annotations(recording.path.parent / "masks" / "left", recording)
    import_annotations(desk.session.editor.project, found, source="masks")


def overlap(desk: Desk, recording: Sequence, index: int = 0) -> float:
    pose = desk.session.pose(recording.frame(index, cameras=[]))
    return dice(desk.renderer.mask(pose.scene, "left"), right_mask(recording, index))


def test_imported_masks_are_fitted_without_a_network_and_the_project_keeps_what_was_fitted(
    at_desk: Desk, recording: Sequence
) -> None:
    bring_in(at_desk, recording)
    before = overlap(at_desk, recording)
    at_desk.do(intents.SetObserved("masks", "imported"), intents.Run())
    state = at_desk.finish()
    assert before < 0.95 and overlap(at_desk, recording) > 0.97
    made = at_desk.saved.joints(0)["PSM1"].provenance
    assert made.source is Source.OPTIMIZER and made.weights_sha256 is None
    used = json.loads(made.settings or "")
    assert (used["observe"], used["masks"]) == ("masks", "imported")
    assert state.verdict is not None
    at_desk.do(intents.Solve(True))
    solved = at_desk.finish().solve
    assert solved is not None and overlap(at_desk, recording, 1) > 0.97
    assert at_desk.saved.joints(1)["PSM1"].provenance.weights_sha256 is None


def test_a_painted_mask_is_fitted_as_it_was_when_the_run_began(at_desk: Desk, recording: Sequence) -> None:
    rendered, wanted = at_desk.renderer.mask(at_desk.state.pose.scene, "left"), right_mask(recording)
    correction = MaskCorrection.of(wanted & ~rendered, rendered & ~wanted)
    at_desk.session.editor.project.apply("Paint", {Key.mask_correction(0, "left"): correction})
    at_desk.do(intents.Refresh(), intents.SetObserved("masks", "painted"), intents.Run())
    at_desk.finish()
    assert overlap(at_desk, recording) > 0.97
    verdict = at_desk.state.verdict
    assert verdict is not None and verdict.verdict == "good"


def test_what_cannot_be_fitted_is_said(at_desk: Desk) -> None:
    at_desk.do(intents.SetObserved("masks", "imported"))
    with pytest.raises(CartsError, match=r"frame 001 has no imported mask of camera 'left' to be fitted\. Give one"):
        at_desk.do(intents.Run())
    at_desk.do(intents.SetObserved("masks", "recording"))
    with pytest.raises(CartsError, match=r"frame 001 has no mask of camera 'left'"):
        at_desk.do(intents.Run())
    at_desk.do(intents.SetSetting("solver", "acs"))
    with pytest.raises(CartsError, match=r"cannot fit masks\. Choose the solver Surface maps"):
        at_desk.do(intents.Run())
    with pytest.raises(CartsError, match=r"'eyes' cannot be observed\. Choose one of: network, masks, both"):
        at_desk.do(intents.SetObserved("eyes", "imported"))
    at_desk.do(intents.SetSetting("solver", "surface"), intents.SetObserved("both", "imported"))
    with pytest.raises(CartsError, match=r"missing\.safetensors"):
        at_desk.do(intents.Run())


def test_a_job_on_all_frames_leaves_out_those_without_a_mask(at_desk: Desk, recording: Sequence) -> None:
    mask = ImportedMask.of(right_mask(recording, 1).astype(np.uint8))
    edits = {Key.imported_mask(1, "left"): mask, Key.imported_labels(): ImportedLabels(("tool",))}
    at_desk.session.editor.project.apply("Import", edits)
    at_desk.do(intents.SetObserved("masks", "imported"), intents.OptimizeFrames("all"))
    (job,) = at_desk.finish().jobs
    assert job.state == "done" and any("001: no mask to fit, not touched" in line for line in job.log)
    assert not at_desk.saved.joints(0) and overlap(at_desk, recording, 1) > 0.97


def test_pixels_to_be_ignored_come_from_the_brush_and_from_a_label(at_desk: Desk) -> None:
    labels = np.zeros((SIZE["height"], SIZE["width"]), np.uint8)
    labels[:10], labels[10:20] = 1, 2
    painted = np.zeros(labels.shape, bool)
    painted[:, :5] = True
    edits = {
        Key.imported_mask(0, "left"): ImportedMask.of(labels),
        Key.imported_labels(): ImportedLabels(("tool", "Ignore")),
        Key.ignore_region(0, "left"): IgnoreRegion.of(painted),
    }
    at_desk.session.editor.project.apply("Import", edits)
    state = at_desk.do(intents.SetObserved("masks", "imported"))
    target = at_desk.session.target(state.observed)
    assert target.given is not None and np.array_equal(target.given.masks(0)["left"], labels == 1)
    assert np.array_equal(at_desk.session.ignored(0, ["left"], target)["left"], painted | (labels == 2))
    assert np.array_equal(at_desk.session.ignored(0, ["left"])["left"], painted)
    assert at_desk.session.ignored(1, ["left"], target) == {}


def test_a_result_of_an_optimizer_says_which_network_was_run_unless_masks_alone_were_fitted() -> None:
    assert Provenance.made_by_optimizer({"observe": "masks"}, None).weights_sha256 is None
    for settings in ({"observe": "both"}, {}):
        with pytest.raises(CartsError, match="needs its settings and the hash"):
            Provenance.made_by_optimizer(settings, None)


@pytest.mark.browser
def test_imported_masks_are_chosen_and_fitted_in_the_page(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=2, masks=False, **SIZE)
    recording = Sequence.open(app.project.path.with_name("sequence.toml"))
    app.queue.put(intents.ImportMasks(str(recording.path.parent / "masks" / "left")))
    app.wait_until_shown()
    tab = open_tab(app)
    expect(tab.page.get_by_text("Whose masks", exact=True)).to_have_count(0)
    tab.choose("Fit to", "Masks")
    tab.choose("Whose masks", "Imported")
    tab.button("Run")
    eventually(lambda: app.project.state.verdict(0), lambda verdict: verdict is not None)
    made = app.project.state.joints(0)["PSM1"].provenance
    assert json.loads(made.settings or "")["masks"] == "imported" and made.weights_sha256 is None
    # What is fitted is a person's own choice.
    other = open_tab(app, (1000, 900))
    assert other.state.observed.what == "network" and tab.state.observed.what == "masks"
