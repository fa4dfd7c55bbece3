"""`--observe` and `--masks`: network predictions, masks of the recording, of a project or of files, or both."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from carts_core.cli.command_line import main
from carts_core.cli.optimizing import FrameFolder
from carts_core.errors import SettingsError
from carts_core.networks.extractor import FeatureExtractor
from carts_core.project import IgnoreRegion, Key, MaskCorrection, Project
from carts_core.recording import Sequence
from carts_core.recording.images import read_mask
from carts_core.rendering import Renderer

CAUTION = "Dice is computed with the fitted masks"
SIZE = {"width": 160, "height": 128}
Said = Callable[[], str]
Refused = Callable[..., str]


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> Path:
    """Two frames of a recording without masks; the true ones lie in a folder beside it."""
    return tiny_sequence(frames=2, masks=False, **SIZE)


@pytest.fixture
def masked(tiny_sequence: Callable[..., Path]) -> Path:
    """Two frames of a recording with its masks."""
    return tiny_sequence(frames=2, **SIZE)


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


def paint(sequence: Path, mask: np.ndarray) -> None:
    """Correct the rendered mask of the first frame to this one."""
    opened = Sequence.open(sequence)
    frame = opened.frame(0, cameras=[])
    rendered = Renderer(opened.scene).segment(opened.scene.state(frame.measured))[0] >= 0
    with Project.open(opened) as project:
        correction = MaskCorrection.of(mask & ~rendered, rendered & ~mask)
        project.apply("Paint", {Key.mask_correction(0, "left"): correction})


@pytest.mark.usefixtures("no_network")
def test_masks_of_the_recording_are_fitted_without_a_network_and_made_again_when_they_change(
    masked: Path, tmp_path: Path, said: Said, refused: Refused
) -> None:
    found = scores(masked, "--observe", "masks", "--frames", "001")
    assert CAUTION in said()
    assert found["observed"] == "masks" and found["mean"]["dice_after"] > 0.97
    output = ["--output", str(tmp_path / "out"), "--settings", "iterations=2"]
    command = ["optimize", str(masked), "--observe", "masks", *output]
    main(command)
    main(command)
    assert "2 of 2 frames already done" in said()
    file = masked.parent / "masks" / "left" / "002.png"
    mask = 255 * read_mask(file).astype(np.uint8)
    mask[:40] = 0
    assert cv2.imwrite(str(file), mask)
    main(command)
    assert "redone: the masks changed" in said()
    file.unlink()
    masked.write_text(re.sub(r"(?m)^(masks = .*)$", r"\1\nsparse_masks = true", masked.read_text()))
    for name, option in (("optimize", "--output"), ("evaluate", "--json"), ("calibrate", "--output")):
        place = tmp_path / "not made"
        text = refused(name, masked, "--observe", "masks", "--frames", "001-002", option, place)
        assert "1 of 2 frames have no mask for camera 'left'" in text and "002" in text and not place.exists()


def test_a_network_is_loaded_where_it_is_asked_for(masked: Path, said: Said) -> None:
    assert scores(masked, "--frames", "001", "--observe", "both")["mean"]["dice_after"] > 0.97
    assert CAUTION in said()
    assert scores(masked, "--frames", "001", "--settings", "iterations=1")["observed"] == "network"
    assert CAUTION not in said()


@pytest.mark.usefixtures("no_network")
def test_masks_of_a_folder_are_fitted_and_are_the_truth_where_the_recording_has_none(
    sequence: Path, theirs: Path, said: Said
) -> None:
    found = scores(sequence, "--observe", "masks", "--masks", str(theirs), "--mode", "sequence")
    assert found["observed"] == "masks" and found["masks"] == str(theirs)
    assert found["mean"]["dice_before"] < 0.95 and found["mean"]["dice_after"] > 0.97
    assert f"If the recording has no masks, {CAUTION}" in said()


@pytest.mark.usefixtures("no_network")
def test_a_stopped_run_is_not_resumed_with_measurements_of_other_masks(
    sequence: Path, theirs: Path, tmp_path: Path, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object) -> None:
        raise SettingsError("stopped")

    options = ["--observe", "masks", "--masks", str(theirs), "--mode", "sequence", "--settings", "iterations=2"]
    command = ["optimize", str(sequence), *options, "--output", str(tmp_path / "out")]
    for changed in (False, True):
        with monkeypatch.context() as patch, pytest.raises(SystemExit):
            patch.setattr(FrameFolder, "write", stopped)
            main([*command, "--overwrite"])
        if changed:
            mask = 255 * read_mask(theirs / "002.png").astype(np.uint8)
            mask[:40] = 0
            assert cv2.imwrite(str(theirs / "002.png"), mask)
        main([*command, "--overwrite"])
        assert ("resumed an earlier run" in said()) is not changed


@pytest.mark.usefixtures("no_network")
def test_a_calibration_fits_imported_masks(sequence: Path, theirs: Path, tmp_path: Path, said: Said) -> None:
    main(["import-masks", str(sequence), str(theirs)])
    output = tmp_path / "out"
    main(["calibrate", str(sequence), "--observe", "masks", "--masks", "imported", "--output", str(output)])
    summary = json.loads((output / "export.json").read_text())
    assert (summary["observed"], summary["masks"], summary["weights"]) == ("masks", "imported", "")
    before, after = (float(word) for word in said().split("mean Dice ")[1].split()[0:3:2])
    assert after > before and after > 0.95


@pytest.mark.usefixtures("no_network")
def test_unlabelled_pixels_of_given_masks_are_not_scored(
    sequence: Path, theirs: Path, tmp_path: Path, said: Said
) -> None:
    for file in theirs.iterdir():
        mask = 255 * read_mask(file).astype(np.uint8)
        mask[:, np.median(np.nonzero(mask)[1]).astype(int) :] = 9
        assert cv2.imwrite(str(file), mask)
    (theirs / "labels.json").write_text('{"tool": 255, "ignore": 9}')
    options = ["--observe", "masks", "--masks", str(theirs)]
    assert scores(sequence, *options, "--frames", "001")["mean"]["dice_after"] > 0.95
    said()
    main(["calibrate", str(sequence), *options, "--settings", "iterations=2", "--output", str(tmp_path / "out")])
    assert min(float(word) for word in said().split("mean Dice ")[1].split()[0:3:2]) > 0.8


@pytest.mark.usefixtures("no_network")
def test_a_hand_eye_calibration_from_given_masks_ignores_those_of_the_recording(
    masked: Path, tmp_path: Path, said: Said
) -> None:
    given = shutil.copytree(masked.parent / "masks" / "left", tmp_path / "given")
    for file in (masked.parent / "masks" / "left").iterdir():
        assert cv2.imwrite(str(file), np.zeros((128, 160), np.uint8))
    main(["hand-eye", str(masked), "--masks", str(given), "--output", str(tmp_path / "out")])
    assert "with the masks of 2 frames" in said()


@pytest.mark.usefixtures("no_network")
def test_one_of_two_cameras_with_imported_masks_is_calibrated(
    tiny_sequence: Callable[..., Path], tmp_path: Path, said: Said
) -> None:
    path = tiny_sequence(frames=2, cameras=("left", "right"), masks=False, **SIZE)
    main(["import-masks", str(path), str(path.parent / "masks")])
    options = ["--camera", "left", "--observe", "masks", "--masks", "imported", "--settings", "iterations=2"]
    main(["calibrate", str(path), *options, "--output", str(tmp_path / "out")])
    assert "left: mean Dice" in (text := said()) and "right: mean Dice" not in text


def test_painted_masks_are_fitted_and_frames_without_one_are_named_or_left_to_the_network(
    sequence: Path, theirs: Path, refused: Refused
) -> None:
    paint(sequence, read_mask(theirs / "001.png"))
    found = scores(sequence, "--observe", "masks", "--masks", "painted", "--frames", "001")
    assert found["mean"]["dice_before"] < 0.95 and found["mean"]["dice_after"] > 0.97
    text = refused("evaluate", sequence, "--observe", "masks", "--masks", "painted")
    assert "1 of 2 frames have no painted mask for camera 'left'; the first is frame 002." in text
    assert "--observe both" in text
    found = scores(sequence, "--observe", "both", "--masks", "painted", "--settings", "iterations=2")
    painted, other = found["frames"]
    assert painted["dice_after"] > painted["dice_before"] and other["dice_after"] is None and other["verdict"]


@pytest.mark.slow
@pytest.mark.usefixtures("no_network")
def test_ignored_pixels_of_the_project_and_of_a_label_are_left_out(
    tiny_sequence: Callable[..., Path], tmp_path: Path
) -> None:
    masked = tiny_sequence(frames=1, **SIZE)
    mask = read_mask(masked.parent / "masks" / "left" / "001.png")
    rows, columns = np.nonzero(mask)
    wrong = np.zeros_like(mask)
    wrong[rows.min() : rows.max(), columns.max() - 20 : columns.max() + 40] = True
    options = ("--frames", "001", "--observe", "masks", "--masks")

    def dice(name: str, values: np.ndarray) -> float:
        folder = tmp_path / name
        folder.mkdir()
        assert cv2.imwrite(str(folder / "001.png"), values)
        (folder / "labels.json").write_text('{"tool": 255, "ignore": 9}')
        return scores(masked, *options, str(folder))["mean"]["dice_after"]

    ruined = (255 * (mask | wrong)).astype(np.uint8)
    without, labelled = dice("ruined", ruined), dice("labelled", np.where(wrong, 9, ruined).astype(np.uint8))
    assert labelled > 0.95 > without
    main(["import-masks", str(masked), str(tmp_path / "ruined")])
    assert scores(masked, *options, "imported")["mean"]["dice_after"] == pytest.approx(without, abs=1e-6)
    with Project.open(Sequence.open(masked)) as project:
        project.apply("Ignore", {Key.ignore_region(0, "left"): IgnoreRegion.of(wrong)})
    assert scores(masked, *options, "imported")["mean"]["dice_after"] > 0.95


def test_masks_of_some_cameras_are_said_to_be_unused_where_all_look_together(
    tiny_sequence: Callable[..., Path], tmp_path: Path, said: Said
) -> None:
    path = tiny_sequence(frames=1, cameras=("left", "right"), **SIZE)
    text = path.read_text()
    path.write_text(text[: text.rindex("masks = ")] + text[text.index("\n", text.rindex("masks = ")) + 1 :])
    together = ["--observe", "both", "--together", "--settings", "iterations=1"]
    main(["optimize", str(path), "--output", str(tmp_path / "out"), *together])
    assert "has no mask for camera right, so all cameras fitted together" in said()


def test_what_does_not_go_together_or_is_not_there_is_refused(sequence: Path, tmp_path: Path, refused: Refused) -> None:
    command = "evaluate", sequence
    masks = *command, "--observe", "masks"
    assert "--observe masks requires the solver surface" in refused(*masks, "--solver", "acs")
    assert "loads no network, but --weights was given" in refused(*masks, "--weights", "x.safetensors")
    assert "locked_camera" in refused(*command, "--settings", "free.locked_camera=left")
    assert "--masks painted requires --observe masks or both" in refused(*command, "--masks", "painted")
    absent, missing = f"{tmp_path / 'x.carts'}:painted", str(tmp_path / "missing")
    assert f"--masks {absent} is missing" in refused(*masks, "--masks", absent)
    assert f"--masks {missing} is missing. Give recording, imported, painted" in refused(*masks, "--masks", missing)
    assert "sequence.carts" in refused(*masks, "--masks", "imported")
    assert not sequence.with_suffix(".carts").exists()
    with Project.open(Sequence.open(sequence)):
        text = refused(*masks, "--masks", "imported")
    assert "2 of 2 frames have no imported mask for camera 'left'; the first is frame 001" in text
    strange = tmp_path / "strange"
    strange.mkdir()
    assert cv2.imwrite(str(strange / "other.png"), np.zeros((128, 160), np.uint8))
    assert "matches a frame" in refused(*masks, "--masks", str(strange))
