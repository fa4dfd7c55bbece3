"""Results count only as long as what they were made from is the same, and they themselves are whole."""

import csv
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from carts_core.cli.command_line import main
from carts_core.files import locked_folder
from carts_core.networks.weights import read_weights, save_weights
from carts_core.recording.images import ImageFiles
from carts_core.resources import shipped_robot, shipped_weights

Outcome = Callable[..., str]


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path], tmp_path: Path) -> Path:
    """Three small frames of a robot with separate files."""
    shutil.copytree(shipped_robot().parent, tmp_path / "robot")
    robot = tmp_path / "robot" / shipped_robot().name
    return tiny_sequence(
        frames=3, width=160, height=128, edit=lambda text: text.replace('"builtin:psm_lnd"', f'"{robot}"')
    )


@pytest.fixture
def optimize(sequence: Path, tmp_path: Path, said: Callable[[], str]) -> Outcome:
    """Function that runs `carts optimize` without steps and returns its output in one line."""

    def run(*arguments: str) -> str:
        main(["optimize", str(sequence), "--output", str(tmp_path / "out"), "--solver", "none", *arguments])
        return said()

    return run


def replaced(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def image_changed(folder: Path) -> None:
    path = folder / "regular" / "left" / "002.png"
    image = cv2.imread(str(path))
    assert image is not None
    image[0, 0, 0] ^= 1
    cv2.imwrite(str(path), image)


def intrinsics_changed(folder: Path) -> None:
    replaced(folder / "sequence.toml", "K = [[192.0,", "K = [[192.5,")


def distortion_changed(folder: Path) -> None:
    replaced(folder / "sequence.toml", 'name = "left"', 'name = "left"\ndistortion = [0.01, 0.0, 0.0, 0.0]')


def extrinsics_changed(folder: Path) -> None:
    found = re.search(
        r"T_camera_world = .*, ([-\d.e]+)\], \[0\.0, 0\.0, 0\.0, 1\.0\]\]", (folder / "sequence.toml").read_text()
    )
    assert found
    replaced(folder / "sequence.toml", f"{found[1]}], [0.0, 0.0", f"{float(found[1]) + 1e-4}], [0.0, 0.0")


def base_frame_changed(folder: Path) -> None:
    T = np.eye(4)
    T[0, 3] = 1e-4
    replaced(folder / "sequence.toml", "[arms.joints]", f"T_world_base = {T.tolist()}\n[arms.joints]")


def kinematics_row_changed(folder: Path) -> None:
    lines = (folder / "kinematics.csv").read_text().splitlines()
    cells = lines[2].split(",")
    lines[2] = ",".join([*cells[:-1], f"{float(cells[-1]) + 1e-6:.9f}"])
    (folder / "kinematics.csv").write_text("\n".join(lines) + "\n")


def urdf_changed(folder: Path) -> None:
    path = folder / "robot" / shipped_robot().name
    found = re.search(r'upper="([\d.]+)"', path.read_text())
    assert found
    replaced(path, found[0], f'upper="{float(found[1]) + 0.01}"')


def mesh_changed(folder: Path) -> None:
    path = folder / "robot" / "meshes" / "shaft_tube.ply"
    mesh = trimesh.load_mesh(path)
    mesh.vertices[:, 0] *= 1.01
    mesh.export(path)


def test_frames_whose_inputs_changed_are_redone_and_it_is_said_why(optimize: Outcome, tmp_path: Path) -> None:
    optimize()
    for change, printed in (
        (image_changed, "1 of 3 frames redone: the images changed"),
        (intrinsics_changed, "3 of 3 frames redone: the calibration changed"),
        (distortion_changed, "3 of 3 frames redone: the calibration changed"),
        (extrinsics_changed, "3 of 3 frames redone: the calibration changed"),
        (base_frame_changed, "3 of 3 frames redone: the calibration changed"),
        (kinematics_row_changed, "1 of 3 frames redone: the measured joint positions changed"),
        (urdf_changed, "3 of 3 frames redone: the robot changed"),
        (mesh_changed, "3 of 3 frames redone: the robot changed"),
    ):
        change(tmp_path)
        assert printed in optimize(), change.__name__
    assert "3 of 3 frames already done" in optimize()


def test_kept_results_are_recognized_without_decoding_images(
    optimize: Outcome, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replaced(tmp_path / "sequence.toml", 'name = "left"', 'name = "left"\nbackground = "regular/left/001.png"')
    optimize()
    monkeypatch.setattr(ImageFiles, "read", lambda source, index: pytest.fail(f"{source.name(index)} was decoded"))
    assert "3 of 3 frames already done" in optimize()


def test_another_time_offset_has_all_frames_redone(optimize: Outcome, sequence: Path, tmp_path: Path) -> None:
    text = sequence.read_text().replace('frame_id = "{frame:03d}"\n', "")
    frames = '[frames]\ntable = "frames.csv"\nframe_id = "{frame:03d}"\ntime_offset = 0.0\nmax_gap = 0.5\n'
    sequence.write_text(text.replace("[[arms]]", f"{frames}[[arms]]", 1))
    (tmp_path / "frames.csv").write_text("frame,timestamp\n1,0.0\n2,0.5\n3,1.0\n")
    for name in ("kinematics.csv", "truth.csv"):
        with (tmp_path / name).open(newline="") as file:
            rows = list(csv.DictReader(file))
        columns = [column for column in rows[0] if column != "frame"]
        # Rows for a while after the last image, whose joints move on.
        last, moved = rows[-1], {column: float(rows[-1][column]) + 0.01 for column in columns}
        table = [{**row, "time": 0.5 * number} for number, row in enumerate(rows)] + [{**last, **moved, "time": 1.5}]
        with (tmp_path / name).open("w", newline="") as file:
            writer = csv.DictWriter(file, columns, extrasaction="ignore")
            writer.writeheader()
            writer.writerows(table)
    optimize()
    assert "3 of 3 frames already done" in optimize()
    replaced(tmp_path / "sequence.toml", "time_offset = 0.0", "time_offset = 0.25")
    assert "3 of 3 frames redone: the measured joint positions changed" in optimize()
    assert "3 of 3 frames already done" in optimize()


def test_other_settings_have_the_chosen_frames_redone_and_the_others_are_told(
    optimize: Outcome, tmp_path: Path
) -> None:
    optimize()
    folder = tmp_path / "out" / "regular" / "left"
    before = (folder / "masks" / "003.png").read_bytes()
    printed = optimize("--perturb-deg", "2", "--frames", "001-002")
    assert "2 of 2 frames redone: the settings changed" in printed
    assert "results of 1 frame outside of this run are outdated: the settings changed" in printed
    assert (folder / "masks" / "003.png").read_bytes() == before
    assert json.loads((folder / "settings.json").read_text())["perturb_deg"] == 2
    printed = optimize("--perturb-deg", "2")
    assert "2 of 3 frames already done" in printed and "1 of 3 frames redone: the settings changed" in printed


def test_other_weights_have_all_frames_redone(optimize: Outcome, tmp_path: Path) -> None:
    optimize()
    weights = read_weights(shipped_weights()[1])
    next(weights.network.parameters()).data.mul_(1.001)
    save_weights(weights.network, tmp_path / "mine.safetensors", {}, weights.working_size)
    assert "3 of 3 frames redone: the weights changed" in optimize("--weights", str(tmp_path / "mine.safetensors"))


@pytest.mark.slow
def test_in_sequence_mode_one_changed_image_has_all_frames_redone(
    sequence: Path, tmp_path: Path, said: Outcome
) -> None:
    quick = ["--mode", "sequence", "--settings", "iterations=2"]
    command = ["optimize", str(sequence), "--output", str(tmp_path / "out"), *quick]
    main(command)
    image_changed(tmp_path)
    said()
    main(command)
    assert "3 of 3 frames redone: the images changed" in said()
    main([*command, "--frames", "001-002"])
    printed = said()
    assert "2 of 2 frames redone: " in printed and "the frames were solved together with other frames" in printed
    assert "1 frame outside of this run are outdated: the frames were solved together with other frames" in printed


def test_a_damaged_mask_is_made_again(optimize: Outcome, tmp_path: Path) -> None:
    optimize()
    mask = tmp_path / "out" / "regular" / "left" / "masks" / "002.png"
    before = mask.read_bytes()
    for content in (b"", before[:-20], cv2.imencode(".png", np.zeros((128, 160), np.uint8))[1].tobytes(), None):
        if content is None:
            mask.unlink()
        else:
            mask.write_bytes(content)
        printed = optimize()
        assert "2 of 3 frames already done" in printed, content
        assert "1 of 3 frames redone: the masks are missing or damaged" in printed, content
        assert mask.read_bytes() == before


def test_a_row_that_was_altered_and_results_of_unknown_origin_are_redone(optimize: Outcome, tmp_path: Path) -> None:
    optimize()
    folder = tmp_path / "out" / "regular" / "left"
    before = (folder / "kinematics.csv").read_bytes()
    replaced(folder / "kinematics.csv", "002,optimized,0.", "002,optimized,1.")
    assert "1 of 3 frames redone: the rows in the table have changed" in optimize()
    assert (folder / "kinematics.csv").read_bytes() == before
    for content in ("", "[]", '{"format": "carts-results/1", "frames": {"001": {}}}'):
        (folder / "results.json").write_text(content)
        assert "3 of 3 frames redone: the inputs are unknown" in optimize()


def test_overwriting_some_frames_removes_the_others_and_says_so(optimize: Outcome, tmp_path: Path) -> None:
    optimize()
    printed = optimize("--overwrite", "--frames", "001")
    assert "--overwrite removes the results of 2 other frames" in printed
    folder = tmp_path / "out" / "regular" / "left"
    assert [path.name for path in (folder / "masks").iterdir()] == ["001.png"]
    assert list(json.loads((folder / "results.json").read_text())["frames"]) == ["001"]
    assert len((folder / "kinematics.csv").read_text().splitlines()) == 2


def test_a_second_run_into_the_same_folder_is_refused(
    optimize: Outcome, sequence: Path, tmp_path: Path, refused: Outcome
) -> None:
    with locked_folder(tmp_path / "out" / "regular" / "left"):
        text = refused("optimize", sequence, "--output", tmp_path / "out", "--solver", "none")
    assert "another process is writing to" in text and not list((tmp_path / "out").rglob("*.csv"))
    optimize()
