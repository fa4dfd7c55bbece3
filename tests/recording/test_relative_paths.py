"""Paths that are relative mean the same at every later moment, the shipped robot's with nothing prepared in a cache."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from pytest import MonkeyPatch

from carts_core.model.robot import Robot
from carts_core.recording import Sequence
from carts_core.resources import shipped_robot


@pytest.fixture
def cold_cache(tmp_path: Path, monkeypatch: MonkeyPatch) -> None:
    monkeypatch.delenv("CARTS_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cold"))


@pytest.fixture
def robot_folder(tmp_path: Path) -> Path:
    """A copy of the shipped robot."""
    return Path(shutil.copytree(shipped_robot().parent, tmp_path / "recordings" / "robots" / "mine"))


@pytest.mark.usefixtures("cold_cache")
def test_a_robot_loads_by_a_relative_path_with_an_empty_cache(robot_folder: Path, monkeypatch: MonkeyPatch):
    monkeypatch.chdir(robot_folder.parent.parent)
    robot = Robot.load("robots/mine/psm_lnd.urdf")
    assert len(robot.meshes) == len(Robot.load(shipped_robot()).meshes)
    assert robot.urdf == robot_folder / "psm_lnd.urdf"


@pytest.mark.usefixtures("cold_cache")
def test_a_sequence_by_a_relative_path_has_its_images_after_the_working_directory_changed(
    tiny_sequence: Callable[..., Path], robot_folder: Path, tmp_path: Path, monkeypatch: MonkeyPatch
):
    mine = "recordings/robots/mine/psm_lnd.urdf"
    path = tiny_sequence(edit=lambda text: text.replace("builtin:psm_lnd", mine))
    monkeypatch.chdir(path.parent.parent)
    sequence = Sequence.open(Path(path.parent.name) / path.name)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert sequence.frame(0).images["left"].any()
    assert sequence.path == path and sequence.scene.arms[0].robot.urdf == robot_folder / "psm_lnd.urdf"


def test_the_described_real_frames_open_by_a_relative_path(shared_dir: Path, monkeypatch: MonkeyPatch):
    monkeypatch.chdir(Path(__file__).parents[2])
    sequence = Sequence.open("tests/sequences/dvrk_stereo.toml")
    assert len(sequence) == 30 and len(sequence.scene.arms[0].robot.meshes) > 5


@pytest.mark.usefixtures("cold_cache")
@pytest.mark.parametrize("layout", ["package beside urdf", "package above", "absolute", "file address"])
def test_meshes_are_found_as_ros_lays_packages_out(robot_folder: Path, monkeypatch: MonkeyPatch, layout: str):
    text = (robot_folder / "psm_lnd.urdf").read_text()
    package = robot_folder.parent / "psm_description"
    (package / "urdf").mkdir(parents=True)
    shutil.move(robot_folder / "meshes", package / "meshes")
    start = {
        "package beside urdf": "package://psm_description/meshes/",
        "package above": "package://psm_description/meshes/",
        "absolute": f"{package}/meshes/",
        "file address": f"file://{package}/meshes/",
    }[layout]
    folder = robot_folder if layout == "package above" else package / "urdf"
    (folder / "arm.urdf").write_text(text.replace('"meshes/', f'"{start}'))
    monkeypatch.chdir(folder.parent)
    assert Robot.load(f"{folder.name}/arm.urdf").meshes
