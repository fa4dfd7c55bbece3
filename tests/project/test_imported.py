"""Masks and keypoints of others, as layers of a project."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from carts_core.cli.command_line import main
from carts_core.errors import ProjectError
from carts_core.project import Key, MaskCorrection, Project, import_annotations
from carts_core.recording import Sequence
from carts_core.recording.annotations import read_annotations

SIZE = 72, 96


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(tiny_sequence(masks=False))


def write_masks(folder: Path, rows: int, value: int = 255, frames: tuple[int, ...] = (1, 2)) -> Path:
    """Masks of some frames, whose uppermost rows are marked."""
    folder.mkdir(parents=True, exist_ok=True)
    for frame in frames:
        mask = np.zeros(SIZE, np.uint8)
        mask[:rows] = value
        assert cv2.imwrite(str(folder / f"{frame:03d}.png"), mask)
    return folder


def marked_rows(project: Project, index: int) -> int:
    layer = project.state.get(Key.imported_mask(index, "left"))
    assert layer is not None
    return int(layer.mask()[:, 0].sum())


def bring_in(project: Project, sequence: Sequence, folder: Path, **options):
    return import_annotations(project, read_annotations(folder, sequence), source=folder.name, **options)


def test_an_import_is_one_step_that_a_restart_keeps_and_undo_takes_back(sequence: Sequence, tmp_path: Path) -> None:
    folder = write_masks(tmp_path / "theirs", 10)
    with Project.open(sequence) as project:
        report = bring_in(project, sequence, folder)
        assert (report.masks, report.keypoints, report.labels, report.changed) == (2, 0, ("instrument",), True)
        assert "Imported 2 masks from a folder of masks (instrument)." in report.sentence()
        assert [step.name for step in project.history()] == ["Import from theirs"]
    with Project.open(sequence) as project:
        layer = project.state.get(Key.imported_mask(0, "left"))
        assert layer is not None and layer.mask()[:10].all() and not layer.mask()[10:].any()
        assert project.state.get(Key.imported_mask(2, "left")) is None
        project.undo()
        assert project.state.get(Key.imported_mask(0, "left")) is None
        assert project.state.get(Key.imported_labels()) is None


def test_what_a_person_painted_stays_as_it_is(sequence: Sequence, tmp_path: Path) -> None:
    painted = MaskCorrection.of(np.eye(*SIZE, dtype=bool), np.zeros(SIZE, bool))
    with Project.open(sequence) as project:
        project.apply("Paint", {Key.mask_correction(0, "left"): painted})
        bring_in(project, sequence, write_masks(tmp_path / "theirs", 10))
        assert project.state.get(Key.mask_correction(0, "left")) == painted


def test_what_was_imported_before_is_replaced_only_where_that_was_said(sequence: Sequence, tmp_path: Path) -> None:
    with Project.open(sequence) as project:
        bring_in(project, sequence, write_masks(tmp_path / "first", 10))
        again = bring_in(project, sequence, tmp_path / "first")
        assert not again.changed and "nothing was changed" in again.sentence()
        other = write_masks(tmp_path / "second", 20, frames=(2, 3))
        before = project.state
        with pytest.raises(ProjectError, match="1 earlier import would be replaced, the first in frame 002"):
            bring_in(project, sequence, other)
        assert project.state is before
        bring_in(project, sequence, other, replace=True)
        assert [marked_rows(project, index) for index in range(3)] == [10, 20, 20]
        project.undo()
        assert marked_rows(project, 1) == 10


def test_labels_of_a_second_source_get_numbers_of_their_own(sequence: Sequence, tmp_path: Path) -> None:
    with Project.open(sequence) as project:
        bring_in(project, sequence, write_masks(tmp_path / "first", 10, value=3, frames=(1,)))
        bring_in(project, sequence, write_masks(tmp_path / "second", 10, value=7, frames=(2,)))
        labels = project.state.get(Key.imported_labels())
        assert labels is not None and labels.names == ("label 3", "label 7")
        layers = [project.state.get(Key.imported_mask(index, "left")) for index in (0, 1)]
        assert [layer and np.unique(layer.labels()).tolist() for layer in layers] == [[0, 1], [0, 2]]


def test_masks_of_no_frame_change_nothing(sequence: Sequence, tmp_path: Path) -> None:
    folder = write_masks(tmp_path / "theirs", 10, frames=(77,))
    with Project.open(sequence) as project:
        with pytest.raises(ProjectError, match=r"matches a frame. Its images are named 'theirs/077.png'.*001, 002"):
            bring_in(project, sequence, folder)
        assert not project.history()


def test_importing_keypoints_leaves_figures_of_a_frame_as_they_are(sequence: Sequence, tmp_path: Path) -> None:
    points = tmp_path / "keypoints_left.yaml"
    points.write_text("1: {1: [10, 20]}\n")
    with Project.open(sequence) as project:
        revision = project.state.revision(0)
        report = import_annotations(project, read_annotations(points, sequence), source=points.name)
        found = project.state.get(Key.imported_keypoints(0, "left"))
        assert found is not None and found.points == (("1", 10.5, 20.5),)
        assert (report.masks, report.keypoints) == (0, 1) and project.state.revision(0) == revision


def test_the_command_imports_masks(sequence: Sequence, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_masks(tmp_path / "theirs", 10)
    main(["import-masks", str(sequence.path), str(tmp_path / "theirs")])
    assert "Imported 2 masks from a folder of masks (instrument)." in capsys.readouterr().out
    write_masks(tmp_path / "theirs", 11)
    with pytest.raises(SystemExit) as ended:
        main(["import-masks", str(sequence.path), str(tmp_path / "theirs")])
    assert ended.value.code == 2 and "--replace" in capsys.readouterr().err
    main(["import-masks", str(sequence.path), str(tmp_path / "theirs"), "--replace"])
    with Project.open(sequence, read_only=True) as project:
        assert len(project.history()) == 2


def test_the_command_asks_for_the_format_where_several_are_possible(
    sequence: Sequence, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_masks(tmp_path / "theirs" / "masks", 10)
    corners = [[0, 0], [96, 0], [96, 20], [0, 20]]
    shape = {"label": "shaft", "points": corners, "shape_type": "polygon", "group_id": None, "flags": {}}
    content = {"version": "5.5.0", "flags": {}, "shapes": [shape], "imagePath": "001.jpg", "imageData": None}
    content |= {"imageHeight": 72, "imageWidth": 96}
    (tmp_path / "theirs" / "001.json").write_text(json.dumps(content))
    arguments = ["import-masks", str(sequence.path), str(tmp_path / "theirs")]
    with pytest.raises(SystemExit):
        main(arguments)
    assert "several formats (labelme, masks)" in capsys.readouterr().err
    main([*arguments, "--format", "labelme"])
    assert "Imported 1 mask from LabelMe (shaft)." in capsys.readouterr().out
    with Project.open(sequence, read_only=True) as project:
        assert marked_rows(project, 0) == 20


def test_the_command_states_whether_it_undistorts(
    tiny_sequence: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tiny_sequence(masks=False, edit=lambda text: text + "distortion = [-0.3, 0.1, 0.0, 0.0]\n")
    write_masks(tmp_path / "theirs", 10, frames=(1,))
    main(["import-masks", str(path), str(tmp_path / "theirs")])
    assert "assumed to be drawn on recorded images" in capsys.readouterr().out
    main(["import-masks", str(path), str(tmp_path / "theirs"), "--replace", "--drawn-on", "undistorted"])
    assert "Remarks" not in capsys.readouterr().out
    with Project.open(Sequence.open(path), read_only=True) as project:
        assert marked_rows(project, 0) == 10
