"""The numbered examples run unchanged, produce the described output, and have a picture in the documentation."""

import re
import runpy
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
from pycocotools.coco import COCO

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def floats(pattern: str, text: str) -> list[float]:
    """What a pattern's group holds at each of its places in a text."""
    return [float(value) for value in re.findall(pattern, text)]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run an example, by its number, in an empty folder, and check its picture; returns its output."""

    def run_example(number: int, *arguments: str) -> str:
        (path,) = (ROOT / "examples").glob(f"{number:02}_*.py")
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr("sys.argv", [str(path), *arguments, "--picture", "picture.png"])
        # Not twice in one process: malloc's settings cannot be taken back.
        monkeypatch.setattr("carts_core.process.tune_process", lambda **_: None)
        runpy.run_path(str(path), run_name="__main__")
        picture = cv2.imread(str(tmp_path / "picture.png"))
        assert picture is not None and picture.std() > 5
        return capsys.readouterr().out

    return run_example


def test_a_frame_is_corrected_and_the_loss_falls(run: Callable[..., str]) -> None:
    losses = floats(r"loss (\S+)", run(1))
    assert min(losses) < 0.2 * losses[0]


@pytest.mark.slow
def test_the_papers_loss_improves_the_mask_and_the_default_improves_it_more(run: Callable[..., str]) -> None:
    printed = run(2, "--iterations", "8")
    start, paper = floats(r"paper +\w+ +Dice (\S+)", printed)
    _, default = floats(r"default +\w+ +Dice (\S+)", printed)
    assert start < paper < default


@pytest.mark.slow
def test_a_second_camera_narrows_the_insertion_down(run: Callable[..., str]) -> None:
    one, both = (floats(r"insertion \+- (\S+) mm", line) for line in run(3).splitlines() if "insertion" in line)
    assert len(one) == len(both) == 2 and sum(both) < sum(one)


def test_frames_that_follow_a_keyframe_are_corrected(run: Callable[..., str]) -> None:
    printed = run(4, "--frames", "2")
    measured, corrected = floats(r"002: (\S+) deg as measured", printed), floats(r"measured, (\S+) deg", printed)
    assert corrected[0] == 0.0 and corrected[1] < 0.2 * measured[0]


def test_a_calibration_brings_the_tip_back(run: Callable[..., str]) -> None:
    before, after = floats(r"tip of psm1 \w+: (\S+) mm", run(5, "--frames", "2"))
    assert before > 10 and after < 1


def test_an_arm_of_ones_own_is_fitted_by_its_silhouette(run: Callable[..., str]) -> None:
    (error,) = floats(r"largest joint error: (\S+) deg", run(6))
    assert error < 2


@pytest.mark.slow
def test_marked_gauze_is_left_out(run: Callable[..., str]) -> None:
    unmarked, marked = floats(r"Dice (\S+),", run(7))
    assert marked > unmarked + 0.01 and marked > 0.98


def test_an_export_reads_back(run: Callable[..., str], tmp_path: Path) -> None:
    run(8, "--frames", "1")
    assert len(COCO(str(tmp_path / "exported/coco/annotations/instances_default.json")).imgs) == 1
    assert len((tmp_path / "exported/kinematics.csv").read_text().splitlines()) == 2


def test_a_batch_writes_a_row_per_frame_and_names_what_it_cannot_read(
    run: Callable[..., str], tmp_path: Path, sample_sequence_path: Path
) -> None:
    printed = run(9, "missing.toml", str(sample_sequence_path), "--domains", "regular")
    assert "left out: " in printed and "missing.toml" in printed
    assert len((tmp_path / "scores.csv").read_text().splitlines()) == 2


@pytest.mark.slow
def test_a_recording_is_synthesized_and_opens(run: Callable[..., str], tmp_path: Path) -> None:
    assert "1 frames in the domains regular, low_brightness, bleeding, smoke" in run(10, "made")
    assert (tmp_path / "made" / "sequence.toml").is_file()


def test_a_mask_with_holes_is_fitted_without_a_network(run: Callable[..., str]) -> None:
    start, fitted = floats(r"Dice (\S+)", run(11))
    assert start < 0.7 and fitted > 0.97


def test_every_example_has_a_picture() -> None:
    folder = ROOT / "docs" / "images" / "examples"
    assert [path for path in EXAMPLES if not (folder / f"{path.stem}.jpg").is_file()] == []
