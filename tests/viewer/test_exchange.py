"""Exports of the page, imported masks and keypoints, and the target of a run."""

import json
import os
import stat
import threading
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet
import pytest
from lerobot_sets import dataset as lerobot_set
from viewer_desk import Desk
from viewer_tab import OpenViewer, decoded, place_of, widget
from waiting import eventually

from carts_core.errors import CartsError, SettingsError
from carts_core.evaluation import dice
from carts_core.export import ExportFormat, FormatName, formats_of, read_kinematics_csv
from carts_core.export.formats import FORMATS as REGISTERED
from carts_core.project import (
    Figures,
    FitVerdict,
    IgnoreRegion,
    ImportedLabels,
    ImportedMask,
    Key,
    MaskCorrection,
    Provenance,
    Review,
    ReviewState,
    Source,
    import_annotations,
)
from carts_core.recording import Sequence, annotations
from carts_core.recording.annotations import read_annotations
from carts_core.recording.annotations.images import Annotations, FrameAnnotation
from carts_core.recording.importing.importer import import_recording
from carts_core.settings import Masks
from carts_viewer.actions import import_export as exporting
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.picture.layers import Layer, imported, label_color
from carts_viewer.picture.overlay import with_imported
from tools.raw_tab import RawTab


def exported(desk: Desk, intent: intents.Export) -> Path:
    """What an export wrote."""
    desk.do(intent)
    assert desk.state.export is not None and desk.state.export.path is None
    path = (desk.finish().export or desk.state.export).path
    assert path is not None
    return path


def test_an_export_is_written_beside_the_project_logged_and_never_replaced(desk: Desk) -> None:
    wanted: list[FormatName] = ["csv", "csv", "masks", "masks"]
    paths = [exported(desk, intents.Export(name, "All")) for name in wanted]
    project = desk.session.editor.project
    assert {path.parent for path in paths} == {project.path.with_name("sequence_exports")}
    assert [path.name for path in paths] == ["kinematics.csv", "kinematics-2.csv", "masks", "masks-2"]
    assert all(path.is_file() if path.suffix else any(path.iterdir()) for path in paths)
    logged = [(record.format, record.path, record.frames) for record in project.state.exports]
    assert logged == [(name, str(path), 3) for name, path in zip(wanted, paths, strict=True)]


@pytest.mark.parametrize(
    ("name", "kind"),
    [("masks", "folder of exports"), ("masks", "temporary folder"), ("csv", "export"), ("csv", "dangling export")],
)
def test_links_that_came_with_a_recording_are_not_followed(
    desk: Desk, tmp_path: Path, name: FormatName, kind: str
) -> None:
    precious = tmp_path / "home" / "thesis.tex"
    precious.parent.mkdir()
    precious.write_text("years of work")
    folder = desk.session.editor.project.path.with_name("sequence_exports")
    stem = {"masks": "masks", "csv": "kinematics.csv"}[name]
    if kind == "folder of exports":
        folder.symlink_to(precious.parent)
        with pytest.raises(CartsError, match="sequence_exports is a link, but must be a folder"):
            exported(desk, intents.Export(name, "All"))
    else:
        folder.mkdir()
        place = folder / {"temporary folder": f".{stem}.part"}.get(kind, stem)
        place.symlink_to(precious.parent if kind != "dangling export" else tmp_path / "home" / "new")
        path = exported(desk, intents.Export(name, "All"))
        assert not path.is_symlink() and path.parent == folder and place.is_symlink()
    assert [path.name for path in precious.parent.iterdir()] == ["thesis.tex"]
    assert precious.read_text() == "years of work"


def test_an_export_says_what_the_project_knows_of_each_frame(desk: Desk) -> None:
    project = desk.session.editor.project
    desk.do(intents.ShowFrame(1), intents.SetReview(ReviewState.REJECTED))
    project.record_verdict(1, FitVerdict("doubtful", "it may be another one", "look at it", 0.4))
    project.record_figures({1: Figures(dice=0.91)}, project.state)
    views = json.loads((exported(desk, intents.Export("masks", "All")) / "export.json").read_text())["views"]
    known = [(view["verdict"], view["review"], view["dice"]) for view in views if view["camera"] == "left"]
    assert known[1] == ("doubtful", "rejected", 0.91) and known[2] == (None, "untouched", None)
    header, *rows = exported(desk, intents.Export("csv", "All")).read_text().splitlines()
    assert header.endswith(",verdict,not_determined")
    assert [row.rsplit(",", 2)[1] for row in rows] == ["", "doubtful", ""]


@pytest.mark.parametrize(("masks", "count"), [("auto", 2), ("refined", 6), ("rendered", 0)])
def test_masks_of_good_or_all_frames_are_refined(desk: Desk, masks: Masks, count: int) -> None:
    desk.session.editor.project.record_verdict(0, FitVerdict("good", "", "", 0.01))
    desk.session.editor.project.record_verdict(1, FitVerdict("doubtful", "", "", 0.4))
    folder = exported(desk, intents.Export("masks", "All", masks=masks))
    sources = [view["mask"] for view in json.loads((folder / "export.json").read_text())["views"]]
    assert len(sources) == 6 and sources.count("refined") == count == len([*folder.glob("rendered/*.png")])


def test_only_frames_of_the_timelines_range_are_written(desk: Desk) -> None:
    desk.do(intents.ShowFrame(0), intents.SetReview(ReviewState.ACCEPTED))
    path = exported(desk, intents.Export("masks", "All", shown_camera=True, range=(1, 2)))
    assert sorted(file.name for file in (path / "binary").iterdir()) == ["left_002.png", "left_003.png"]
    assert desk.state.jobs[-1].title == "Export all as PNG masks, frames 002 to 003"
    # Both choices count, and a job that is repeated is about the same frames.
    with pytest.raises(SettingsError, match=r"accepted, in the timeline's range"):
        desk.do(intents.Export("csv", "Accepted", range=(1, 2)))
    desk.do(intents.RepeatJob(1))
    export = desk.finish().export
    assert export is not None and export.path not in (None, path)
    assert sorted(file.name for file in (export.path / "binary").iterdir())[0] == "left_002.png"  # type: ignore[operator]


def test_an_export_is_of_the_project_as_it_was_when_it_began(desk: Desk) -> None:
    desk.do(intents.Export("csv", "All"), intents.SetJoint("PSM1", 0, 0.3), intents.Released())
    export = desk.finish().export
    assert export is not None and export.path is not None
    assert read_kinematics_csv(export.path, desk.session.scene)[0].source == "measured"


def test_cancelling_leaves_nothing(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exporting, "_TIME_SLICE", 0.0)  # So that it cannot be done already.
    folder = desk.session.editor.project.path.with_name("sequence_exports")
    for written in (0, 1):
        desk.do(intents.Export("coco", "All"))
        desk.advance()
        while desk.state.export is not None and desk.state.export.done < written:
            desk.advance()
        desk.do(intents.CancelExport())
        assert desk.state.export is None and desk.wait_time() is None
        assert list(folder.glob("*")) == [] and not desk.saved.exports
    exported(desk, intents.Export("coco", "All"))


def test_other_tabs_go_on_between_files_that_are_synchronized_and_cancelling_there_leaves_nothing(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    synchronized, fsync = list[int](), os.fsync

    def counted(descriptor: int) -> None:
        if threading.current_thread().name == "carts-export" and stat.S_ISREG(os.fstat(descriptor).st_mode):
            synchronized.append(descriptor)
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", counted)
    monkeypatch.setattr(exporting, "_TIME_SLICE", 0.0)
    desk.do(intents.Export("masks", "All"))
    for count in (1, 2):
        while not synchronized[count - 1 :]:
            desk.advance()
        assert len(synchronized) == count
    desk.do(intents.CancelExport())
    assert desk.state.export is None and len(synchronized) == 2
    assert list(desk.session.editor.project.path.with_name("sequence_exports").glob("*")) == []


def test_what_no_page_of_ours_offers_is_refused(desk: Desk) -> None:
    for options in (("../../etc", "All"), ("coco", "Everything"), ("coco", "All", "pixels")):
        with pytest.raises(CartsError, match=r"Unsupported export|This job cannot be queued"):
            desk.do(intents.Export(*options))  # type: ignore[arg-type]
    with pytest.raises(CartsError, match="Nothing has been exported"):
        desk.do(intents.Download(1))


def test_a_package_that_is_missing_is_named(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(*_: object) -> None:
        raise ModuleNotFoundError("No module named 'pycocotools'", name="pycocotools")

    monkeypatch.setitem(REGISTERED, "coco", ExportFormat("COCO", write))
    desk.do(intents.Export("coco", "All"))
    with pytest.raises(CartsError, match="COCO needs the package pycocotools"):
        desk.finish()
    assert desk.state.export is None and desk.wait_time() is None


def test_a_download_is_the_last_export_whole(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    path = exported(desk, intents.Export("coco", "All"))
    desk.do(intents.Download(4))
    desk.finish()
    client, name, content = desk.delivered[-1]
    with zipfile.ZipFile(BytesIO(content)) as archived:
        assert (client, name) == (4, "coco.zip")
        assert json.loads(archived.read("coco/export.json"))["format"] == "coco"
        assert len(archived.namelist()) == sum(file.is_file() for file in path.rglob("*"))
    table = exported(desk, intents.Export("csv", "All"))
    desk.do(intents.Download(4))
    desk.finish()
    assert desk.delivered[-1] == (4, "kinematics.csv", table.read_bytes())
    monkeypatch.setattr(exporting, "MAX_DOWNLOAD", 10)
    with pytest.raises(CartsError, match="Copy it from that path"):
        desk.do(intents.Download(4))
    table.unlink()
    with pytest.raises(CartsError, match="no longer exists"):
        desk.do(intents.Download(4))


def test_who_looks_on_read_only_can_export(desk: Desk) -> None:
    reader = desk.reopened(read_only=True)
    assert exported(reader, intents.Export("csv", "All")).is_file() and not reader.saved.exports


# ---- Imports --------------------------------------------------------------------------------------------------------


@pytest.fixture
def plain(tiny_sequence: Callable[..., Path], untrained_weights: Path) -> Desk:
    """A desk for a recording without masks."""
    return Desk.open(tiny_sequence(frames=3, masks=False), weights=(untrained_weights,))


def write_theirs(folder: Path, frames: tuple[int, ...] = (1, 2)) -> np.ndarray:
    """COCO file beside the recording, with a rectangle and a keypoint in some frames; returns the mask."""
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
    desk.finish()
    return mask


def test_masks_of_others_are_imported_and_chosen_in_the_panels(open_viewer: OpenViewer) -> None:
    app = open_viewer(write_theirs, masks=False)
    with RawTab(app.url) as tab:
        source, fit = widget(app, tab, "Mask source"), widget(app, tab, "Fit to")
        assert not source.visible
        tab.set(app.page.element_id(fit), "Masks")
        eventually(lambda: source.visible)
        tab.set(app.page.element_id(source), "Imported")
        eventually(lambda: (app.state.observed.what, app.state.observed.masks) == ("masks", "imported"))
        tab.set(app.page.element_id(widget(app, tab, "From")), "theirs.json")
        tab.set(app.page.element_id(widget(app, tab, "Import masks")), True)
        eventually(lambda: app.state.imported)
        assert app.wait_until_shown().imported == ("Imported 2 masks and keypoints of 2 images from COCO (grasper).")


def test_an_import_holds_up_no_other_tab_and_can_be_cancelled(
    open_viewer: OpenViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    goes_on = threading.Event()

    def held(frames: Iterator[FrameAnnotation]) -> Iterator[FrameAnnotation]:
        yield next(frames)
        goes_on.wait(60)
        yield from frames

    def slow(*arguments: Any, **options: Any) -> Annotations:
        found = read_annotations(*arguments, **options)
        return replace(found, frames=held(found.frames))

    monkeypatch.setattr(annotations, "read_annotations", slow)
    app = open_viewer(write_theirs, masks=False)
    with RawTab(app.url) as tab, RawTab(app.url) as other:
        mine = place_of(app, tab).controller

        def press(label: str) -> None:
            tab.set(app.page.element_id(widget(app, tab, label)), True)

        tab.set(app.page.element_id(widget(app, tab, "From")), "theirs.json")
        press("Import masks")
        eventually(lambda: mine.state.importing, lambda count: count == 1)
        other.set(app.page.element_id(widget(app, other, "Frame")), 2)
        eventually(lambda: place_of(app, other).controller.state.index, lambda index: index == 1)
        assert mine.state.importing == 1
        press("Cancel import")
        eventually(lambda: mine.state.importing, lambda count: count is None)
        goes_on.set()
        assert not app.wait_until_shown().project.steps and mine.state.error is None
        assert mine.state.notice == "Import cancelled; the project is unchanged."
        press("Import masks")
        eventually(lambda: mine.state.imported, lambda text: "Imported 2 masks" in text)


def test_an_import_is_one_step_shown_at_once_and_compared_with_where_the_recording_has_no_masks(plain: Desk) -> None:
    plain.controller.score()
    assert plain.state.scores is not None and plain.state.scores.dice is None
    mask = bring_in(plain)
    assert plain.state.layer is Layer.IMPORTED
    assert [step.name for step in plain.saved.steps] == ["Import from theirs.json"]
    layer = plain.saved.get(Key.imported_mask(0, "left"))
    assert layer is not None and np.array_equal(layer.mask(), mask)
    plain.controller.score()
    rendered = plain.renderer.mask(plain.state.pose.scene, "left")
    assert plain.state.scores.dice == pytest.approx(dice(rendered, mask))
    figures = plain.saved.figures(0)
    assert figures is not None and figures.dice == plain.state.scores.dice
    plain.do(intents.Undo())
    plain.controller.score()
    assert plain.state.scores.dice is None


def test_an_import_without_a_change_takes_over_no_step_of_somebody_else(plain: Desk) -> None:
    bring_in(plain)
    people = plain.session.editor.people
    people.apply(people.join(), "Accept", {Key.review(1): Review(ReviewState.ACCEPTED)})
    bring_in(plain)
    assert "nothing was changed" in plain.state.imported
    plain.do(intents.Undo())
    assert plain.saved.review(1).state is ReviewState.ACCEPTED
    assert plain.saved.get(Key.imported_mask(0, "left")) is None


def test_masks_of_the_recording_itself_stay_the_truth(desk: Desk) -> None:
    before = desk.session.frame(0, "regular", "left")
    bring_in(desk, camera="left")
    after = with_imported(before, desk.session.scene, desk.session.editor.view)
    assert before.masks is not None and after.masks is not None
    assert np.array_equal(after.masks["left"], before.masks["left"])


def test_nothing_outside_of_the_allowed_folders_is_read(plain: Desk) -> None:
    (plain.session.sequence.path.parent / "linked").symlink_to("/etc")
    for place in ("", "/etc", "../elsewhere", "nothing.json", "linked"):
        with pytest.raises(CartsError, match=r"Enter the path|outside of the allowed|cannot be opened|is a link"):
            plain.do(intents.ImportMasks(place))
    assert not plain.saved.steps


def test_labels_have_colours_and_keypoints_are_crosses() -> None:
    labels = np.zeros((40, 60), np.uint8)
    labels[5:10], labels[20:25] = 1, 9
    picture = imported(labels, [("tip", 30.5, 32.5), ("far", -5.0, 1e9)], (40, 60), 0.5)
    assert picture[0, 0, 3] == 0 and tuple(picture[7, 0]) == (*label_color(1), 128)
    assert tuple(picture[22, 0]) == (*label_color(9), 128)
    assert tuple(picture[32, 30]) == (*label_color(1), 255)
    assert len({label_color(number) for number in range(1, 40)}) == 39


def test_the_format_is_chosen_where_a_folder_has_several(plain: Desk) -> None:
    folder = plain.session.sequence.path.parent / "theirs"
    folder.mkdir()
    corners = [[30, 20], [60, 20], [60, 50], [30, 50]]
    shape = {"label": "shaft", "points": corners, "shape_type": "polygon", "group_id": None, "flags": {}}
    content = {"version": "3.2.1", "flags": {}, "checked": True, "shapes": [shape], "imagePath": "001.png"}
    content |= {"imageData": None, "imageHeight": 72, "imageWidth": 96}
    (folder / "001.json").write_text(json.dumps(content))
    assert cv2.imwrite(str(folder / "002.png"), np.full((72, 96), 255, np.uint8))
    with pytest.raises(CartsError, match=r"several formats .* Source format"):
        plain.do(intents.ImportMasks("theirs"))
        plain.finish()
    plain.do(intents.ImportMasks("theirs", format="labelme"))
    assert plain.finish().imported == "Imported 1 mask from X-AnyLabeling (shaft)."
    plain.do(intents.ImportMasks("theirs", format="masks"))
    assert "from a folder of masks (shaft, instrument)" in plain.finish().imported


def test_masks_below_an_allowed_folder_are_imported(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    path = tiny_sequence(masks=False)
    folder = path.parent.rename(tmp_path.parent / f"{tmp_path.name}_recording")
    elsewhere = tmp_path.parent / f"{tmp_path.name}_elsewhere"
    elsewhere.mkdir()
    assert cv2.imwrite(str(elsewhere / "001.png"), np.full((72, 96), 255, np.uint8))
    link = tmp_path.parent / f"{tmp_path.name}_link"
    link.symlink_to(elsewhere)
    with ViewerApp.open(folder / path.name, port=0, folders=(link,)) as app:
        app.queue.put(intents.ImportMasks(str(link)))
        assert "Imported 1 mask" in app.wait_until_shown().imported


# ---- What a run fits ------------------------------------------------------------------------------------------------


SIZE = {"width": 160, "height": 128}


@pytest.fixture
def recording(tiny_sequence: Callable[..., Path]) -> Sequence:
    """Two frames of a recording without masks; those that are right lie in its folder."""
    return Sequence.open(tiny_sequence(frames=2, masks=False, **SIZE))


@pytest.fixture
def at_desk(recording: Sequence, tmp_path: Path) -> Desk:
    """A desk whose networks cannot be loaded."""
    desk = Desk.open(recording.path, weights=(tmp_path / "missing.safetensors",))
    desk.do(intents.SetSetting("solver", "surface"))
    return desk


def right_mask(recording: Sequence, index: int = 0) -> np.ndarray:
    path = recording.path.parent / "masks" / "left" / f"{recording.frame_ids[index]}.png"
    return decoded(path.read_bytes()) > 0


def overlap(desk: Desk, recording: Sequence, index: int = 0) -> float:
    pose = desk.session.pose(recording.frame(index, cameras=[]))
    return dice(desk.renderer.mask(pose.scene, "left"), right_mask(recording, index))


def test_imported_masks_are_fitted_without_a_network_and_the_project_keeps_what_was_fitted(
    at_desk: Desk, recording: Sequence
) -> None:
    found = read_annotations(recording.path.parent / "masks" / "left", recording)
    import_annotations(at_desk.session.editor.project, found, source="masks")
    before = overlap(at_desk, recording)
    at_desk.do(intents.SetObserved("masks", "imported"), intents.Run())
    state = at_desk.finish()
    assert before < 0.95 and overlap(at_desk, recording) > 0.97 and state.verdict is not None
    made = at_desk.saved.joints(0)["PSM1"].provenance
    assert made.source is Source.OPTIMIZER and made.weights_sha256 is None
    used = json.loads(made.settings or "")
    assert (used["observe"], used["masks"]) == ("masks", "imported")
    at_desk.do(intents.Solve(True))
    assert at_desk.finish().solve is not None and overlap(at_desk, recording, 1) > 0.97
    assert at_desk.saved.joints(1)["PSM1"].provenance.weights_sha256 is None


def test_what_cannot_be_fitted_is_said(at_desk: Desk) -> None:
    at_desk.do(intents.SetObserved("masks", "imported"))
    with pytest.raises(CartsError, match=r"frame 001 has no imported mask for camera 'left' to fit\. Give a mask"):
        at_desk.do(intents.Run())
    at_desk.do(intents.SetObserved("masks", "recording"))
    with pytest.raises(CartsError, match=r"frame 001 has no mask for camera 'left'"):
        at_desk.do(intents.Run())
    at_desk.do(intents.SetSetting("solver", "acs"))
    with pytest.raises(CartsError, match=r"cannot fit masks\. Choose the solver Surface maps"):
        at_desk.do(intents.Run())
    with pytest.raises(CartsError, match=r"'eyes' is not a target of runs\. Choose one of: network, masks, both"):
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
    assert job.state == "done" and any("001: no mask to fit, not changed" in line for line in job.log)
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


def test_painted_masks_are_the_rendered_ones_as_corrected(at_desk: Desk, recording: Sequence) -> None:
    rendered, wanted = at_desk.renderer.mask(at_desk.state.pose.scene, "left"), right_mask(recording)
    correction = MaskCorrection.of(wanted & ~rendered, rendered & ~wanted)
    at_desk.session.editor.project.apply("Paint", {Key.mask_correction(0, "left"): correction})
    given = at_desk.session.target(at_desk.do(intents.SetObserved("masks", "painted")).observed).given
    assert given is not None and np.array_equal(given.masks(0)["left"], wanted)


def test_a_result_of_an_optimizer_says_which_network_was_run_unless_masks_alone_were_fitted() -> None:
    assert Provenance.made_by_optimizer({"observe": "masks"}, None).weights_sha256 is None
    for settings in ({"observe": "both"}, {}):
        with pytest.raises(CartsError, match="requires its settings and the hash"):
            Provenance.made_by_optimizer(settings, None)


def test_a_data_set_is_exported_from_the_page_with_the_corrections_of_the_project(tmp_path: Path) -> None:
    file, _ = import_recording(lerobot_set(tmp_path / "set"), tmp_path / "sequence")
    desk = Desk.open(file)
    assert "lerobot" in formats_of(desk.session.sequence)
    path = exported(desk, intents.Export("lerobot", "All"))
    rows = pyarrow.parquet.read_table(path / "data/chunk-000/episode_000000.parquet").to_pydict()
    assert path.name == "lerobot" and rows["carts.corrected"] == [False] * 4
    measured = desk.session.sequence.measured["PSM1"]
    np.testing.assert_allclose(rows["carts.joint_positions"], measured, rtol=0, atol=1e-7)
