"""The `carts` command on small sequences, as a user types it."""

import csv
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from carts_core.cli.command_line import main
from carts_core.cli.options import chosen_frames
from carts_core.errors import SettingsError

SCORE_KEYS = {
    *("frame", "camera", "domain", "dice_before", "dice_after", "joint_mae_deg_before", "joint_mae_deg_after"),
    *("iterations", "seconds", "stopped", "joint_std_deg", "base_frame_gain", "verdict", "reason", "not_determined"),
}


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> str:
    return str(tiny_sequence(frames=3, domains=("regular", "smoke"), width=160, height=128))


def test_evaluate_writes_scores_of_every_frame_into_a_folder_that_it_makes(sequence: str, tmp_path: Path) -> None:
    file = tmp_path / "scores" / "out.json"
    chosen = ["--domain", "all", "--frames", "001,003", "--settings", "iterations=2"]
    main(["evaluate", sequence, "--json", str(file), *chosen])
    scores = json.loads(file.read_text())
    found = [(s["frame"], s["domain"]) for s in scores["frames"]]
    assert found == [(frame, domain) for domain in ("regular", "smoke") for frame in ("001", "003")]
    assert all(set(score) == SCORE_KEYS for score in [*scores["frames"], scores["mean"]])
    first = scores["frames"][0]
    assert first["camera"] == "left" and first["iterations"] <= 2 and first["stopped"] in ("iterations", "converged")
    assert first["joint_mae_deg_before"] == pytest.approx(0.573, abs=0.001)
    assert 0.5 < first["dice_before"] < 1 and 0.5 < first["dice_after"] <= 1
    assert 0 < scores["mean"]["iterations"] <= 2 and scores["mean"]["frame"] is None


def test_evaluate_without_truth_gives_null(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    path, file = tiny_sequence(frames=1, masks=False, truth=False), tmp_path / "out.json"
    main(["evaluate", str(path), "--json", str(file), "--solver", "none"])
    (score,) = json.loads(file.read_text())["frames"]
    assert score["dice_before"] is None and score["joint_mae_deg_after"] is None


def test_an_optimization_from_a_perturbed_start_begins_that_far_off_the_truth(sequence: str, tmp_path: Path) -> None:
    main(["optimize", sequence, "--output", str(tmp_path / "out"), "--perturb-deg", "2", "--solver", "none"])
    rows = csv.DictReader((tmp_path / "out" / "regular" / "left" / "kinematics.csv").open())
    truth = csv.DictReader((tmp_path / "truth.csv").open())
    off = [float(row["PSM1.yaw"]) - float(true["yaw"]) for row, true in zip(rows, truth, strict=True)]
    assert [abs(math.degrees(angle)) for angle in off] == pytest.approx([2.0] * 3, abs=1e-3)


def test_a_start_that_was_kept_is_told(sequence: str, tmp_path: Path, said: Callable[[], str]) -> None:
    file = tmp_path / "out.json"
    main(["evaluate", sequence, "--frames", "001", "--perturb-deg", "0.001", "--json", str(file)])
    assert "left: 1 of 1 run kept the initial values" in said()
    (score,) = json.loads(file.read_text())["frames"]
    assert score["stopped"] == "start kept"


def test_optimize_writes_masks_and_kinematics_and_resumes(
    sequence: str, tmp_path: Path, said: Callable[[], str]
) -> None:
    command = ["optimize", sequence, "--output", str(tmp_path / "out"), "--settings", "iterations=2"]
    main([*command, "--frames", "001-002"])
    folder = tmp_path / "out" / "regular" / "left"
    first = (folder / "masks" / "001.png").stat().st_mtime_ns
    main(command)
    assert "2 of 3 frames already done" in said()
    assert (folder / "masks" / "001.png").stat().st_mtime_ns == first
    with (folder / "kinematics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == ["001", "002", "003"]
    assert "PSM1.wrist_yaw" in rows[0] and rows[0]["source"] == "optimized"
    mask = cv2.imread(str(folder / "masks" / "003.png"), cv2.IMREAD_GRAYSCALE)
    assert mask is not None and mask.shape == (128, 160) and set(mask.flatten().tolist()) == {0, 255}
    assert not list(folder.rglob(".*"))


@pytest.mark.parametrize("mode", ["frame", pytest.param("sequence", marks=pytest.mark.slow)])
def test_cameras_that_look_together_share_a_table_and_have_masks_of_their_own(
    tiny_sequence: Callable[..., Path], tmp_path: Path, said: Callable[[], str], mode: str
) -> None:
    stereo = str(tiny_sequence(frames=2, cameras=("left", "right"), width=160, height=128))
    quick = ["--output", str(tmp_path), "--settings", "iterations=2"]
    command = ["optimize", stereo, "--together", "--mode", mode, *quick]
    main(command)
    folder = tmp_path / "regular" / "left+right"
    rows = list(csv.DictReader((folder / "kinematics.csv").open()))
    assert [row["frame"] for row in rows] == ["001", "002"]
    files = [folder / "masks" / camera / f"{row['frame']}.png" for camera in ("left", "right") for row in rows]
    assert sorted((folder / "masks").rglob("*.png")) == files
    one, other = (cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in (files[0], files[2]))
    assert one is not None and other is not None
    assert (one > 0).any() and (other > 0).any() and (one != other).any()

    main(command)
    assert "2 of 2 frames already done" in said()
    files[3].unlink()
    main(command)
    assert files[3].is_file(), "a frame without one of its masks is done again"


def test_evaluate_corrects_frames_together_in_sequence_mode(sequence: str, tmp_path: Path) -> None:
    file = tmp_path / "out.json"
    main(["evaluate", sequence, "--mode", "sequence", "--perturb-deg", "1", "--json", str(file)])
    scores = json.loads(file.read_text())["frames"]
    assert [score["frame"] for score in scores] == ["001", "002", "003"]
    assert scores[0]["stopped"] == "cold" and scores[1]["stopped"] in ("warm", "cold", "carried")
    assert all(score["joint_mae_deg_before"] == pytest.approx(1.0, abs=1e-3) for score in scores)
    assert all(0 < score["joint_std_deg"] < 3 for score in scores)


def test_optimize_in_sequence_mode_keeps_keyframes_and_writes_deviations(
    sequence: str, tmp_path: Path, said: Callable[[], str], refused: Callable[..., str]
) -> None:
    output = ["--output", str(tmp_path / "out")]
    command = ["optimize", sequence, "--mode", "sequence", *output]
    table = tmp_path / "out" / "regular" / "left" / "kinematics.csv"
    main(command)
    rows = list(csv.DictReader(table.open()))
    assert [row["source"] for row in rows] == ["optimized"] * 3
    assert all(0 < float(row["PSM1.yaw.std"]) < 0.1 for row in rows)

    given = tmp_path / "keyframes.csv"
    columns = [name for name in rows[0] if not name.endswith(".std") and name not in ("verdict", "not_determined")]
    values = ["0.01", "-0.02", "0.151", "0.03", "0.02", "0.01", "0.1"]
    given.write_text(",".join(columns) + "\n" + ",".join(["002", "edited", *values]) + "\n")
    main([*command, "--keyframes", str(given), "--overwrite"])
    rows = list(csv.DictReader(table.open()))
    assert [row["source"] for row in rows] == ["optimized", "edited", "optimized"]
    assert [float(rows[1][name]) for name in columns[2:]] == [float(value) for value in values]
    assert float(rows[1]["PSM1.yaw.std"]) == 0
    main([*command, "--keyframes", str(given)])
    assert "3 of 3 frames already done" in said()

    assert "requires --mode sequence" in refused("optimize", sequence, *output, "--keyframes", given)


def test_a_solver_is_chosen_by_its_name(sequence: str, tmp_path: Path) -> None:
    file = tmp_path / "out.json"
    for solver in ("acs", "l1"):
        command = ["evaluate", sequence, "--solver", solver, "--settings", "iterations=2", "--frames", "001"]
        main([*command, "--json", str(file)])
        (score,) = json.loads(file.read_text())["frames"]
        assert (score["iterations"], score["stopped"]) == (2, "iterations")


def test_all_settings_are_printed_as_a_file_and_explained_on_request(
    sequence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Callable[..., str]
) -> None:
    main(["evaluate", sequence, "--print-settings"])
    path = tmp_path / "settings.toml"
    path.write_text(capsys.readouterr().out, encoding="utf-8")
    main(["evaluate", sequence, "--settings", str(path), "iterations=1", "--frames", "001"])
    capsys.readouterr()
    main(["evaluate", "--help-all"])
    text = capsys.readouterr().out
    assert "prior_deg = 2.5: Expected error of a joint position" in text and "RandomRestart: " in text
    assert "--print-settings is available for" in refused("render", sequence, "--print-settings")


def test_an_optimization_that_cannot_be_done_leaves_nothing_behind(
    sequence: str, tmp_path: Path, refused: Callable[..., str]
) -> None:
    for arguments, message in (
        (["--arms", "PSM9"], "there is no arm 'PSM9'"),
        (["--locked-joints", "elbow"], "locked joint 'elbow' does not exist"),
        (["--extrinsics", "--settings", 'free.locked_cameras=["third"]'], "there is no camera 'third'"),
        (["--no-joints"], "no parameter is free"),
        (["--domain", "regular", "fog"], "domain 'fog' is not in"),
        (["--mode", "sequence", "--keyframes", "nowhere.csv"], "nowhere.csv is not a readable kinematics table"),
        (["--mode", "sequence", "--solver", "acs"], "requires --solver surface"),
        (["--mode", "sequence", "--solver", "none"], "requires --solver surface"),
    ):
        assert message in refused("optimize", sequence, "--output", tmp_path / "out", *arguments)
        assert not (tmp_path / "out").exists()


def test_results_are_replaced_by_frames_and_not_by_an_error(
    sequence: str, tmp_path: Path, refused: Callable[..., str]
) -> None:
    command = ["optimize", sequence, "--output", str(tmp_path / "out"), "--frames", "001", "--settings", "iterations=1"]
    main([*command, "--domain", "smoke"])
    folder = tmp_path / "out" / "smoke" / "left"
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    another = Path(sequence).with_name("another.toml")
    shutil.copy(sequence, another)
    refused(*command, "--domain", "smoke", "--overwrite", "--arms", "PSM9")
    text = refused(*command[:1], another, *command[2:], "--domain", "all")
    assert "smoke/left holds results of another or an unknown sequence" in text
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    assert not (tmp_path / "out" / "regular").exists(), "the first domain is not begun if the second is refused"


def test_render_writes_a_picture_per_frame(sequence: str, tmp_path: Path) -> None:
    for style in ("overlay", "image", "mask"):
        main(["render", sequence, "--style", style, "--output", str(tmp_path / style)])
        pictures = sorted((tmp_path / style / "regular" / "left").glob("*.png"))
        assert [picture.name for picture in pictures] == ["001.png", "002.png", "003.png"]
        image = cv2.imread(str(pictures[0]))
        assert image is not None and image.shape == (128, 160, 3) and image.std() > 1


def test_bad_input_ends_with_a_message_and_status_2(sequence: str, refused: Callable[..., str]) -> None:
    assert "nowhere.toml" in refused("evaluate", "nowhere.toml")
    for arguments, message in (
        (["--domain", "fog"], "domain 'fog' is not in"),
        (["--camera", "third"], "there is no camera 'third'. The cameras are: left"),
        (["--arms", "psm1"], "there is no arm 'psm1'. The arms are: PSM1. Did you mean 'PSM1'?"),
        (["--camera", "lfet"], "Did you mean 'left'?"),
        (["--frames", "7"], "--frames 7: there is no '7'"),
        (["--weights", "nowhere.safetensors"], "nowhere.safetensors"),
        (["--device", "abacus"], "'abacus' does not exist on this machine. Available: cpu"),
    ):
        assert message in refused("evaluate", sequence, *arguments)


def test_scores_go_to_the_standard_output_alone_where_that_is_asked_for(
    sequence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["evaluate", sequence, "--solver", "none", "--frames", "001", "--json", "-"])
    printed = capsys.readouterr()
    assert [score["frame"] for score in json.loads(printed.out)["frames"]] == ["001"]
    assert "tiny: 1 frame, means" in printed.err
    # Progress is printed from the start, also where the output is a pipe.
    lines = printed.err.splitlines()
    assert lines[0] == "carts evaluate: starting" and "optimizing: 0 of 1" in lines
    main(["import"])
    kinds = capsys.readouterr().out
    assert "dvrk: a session of the dVRK's recorder" in kinds and "surgpose:" in kinds


def test_completion_knows_commands_and_options(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--tyro-print-completion", "bash"])
    printed = capsys.readouterr().out
    assert stop.value.code in (0, None) and "import-masks" in printed and "--perturb-deg" in printed


IDS = ["001", "002", "a-1", "a-2", "010"]
"""Of frames, in the recording's order."""


def test_frames_are_chosen_by_id_and_by_position_counted_from_1() -> None:
    for frames, positions, expected in (
        (None, None, [0, 1, 2, 3, 4]),
        ("all", None, [0, 1, 2, 3, 4]),
        ("010", None, [4]),
        ("001-a-1,010", None, [0, 1, 2, 4]),
        ("a-1-a-2", None, [2, 3]),
        ("a-1", None, [2]),
        ("::2", None, [0, 2, 4]),
        (None, "1-2,5", [0, 1, 4]),
        (None, "::3", [0, 3]),
    ):
        assert chosen_frames(frames, positions, IDS) == expected, (frames, positions)


@pytest.mark.parametrize(
    ("frames", "positions", "message"),
    [
        ("", None, "there is no ''"),
        ("a", None, "there is no 'a'"),
        ("011", None, "there is no '011'"),
        ("2", None, r"there is no '2'\. Did you mean '002'\? .* 001 to 010"),
        ("-1", None, "there is no '1'. Did you mean '001'"),
        ("3:", None, "there is no '3:'"),
        ("001-002,010-001", None, "001 comes before 010. Give 001-010"),
        ("0-1,3", None, r"Earlier versions counted from 0; the equivalent is --frames 001-002,a-2\."),
        (None, "0-2", "there is no '0'. Positions count from 1, as in the viewer; they range from 1 to 5"),
        (None, "6", "there is no '6'"),
        ("001", "1", "mutually exclusive"),
    ],
)
def test_frames_that_mean_nothing_are_refused(frames: str | None, positions: str | None, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        chosen_frames(frames, positions, IDS)
