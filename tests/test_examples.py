"""The numbered examples run as they stand."""

import subprocess
import sys
from pathlib import Path

import cv2
import pytest

ROOT = Path(__file__).resolve().parents[1]


def test_the_first_example_saves_an_overlay_and_the_loss_falls(tmp_path: Path) -> None:
    picture = tmp_path / "overlay.png"
    command = [sys.executable, str(ROOT / "examples/01_optimize_a_frame.py")]
    sequence = ROOT / "sample_data/sequence/sequence.toml"
    done = subprocess.run([*command, str(sequence), str(picture)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    losses = [float(line.split("loss")[1].split()[0]) for line in done.stdout.splitlines() if "loss" in line]
    assert min(losses) < 0.8 * losses[0]
    image = cv2.imread(str(picture))
    assert image is not None and image.shape == (480, 1280, 3)


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.name)
def test_an_example_is_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 120
