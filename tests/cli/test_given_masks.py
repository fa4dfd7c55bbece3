"""`--masks`: masks of a project, imported or painted, and those of files, as what is fitted."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from carts_core.cli.command_line import BAD_INPUT, main
from carts_core.networks.extractor import FeatureExtractor
from carts_core.project import IgnoreRegion, Key, MaskCorrection, Project
from carts_core.recording import Sequence
from carts_core.rendering import Renderer

SIZE = {"width": 160, "height": 128}


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> Path:
    """Two frames of a recording without masks; those that are right lie in a folder beside it."""
    return tiny_sequence(frames=2, masks=False, **SIZE)


@pytest.fixture
def theirs(sequence: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(sequence.parent / "masks" / "left", tmp_path / "theirs"))


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(*_: object, **__: object) -> None:
        raise AssertionError("a network was loaded")

    monkeypatch.setattr(FeatureExtractor, "load", staticmethod(load))


def scores(sequence: Path, *arguments: str) -> dict:
    """What `carts evaluate` writes."""
    file = sequence.parent / "scores.json"
    main(["evaluate", str(sequence), "--json", str(file), *arguments])
    return json.loads(file.read_text())


def said(capsys: pytest.CaptureFixture[str]) -> str:
    return " ".join(capsys.readouterr().out.split())


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as stop:
        main(list(arguments))
    assert stop.value.code == BAD_INPUT
    return " ".join(capsys.readouterr().err.split())


def paint(sequence: Path, mask: np.ndarray, index: int = 0) -> None:
    """Correct the rendered mask of a frame so that it is this one."""
    opened = Sequence.open(sequence)
    frame = opened.frame(index, cameras=[])
    rendered = Renderer(opened.scene).segment(opened.scene.state(frame.measured))[0] >= 0
    with Project.open(opened) as project:
        correction = MaskCorrection.of(mask & ~rendered, rendered & ~mask)
        project.apply("Paint", {Key.mask_correction(index, "left"): correction})


def right_mask(theirs: Path, index: int = 0) -> np.ndarray:
    image = cv2.imread(str(theirs / f"{index + 1:03d}.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image > 0


@pytest.mark.usefixtures("no_network")
def test_masks_of_a_folder_are_fitted_and_are_the_truth_where_the_recording_has_none(
    sequence: Path, theirs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = scores(sequence, "--observe", "masks", "--masks", str(theirs), "--mode", "sequence")
    assert found["observed"] == "masks" and found["masks"] == str(theirs)
    assert found["mean"]["dice_before"] < 0.95 and found["mean"]["dice_after"] > 0.97
    assert "Dice is computed with the fitted masks if the recording has no masks" in said(capsys)


@pytest.mark.usefixtures("no_network")
def test_a_calibration_fits_imported_masks(
    sequence: Path, theirs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["import-masks", str(sequence), str(theirs)])
    output = tmp_path / "out"
    main(["calibrate", str(sequence), "--observe", "masks", "--masks", "imported", "--output", str(output)])
    summary = json.loads((output / "export.json").read_text())
    assert (summary["observed"], summary["masks"], summary["weights"]) == ("masks", "imported", "")
    before, after = (float(word) for word in said(capsys).split("mean Dice ")[1].split()[0:3:2])
    assert after > before and after > 0.95


@pytest.mark.usefixtures("no_network")
def test_painted_masks_are_fitted_and_frames_without_one_are_named(
    sequence: Path, theirs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paint(sequence, right_mask(theirs))
    found = scores(sequence, "--observe", "masks", "--masks", "painted", "--frames", "001")
    assert found["mean"]["dice_before"] < 0.95 and found["mean"]["dice_after"] > 0.97
    text = refusal(capsys, "evaluate", str(sequence), "--observe", "masks", "--masks", "painted")
    assert "1 of 2 frames have no painted mask of camera 'left'; the first is frame 002." in text
    assert "--observe both" in text


def test_both_leave_frames_without_a_painted_mask_to_the_network(sequence: Path, theirs: Path) -> None:
    paint(sequence, right_mask(theirs))
    found = scores(sequence, "--observe", "both", "--masks", "painted", "--settings", "iterations=2")
    painted, other = found["frames"]
    assert painted["dice_after"] > painted["dice_before"] and other["dice_after"] is None and other["verdict"]


@pytest.mark.slow
@pytest.mark.usefixtures("no_network")
def test_ignored_pixels_of_the_project_and_of_a_label_are_left_out(
    tiny_sequence: Callable[..., Path], tmp_path: Path
) -> None:
    sequence = tiny_sequence(frames=1, **SIZE)
    mask = right_mask(sequence.parent / "masks" / "left")
    rows, columns = np.nonzero(mask)
    wrong = np.zeros_like(mask)
    wrong[rows.min() : rows.max(), columns.max() - 20 : columns.max() + 40] = True
    masked = ("--observe", "masks", "--masks")

    def dice(name: str, values: np.ndarray) -> float:
        folder = tmp_path / name
        folder.mkdir()
        assert cv2.imwrite(str(folder / "001.png"), values)
        (folder / "labels.json").write_text('{"tool": 255, "ignore": 9}')
        return scores(sequence, *masked, str(folder))["mean"]["dice_after"]

    ruined = (255 * (mask | wrong)).astype(np.uint8)
    without, labelled = dice("ruined", ruined), dice("labelled", np.where(wrong, 9, ruined).astype(np.uint8))
    assert labelled > 0.95 > without
    main(["import-masks", str(sequence), str(tmp_path / "ruined")])
    assert scores(sequence, *masked, "imported")["mean"]["dice_after"] == pytest.approx(without, abs=1e-6)
    with Project.open(Sequence.open(sequence)) as project:
        project.apply("Ignore", {Key.ignore_region(0, "left"): IgnoreRegion.of(wrong)})
    assert scores(sequence, *masked, "imported")["mean"]["dice_after"] > 0.95


def test_what_does_not_go_together_or_is_not_there_is_refused(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command, masks = ("evaluate", str(sequence)), ("--observe", "masks")
    assert "--masks painted requires --observe masks or both" in refusal(capsys, *command, "--masks", "painted")
    absent = f"{tmp_path / 'x.carts'}:painted"
    assert f"--masks {absent} is missing" in refusal(capsys, *command, *masks, "--masks", absent)
    missing = str(tmp_path / "missing")
    assert f"--masks {missing} is missing. Give recording, imported, painted" in refusal(
        capsys, *command, *masks, "--masks", missing
    )
    assert not sequence.with_suffix(".carts").exists()
    assert "sequence.carts" in refusal(capsys, *command, *masks, "--masks", "imported")
    assert not sequence.with_suffix(".carts").exists()
    with Project.open(Sequence.open(sequence)):
        text = refusal(capsys, *command, *masks, "--masks", "imported")
    assert "2 of 2 frames have no imported mask of camera 'left'; the first is frame 001" in text
    strange = tmp_path / "strange"
    strange.mkdir()
    assert cv2.imwrite(str(strange / "other.png"), np.zeros((128, 160), np.uint8))
    assert "matches a frame" in refusal(capsys, *command, *masks, "--masks", str(strange))
