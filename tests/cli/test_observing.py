"""`--observe`: what the network sees, given masks, or both."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from carts_core.cli.command_line import BAD_INPUT, main
from carts_core.networks.extractor import FeatureExtractor

CAUTION = "Dice is computed with the fitted masks"


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> Path:
    return tiny_sequence(frames=2, width=160, height=128)


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(*_: object, **__: object) -> None:
        raise AssertionError("a network was loaded")

    monkeypatch.setattr(FeatureExtractor, "load", staticmethod(load))


@pytest.mark.usefixtures("no_network")
def test_masks_are_fitted_without_a_network_and_evaluate_says_what_its_scores_mean(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["evaluate", str(sequence), "--observe", "masks", "--json", str(tmp_path / "scores.json")])
    assert CAUTION in " ".join(capsys.readouterr().out.split())
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["observed"] == "masks" and scores["mean"]["dice_after"] > 0.97
    main(["calibrate", str(sequence), "--observe", "masks", "--output", str(tmp_path / "out"), "--frames", "spread:2"])
    assert CAUTION in " ".join(capsys.readouterr().out.split())
    assert json.loads((tmp_path / "out" / "export.json").read_text())["observed"] == "masks"


def test_a_network_is_loaded_where_it_is_asked_for(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["evaluate", str(sequence), "--frames", "001", "--json", str(tmp_path / "out.json")]
    main([*command, "--observe", "both"])
    assert CAUTION in " ".join(capsys.readouterr().out.split())
    assert json.loads((tmp_path / "out.json").read_text())["mean"]["dice_after"] > 0.97
    main([*command, "--settings", "iterations=1"])
    assert CAUTION not in " ".join(capsys.readouterr().out.split())
    assert json.loads((tmp_path / "out.json").read_text())["observed"] == "network"


@pytest.mark.usefixtures("no_network")
@pytest.mark.parametrize("mode", ["frame", pytest.param("sequence", marks=pytest.mark.slow)])
def test_frames_whose_mask_has_changed_are_optimized_again(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], mode: str
) -> None:
    command = ["optimize", str(sequence), "--observe", "masks", "--mode", mode, "--output", str(tmp_path / "out")]
    file = sequence.parent / "masks" / "left" / "002.png"
    command += ["--settings", "iterations=2"]
    main(command)
    main(command)
    assert "2 of 2 frames already done" in " ".join(capsys.readouterr().out.split())
    mask = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    assert mask is not None
    mask[:40] = 0
    cv2.imwrite(str(file), mask)
    main(command)
    assert "redone: the masks changed" in " ".join(capsys.readouterr().out.split())


@pytest.mark.usefixtures("no_network")
@pytest.mark.parametrize("command", ["optimize", "evaluate", "calibrate"])
def test_a_frame_without_a_mask_is_refused_before_any_is_solved(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    (sequence.parent / "masks" / "left" / "002.png").unlink()
    sequence.write_text(re.sub(r"(?m)^(masks = .*)$", r"\1\nsparse_masks = true", sequence.read_text()))
    output = ["--json", str(tmp_path / "out")] if command == "evaluate" else ["--output", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as stop:
        main([command, str(sequence), "--observe", "masks", "--frames", "001-002", *output])
    said = " ".join(capsys.readouterr().err.split())
    assert stop.value.code == BAD_INPUT and "1 of 2 frames have no mask of camera 'left'" in said and "002" in said
    assert not (tmp_path / "out").exists()


def test_masks_of_some_cameras_are_said_to_be_unused_where_all_look_together(
    tiny_sequence: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tiny_sequence(frames=1, width=160, height=128, cameras=("left", "right"))
    text = path.read_text()
    path.write_text(text[: text.rindex("masks = ")] + text[text.index("\n", text.rindex("masks = ")) + 1 :])
    main(["optimize", str(path), "--observe", "both", "--together", "--output", str(tmp_path / "out"),
          "--settings", "iterations=1"])  # fmt: skip
    assert "has no mask of camera right, so all cameras fitted together" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--observe", "masks", "--solver", "acs"], "--observe masks requires the solver surface"),
        (["--observe", "masks", "--weights", "x.safetensors"], "loads no network, but --weights was given"),
        (["--settings", "free.locked_camera=left"], "locked_camera"),
    ],
)
def test_what_does_not_go_together_is_refused(
    sequence: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", str(sequence), *arguments])
    assert stop.value.code == BAD_INPUT and message in " ".join(capsys.readouterr().err.split())
