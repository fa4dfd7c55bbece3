"""`carts calibrate`, as a user types it, and the sequence file that it writes."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from carts_core.cli.command_line import main
from carts_core.recording import Sequence, calibrated_sequence_file

CAUTION = "Images hardly distinguish a wrong base frame from a constant joint offset"
QUICK = ["--frames", "spread:2", "--settings", "iterations=3"]


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> Path:
    return tiny_sequence(frames=3, cameras=("left", "right"), width=160, height=128)


def test_calibrate_writes_a_sequence_file_that_evaluates_as_reported(
    sequence: Path, tmp_path: Path, said: Callable[[], str]
) -> None:
    output, scores = tmp_path / "a" / "b", tmp_path / "scores.json"
    main(["calibrate", str(sequence), "--output", str(output), *QUICK])
    assert said().count(CAUTION) == 1
    names = {"sequence.toml", "calibration.json", "README.md", "frames.png", "unknowns.png", "export.json"}
    assert {path.name for path in output.iterdir()} == names
    before, after = Sequence.open(sequence), Sequence.open(output / "sequence.toml")
    content = json.loads((output / "calibration.json").read_text())
    assert [frame["frame"] for frame in content["frames"]] == ["001", "003"]
    base = content["arms"]["PSM1"]["T_world_base"]
    assert np.allclose(base["after"], after.scene.arms[0].T_world_base, atol=1e-9)
    assert not np.allclose(base["before"], base["after"]) and base["rotation_deg"] > 0
    assert np.array_equal(before.scene.cameras[0].T_camera_world, after.scene.cameras[0].T_camera_world)
    assert {unknown["unit"] for unknown in content["unknowns"]} == {"deg", "mm"}
    assert len(content["unknowns"]) == 12 and all(unknown["deviation"] > 0 for unknown in content["unknowns"])
    arguments = ["--frames", "001,003", "--camera", "right", "--solver", "none", "--json", str(scores)]
    main(["evaluate", str(output / "sequence.toml"), *arguments])
    evaluated = [frame["dice_before"] for frame in json.loads(scores.read_text())["frames"]]
    assert evaluated == pytest.approx([frame["dice_after"]["right"] for frame in content["frames"]], abs=1e-6)
    page = (output / "README.md").read_text()
    assert "| T_world_base of PSM1 |" in page and "| 003 |" in page
    assert page.count(CAUTION) == 1


def test_a_calibration_that_moved_nothing_says_so(sequence: Path, tmp_path: Path, said: Callable[[], str]) -> None:
    main(["calibrate", str(sequence), "--output", str(tmp_path / "out"), *QUICK[:3], "iterations=1"])
    page = (tmp_path / "out" / "README.md").read_text()
    for text in (page, said()):
        assert "The initial calibration was kept" in text and CAUTION not in text
    assert "| pose |" not in page


def test_intrinsics_and_joints_are_free_on_request(sequence: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    free = ["--no-base-frames", "--no-extrinsics", "--intrinsics", "--joints", "--camera", "left"]
    main(["calibrate", str(sequence), "--output", str(output), *QUICK, *free])
    before, after = Sequence.open(sequence), Sequence.open(output / "sequence.toml")
    assert before.scene.cameras[0].intrinsics != after.scene.cameras[0].intrinsics
    assert before.scene.cameras[1].intrinsics == after.scene.cameras[1].intrinsics
    assert np.array_equal(before.measured["PSM1"], after.measured["PSM1"])
    assert CAUTION not in (output / "README.md").read_text()
    units = [unknown["unit"] for unknown in json.loads((output / "calibration.json").read_text())["unknowns"]]
    assert units == ["%", "%", "px", "px"]


def test_bad_input_leaves_nothing_behind(sequence: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    for arguments, message in (
        (["--frames", "spread:0"], "selects no frame"),
        (["--frames", "7"], "--frames 7: there is no '7'"),
        (["--no-base-frames", "--no-extrinsics"], "no calibration parameter is free"),
        (["--settings", "prior_deg=0"], "prior_deg is 0"),
        (["--camera", "third"], "there is no camera 'third'"),
        (["--domain", "fog"], "no domain 'fog'"),
    ):
        assert message in refused("calibrate", sequence, "--output", tmp_path / "out", *arguments)
        assert not (tmp_path / "out").exists() and not list(tmp_path.glob(".carts-*"))


def test_a_moved_sequence_file_keeps_references_comments_and_absolute_paths(sequence: Path, tmp_path: Path) -> None:
    text = sequence.read_text()
    scene = Sequence.open(sequence).scene
    matrices = {camera.name: camera.T_camera_world.tolist() for camera in scene.cameras}
    (sequence.parent / "calibration.json").write_text(json.dumps(matrices))
    absolute = sequence.parent / "elsewhere.csv"
    shutil.copy(sequence.parent / "kinematics.csv", absolute)
    lines = []
    cameras = iter(matrices)
    for line in text.splitlines():
        if line.startswith("T_camera_world"):
            lines.append(f'T_camera_world = "calibration.json#{next(cameras)}"  # by hand')
        else:
            lines.append(line.replace('"kinematics.csv"', f'"{absolute}"'))
    sequence.write_text("\n".join(lines))
    before = Sequence.open(sequence)
    T = before.scene.cameras[0].T_camera_world.copy()
    T[0, 3] += 0.001
    left = replace(before.scene.cameras[0], T_camera_world=T, intrinsics=(190.0, 191.0, 80.0, 64.0))
    after = replace(before.scene, cameras=(left, before.scene.cameras[1]))
    folder = tmp_path / "deep" / "er"
    folder.mkdir(parents=True)
    written = calibrated_sequence_file(sequence, folder, before.scene, after)
    (folder / "s.toml").write_text(written)
    assert str(absolute) in written and '"../../calibration.json#right"  # by hand' in written
    opened = Sequence.open(folder / "s.toml")
    assert np.allclose(opened.scene.cameras[0].T_camera_world, T, atol=1e-11)
    assert opened.scene.cameras[0].intrinsics == left.intrinsics
    assert opened.scene.cameras[1].intrinsics == before.scene.cameras[1].intrinsics
    assert np.array_equal(opened.frame(1).images["right"], before.frame(1).images["right"])


@pytest.mark.parametrize("name", ["trial #3", "run{1} {{frame}}"])
def test_a_moved_sequence_file_finds_folders_of_awkward_names(sequence: Path, tmp_path: Path, name: str) -> None:
    cameras = Sequence.open(sequence).scene.cameras
    parent = shutil.copytree(sequence.parent, tmp_path.parent / f"{tmp_path.name} copy" / name)
    (parent / "calibration.json").write_text(json.dumps({camera.name: camera.K.tolist() for camera in cameras}))
    shutil.copy(next((parent / "regular/left").iterdir()), parent / "empty_regular.png")
    text = re.sub(
        r"^K = .*", 'K = "calibration.json#LEFT"\nbackground = "empty_{domain}.png"', sequence.read_text(), flags=re.M
    )
    (parent / "sequence.toml").write_text(text.replace("LEFT", "left", 1).replace("LEFT", "right", 1))
    before = Sequence.open(parent / "sequence.toml")
    (tmp_path / "out").mkdir()
    copy = tmp_path / "out" / "sequence.toml"
    copy.write_text(calibrated_sequence_file(before.path, copy.parent, before.scene, before.scene))
    opened, wanted = Sequence.open(copy).frame(1), before.frame(1)
    assert opened.masks is not None and wanted.masks is not None
    for camera in ("left", "right"):
        assert np.array_equal(opened.images[camera], wanted.images[camera])
        assert np.array_equal(opened.masks[camera], wanted.masks[camera])
        assert np.array_equal(Sequence.open(copy).background(camera), before.background(camera))
