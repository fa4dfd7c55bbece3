"""Recordings in which a camera has no image of some frames."""

import json
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest

from carts_core.cli import main
from carts_core.errors import SequenceError, SettingsError
from carts_core.export import Dataset, export, measured_frames
from carts_core.networks import FeatureExtractor
from carts_core.optimization import DescentSolver, FrameOptimizer, SurfaceSolver
from carts_core.recording import Sequence
from carts_core.recording.importing.cameras import Images, united_ids
from carts_core.recording.importing.importer import find
from carts_core.settings.interchange import NO_TABLE, ImportOptions


@pytest.fixture
def sparse(tiny_sequence: Callable[..., Path]) -> Path:
    """Three stereo frames; the second has no right image."""
    path = tiny_sequence(frames=3, cameras=("left", "right"), width=320, height=240)
    sorted((path.parent / "regular" / "right").iterdir())[1].unlink()
    return path


def marked(path: Path) -> Sequence:
    text = path.read_text()
    path.write_text(text.replace('name = "right"', 'name = "right"\nsparse_images = true'))
    return Sequence.open(path)


def test_a_missing_image_needs_the_key_that_the_error_names(sparse: Path) -> None:
    with pytest.raises(SequenceError, match="sparse_images = true"):
        Sequence.open(sparse)
    sequence = marked(sparse)
    assert sequence.frames_of("left") == [0, 1, 2] and sequence.frames_of("right") == [0, 2]
    frame = sequence.frame(1)
    assert frame.missing == ("right",) and not frame.images["right"].any() and frame.images["left"].any()
    assert frame.ignoring(None)["right"].all() and sequence.frame(0).ignoring(None) == {}
    assert sequence.image_file(1, "right") is None and sequence.image_fingerprint(1, "right") == "missing"
    assert sequence.background("right").any()


def test_a_camera_without_any_image_is_an_error(sparse: Path) -> None:
    for file in (sparse.parent / "regular" / "right").iterdir():
        file.unlink()
    with pytest.raises(SequenceError, match="no frame has an image"):
        marked(sparse)


def test_a_frame_is_solved_with_the_cameras_that_have_an_image(sparse: Path) -> None:
    sequence, extractor = marked(sparse), FeatureExtractor.load()
    backgrounds = {name: sequence.background(name) for name in ("left", "right")}
    frame, settings = sequence.frame(1), SurfaceSolver(iterations=8)

    def solved(*cameras: str) -> np.ndarray:
        given = sequence.scene, frame, backgrounds, extractor
        return list(FrameOptimizer(*given, settings=settings, cameras=cameras))[-1].joint_positions()["PSM1"]

    moved = np.abs(solved("left") - frame.measured["PSM1"]).max()
    assert moved > 1e-3 and np.abs(solved("left", "right") - solved("left")).max() < 0.1 * moved
    with pytest.raises(SettingsError, match="has no image of right"):
        solved("right")
    with pytest.raises(SettingsError, match="has no image of right"):
        FrameOptimizer(sequence.scene, frame, backgrounds, extractor, settings=DescentSolver())


def test_commands_leave_out_frames_without_an_image_or_predict_them(
    sparse: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence = marked(sparse)
    assert sequence.with_image(range(3), ["right"]) == [0, 2]
    assert sequence.with_image(range(3), ["left", "right"]) == [0, 1, 2]

    def said(command: str, *options: str) -> str:
        main([command, str(sparse), "--camera", "right", *options])
        return " ".join(capsys.readouterr().out.split())

    quick, out, scores = ["--settings", "iterations=2"], tmp_path / "out", tmp_path / "scores.json"
    left_out = "right: 1 of 3 frames have no image and are left out."
    assert left_out in said("optimize", "--output", str(out), *quick)
    assert sorted(path.name for path in (out / "regular/right/masks").iterdir()) == ["001.png", "003.png"]
    assert "2 of 2 frames already done" in said("optimize", "--output", str(out), *quick)
    assert left_out in said("evaluate", "--json", str(scores), *quick)
    assert [score["frame"] for score in json.loads(scores.read_text())["frames"]] == ["001", "003"]
    assert left_out in said("calibrate", "--output", str(tmp_path / "calibration"), "--frames", "all", *quick)
    predicted = "1 of 3 frames have no image and are predicted from the other frames"
    assert predicted in said("optimize", "--mode", "sequence", "--output", str(tmp_path / "both"), *quick)
    assert len(list((tmp_path / "both/regular/right/masks").iterdir())) == 3
    # Frames without an image need no mask.
    (sparse.parent / "masks/right/002.png").unlink()
    sparse.write_text(sparse.read_text().replace("sparse_images = true", "sparse_images = true\nsparse_masks = true"))
    for mode in ("frame", "sequence"):
        options = ["--observe", "masks", "--mode", mode, *quick]
        assert left_out in said("evaluate", *options)
        said("optimize", "--output", str(tmp_path / mode), *options)
        frames = len(list((tmp_path / mode / "regular/right/masks").iterdir()))
        assert frames == (2 if mode == "frame" else 3)
    with pytest.raises(SystemExit):
        said("calibrate", "--output", str(tmp_path / "none"), "--frames", "002")
    assert "no chosen frame has an image of right" in " ".join(capsys.readouterr().err.split())


def test_videos_of_all_cameras_have_a_picture_of_every_frame(sparse: Path, tmp_path: Path) -> None:
    sequence = marked(sparse)
    folder = export(
        Dataset(sequence, tuple(measured_frames(sequence, range(3))), sequence.scene, "regular"),
        "video",
        tmp_path / "out",
    )
    dark = {}
    for name in ("left", "right"):
        with av.open(str(folder / f"{name}.mp4")) as video:
            dark[name] = [bool(picture.to_ndarray(format="gray").mean() < 20) for picture in video.decode(video=0)]
    assert dark == {"left": [False, False, False], "right": [False, True, False]}


def test_frames_with_one_camera_are_imported(sparse: Path, tmp_path: Path) -> None:
    folder = tmp_path / "raw"
    (sparse.parent / "regular").rename(folder)
    found = find(folder, ImportOptions(source="folder", kinematics=NO_TABLE))
    assert len(found.frame_ids) == 3 and [camera.sparse_images for camera in found.cameras] == [False, True]
    assert any("1 of 3 frames have no image of this camera" in note.text for note in found.notes)


def test_images_with_equal_numbers_are_in_the_order_of_their_names() -> None:
    ids = ("0", "00", "000", "0000", "1", "01", "001")
    given = Images(Path("left"), "{frame}.png", ids, (64, 48))
    wanted = "0", "00", "000", "0000", "001", "01", "1"
    assert united_ids({"left": given}, Path()) == united_ids({"left": given, "right": given}, Path()) == wanted
