"""Exports of the page: any format, of frames by their review, into the project's folder."""

import json
import zipfile
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
from viewer_canvas import decoded
from viewer_desk import Desk

from carts_core.errors import CartsError, SettingsError
from carts_core.export import FORMATS, ExportFormat, FormatName, read_kinematics_csv
from carts_core.export.formats import FORMATS as REGISTERED
from carts_core.project import (
    Figures,
    FitVerdict,
    JointCorrection,
    Key,
    MaskCorrection,
    Provenance,
    ReviewState,
    Source,
)
from carts_viewer.actions import exchange as exporting
from carts_viewer.actions import intents


def exported(desk: Desk, intent: intents.Export) -> Path:
    """What an export wrote."""
    desk.do(intent)
    assert desk.state.export is not None and desk.state.export.path is None
    path = (desk.finish().export or desk.state.export).path
    assert path is not None
    return path


def read_mask(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image > 0


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_is_written_beside_the_project_and_logged(desk: Desk, name: FormatName) -> None:
    path = exported(desk, intents.Export(name, "All"))
    project = desk.session.editor.project
    assert path.parent == project.path.with_name("sequence_exports")
    assert path.suffix == FORMATS[name].suffix and (path.is_file() if path.suffix else any(path.iterdir()))
    assert [(record.format, record.path, record.frames) for record in project.state.exports] == [(name, str(path), 3)]


def test_an_earlier_export_is_never_replaced(desk: Desk) -> None:
    first, second = (exported(desk, intents.Export("csv", "All")) for _ in range(2))
    assert (first.name, second.name) == ("kinematics.csv", "kinematics-2.csv") and first.is_file()
    folders = [exported(desk, intents.Export("masks", "All", shown_camera=True)) for _ in range(2)]
    assert [folder.name for folder in folders] == ["masks", "masks-2"]


@pytest.mark.parametrize("name", ["masks", "csv"])
@pytest.mark.parametrize("kind", ["folder of exports", "temporary folder", "export", "dangling export"])
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
        with pytest.raises(CartsError, match="sequence_exports is a link, where a folder is needed"):
            exported(desk, intents.Export(name, "All"))
    else:
        folder.mkdir()
        place = folder / {"temporary folder": f".{stem}.part"}.get(kind, stem)
        place.symlink_to(precious.parent if kind != "dangling export" else tmp_path / "home" / "new")
        path = exported(desk, intents.Export(name, "All"))
        assert not path.is_symlink() and path.parent == folder and place.is_symlink()
    assert [path.name for path in precious.parent.iterdir()] == ["thesis.tex"]
    assert precious.read_text() == "years of work"


def test_only_frames_of_the_chosen_review_state_and_camera_are_written(desk: Desk) -> None:
    desk.do(intents.ShowFrame(1), intents.SetReview(ReviewState.ACCEPTED), intents.ShowCamera("right"))
    path = exported(desk, intents.Export("masks", "Accepted", shown_camera=True))
    assert [file.name for file in (path / "binary").iterdir()] == ["right_002.png"]
    with pytest.raises(SettingsError, match="No frame is in this choice"):
        desk.do(intents.Export("masks", "Needs work"))


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


def test_masks_are_those_that_somebody_corrected_and_only_where_they_did(desk: Desk) -> None:
    rendered = desk.renderer.arm_ids(desk.state.pose.scene, "left") >= 0
    added, removed = np.zeros_like(rendered), rendered.copy()
    added[2:6, 3:9] = ~rendered[2:6, 3:9]
    removed[:, : removed.shape[1] // 2] = False
    edit = {Key.mask_correction(0, "left"): MaskCorrection.of(added, removed)}
    desk.session.editor.project.apply("Paint", edit)
    folder = exported(desk, intents.Export("masks", "All")) / "binary"
    expected = (rendered | added) & ~removed
    assert removed.any() and np.array_equal(read_mask(folder / "left_001.png"), expected)
    for name, index, camera in (("right_001", 0, "right"), ("left_002", 1, "left")):
        pose = desk.session.pose(desk.session.sequence.frame(index, cameras=[])).scene
        assert np.array_equal(read_mask(folder / f"{name}.png"), desk.renderer.arm_ids(pose, camera) >= 0)
    coco = exported(desk, intents.Export("coco", "All", images=False)) / "annotations" / "instances_default.json"
    views = json.loads(coco.read_text())["images"]
    assert [(view["frame"], view["camera"]) for view in views if view.get("painted")] == [("001", "left")]
    desk.do(intents.Refresh(), intents.ShowCamera("left"), intents.ExportMask(7))
    _, name, content = desk.delivered[-1]
    shown = decoded(content)
    assert name == "tiny_001_left.png" and np.array_equal(shown > 0, expected)


def test_kinematics_say_where_each_row_comes_from_and_how_sure_it_is(desk: Desk) -> None:
    desk.do(intents.SetJoint("PSM1", 0, 0.2), intents.Released())
    joints = sum(map(len, desk.session.ranges.values()))
    known = JointCorrection((0.1,) * joints, Provenance(Source.PROPAGATED), (0.01,) * (joints - 1) + (None,))
    desk.session.editor.project.apply("Solve", {Key.joints(1, "PSM1"): known})
    rows = read_kinematics_csv(exported(desk, intents.Export("csv", "All")), desk.session.scene)
    assert [row.source for row in rows] == ["edited", "propagated", "measured"]
    assert rows[0].joint_positions["PSM1"][0] == pytest.approx(0.2, abs=1e-6)
    assert rows[1].joint_std is not None and rows[0].joint_std is not None
    assert rows[1].joint_std["PSM1"] == pytest.approx([0.01] * (joints - 1) + [np.nan], nan_ok=True)
    assert np.isnan(rows[0].joint_std["PSM1"]).all()


def test_an_export_is_of_the_project_as_it_was_when_it_began(desk: Desk) -> None:
    desk.do(intents.Export("csv", "All"), intents.SetJoint("PSM1", 0, 0.3), intents.Released())
    export = desk.finish().export
    assert export is not None and export.path is not None
    assert read_kinematics_csv(export.path, desk.session.scene)[0].source == "measured"


@pytest.mark.parametrize("written", [0, 1])
def test_cancelling_leaves_nothing(desk: Desk, monkeypatch: pytest.MonkeyPatch, written: int) -> None:
    monkeypatch.setattr(exporting, "_BIT", 0.0)  # So that it cannot be done already.
    desk.do(intents.Export("coco", "All"))
    desk.advance()
    while desk.state.export is not None and desk.state.export.done < written:
        desk.advance()
    desk.do(intents.CancelExport())
    folder = desk.session.editor.project.path.with_name("sequence_exports")
    assert desk.state.export is None and desk.wait_time() is None
    assert list(folder.glob("*")) == [] and not desk.saved.exports
    exported(desk, intents.Export("coco", "All"))


def test_a_second_export_waits(desk: Desk) -> None:
    desk.do(intents.Export("coco", "All"))
    desk.do(intents.Export("masks", "All"))
    assert [str(job.state) for job in desk.state.jobs] == ["running", "waiting"]
    assert desk.finish().export is not None
    assert [str(job.state) for job in desk.state.jobs] == ["done", "done"]


@pytest.mark.parametrize(
    "intent",
    [
        intents.Export("../../etc", "All"),  # type: ignore[arg-type]
        intents.Export("coco", "Everything"),
        intents.Export("coco", "All", "pixels"),  # type: ignore[arg-type]
    ],
)
def test_what_no_page_of_ours_offers_is_refused(desk: Desk, intent: intents.Export) -> None:
    with pytest.raises(CartsError, match=r"There is no export|This job cannot be queued"):
        desk.do(intent)
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
    client, name, content = desk.delivered[-1]
    with zipfile.ZipFile(BytesIO(content)) as archived:
        assert (client, name) == (4, "coco.zip")
        assert json.loads(archived.read("coco/export.json"))["format"] == "coco"
        assert len(archived.namelist()) == sum(file.is_file() for file in path.rglob("*"))
    table = exported(desk, intents.Export("csv", "All"))
    desk.do(intents.Download(4))
    assert desk.delivered[-1] == (4, "kinematics.csv", table.read_bytes())
    monkeypatch.setattr(exporting, "LARGEST", 10)
    with pytest.raises(CartsError, match="Copy it from there"):
        desk.do(intents.Download(4))
    table.unlink()
    with pytest.raises(CartsError, match="not there any more"):
        desk.do(intents.Download(4))


def test_who_looks_on_read_only_can_export(desk: Desk) -> None:
    reader = desk.reopened(read_only=True)
    assert exported(reader, intents.Export("csv", "All")).is_file() and not reader.saved.exports
