"""Names in foreign recordings that try to lead elsewhere: an import writes the folder it announces, nothing else."""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hostile_recording import campaign
from recordings import joints_at, ros_yaml, write_images

FRAMES = 2


def write_source(folder: Path, *, camera: str = "left", columns: tuple[str, str] = ("image", "q"), row: str = "0"):
    """Images, a table and a calibration as a lab has them, with names put in."""
    write_images(folder / "left", FRAMES)
    with (folder / "log.csv").open("w", newline="", encoding="utf-8", errors="replace") as stream:
        writer = csv.writer(stream)
        writer.writerow([columns[0], *(f"{columns[1]}{number}" for number in range(1, 7))])
        for frame, q in enumerate(joints_at(np.arange(FRAMES) / 10)):
            writer.writerow([row if frame == 0 else frame, *map(float, q)])
    text = ros_yaml(name=json.dumps(camera, ensure_ascii=False))
    (folder / "left.yaml").write_text(text, encoding="utf-8", errors="replace")


def as_folder(work: Path, name: str) -> list[str] | None:
    """The recording's own folder has the name, and so has the default output; None where no system allows it."""
    folder = work / name.replace("/", "∕").replace("\0", "")
    try:
        write_source(folder)
    except OSError:
        return None
    return [f"./{folder.name}"]


def as_camera(work: Path, name: str) -> list[str]:
    write_source(work / "source", camera=name)
    return ["source", "--images", name, "source/left"]


def as_camera_folder(work: Path, name: str) -> list[str]:
    write_source(work / "source")
    return ["source", "--images", "left", name]


def as_column(work: Path, name: str) -> list[str]:
    write_source(work / "source", columns=(name, name))
    return ["source"]


def as_frame(work: Path, name: str) -> list[str]:
    write_source(work / "source", row=name)
    return ["source"]


def as_arm(work: Path, name: str) -> list[str]:
    write_source(work / "source")
    return ["source", "--arms", name, "PSM1"]


def as_recorded_file(work: Path, name: str) -> list[str]:
    """A session of the dVRK recorder whose index names other files."""
    folder = work / "source"
    folder.mkdir()
    index = {"videos": [{"file": name, "duration": 1.0}], "rosbag": {"name": name, "duration": 1}}
    (folder / "index.json").write_text(json.dumps(index), encoding="utf-8")
    return ["source"]


def as_output(work: Path, name: str) -> list[str]:
    """What the user types as the output is theirs; a name of a recording may not change it."""
    write_source(work / "source", camera=name, columns=("image", name))
    return ["source", "-o", "out/made", "--calibration", name, "source/left.yaml"]


WAYS: list[Callable[[Path, str], list[str] | None]] = [
    *(as_folder, as_camera, as_camera_folder, as_column, as_frame, as_arm, as_recorded_file, as_output)
]


def attack(work: Path, number: int, name: str) -> tuple[list[list[str]], tuple[str, ...]]:
    """Import a recording with a hostile name."""
    words = WAYS[number % len(WAYS)](work, name)
    if words is None:
        return [], ()
    return [["import", *words]], ("out/made" if "-o" in words else f"{Path(words[0]).name}_sequence",)


def test_hostile_names_to_import(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    assert campaign(tmp_path_factory.mktemp("sandbox"), monkeypatch, 2 * len(WAYS), attack) > 0


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_500_hostile_names_to_import(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    assert campaign(tmp_path_factory.mktemp("sandbox"), monkeypatch, 500, attack) > 50
