"""`carts live`: a replay on the command line, and its outputs."""

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from carts_core.cli import main
from carts_core.errors import CartsError
from carts_core.live import LiveEstimate, LiveTracker
from carts_core.project import Key, Project
from carts_core.recording import Sequence


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> Path:
    return tiny_sequence(frames=3, width=160, height=128)


def test_a_replay_gives_a_line_for_each_frame_and_a_recording_that_can_be_reviewed(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results, folder = tmp_path / "results.jsonl", tmp_path / "recorded"
    main(["live", str(sequence), "--rate", "0.5", "--output", str(results), "--masks", "--record", str(folder)])
    said = re.sub(r"\s+", " ", capsys.readouterr().err)
    lines = [json.loads(line) for line in results.read_text().splitlines()]
    assert 1 <= len(lines) <= 3 and f"{len(lines)} of " in said and "frames a second" not in said
    assert {line["type"] for line in lines} == {"result"} and all(line["masks"]["left"] for line in lines)
    original, recorded = Sequence.open(sequence), Sequence.open(folder / "sequence.toml")
    assert len(recorded) == len(lines)
    (arm,), (same,) = original.scene.arms, recorded.scene.arms
    assert (same.name, same.robot.base_link, same.robot.joint_names) == (
        arm.name,
        arm.robot.base_link,
        arm.robot.joint_names,
    )
    for number, line in enumerate(lines):
        index = original.frame_ids.index(line["id"])
        one, other = recorded.frame(number), original.frame(index)
        np.testing.assert_array_equal(one.images["left"], other.images["left"])
        np.testing.assert_allclose(one.measured["PSM1"], other.measured["PSM1"], atol=1e-8)
    camera, kept = original.scene.cameras[0], recorded.scene.cameras[0]
    np.testing.assert_allclose(kept.T_camera_world, camera.T_camera_world, atol=1e-9)
    assert kept.intrinsics == pytest.approx(camera.intrinsics)
    if found := [number for number, line in enumerate(lines) if line["verdict"] != "lost"]:
        project = Project.open(recorded, folder / "sequence.carts", read_only=True)
        value = project.state.get(Key.joints(found[0], "PSM1"))
        assert value is not None
        shown = [position for position, _ in lines[found[0]]["joints"]["PSM1"].values()]
        np.testing.assert_allclose(value.joint_positions, shown, atol=1e-9)
        project.close()


def test_a_wrong_option_and_a_folder_that_holds_something_are_refused(
    sequence: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note.txt").write_text("mine")
    os.mkfifo(tmp_path / "unread")
    for arguments, message in (
        (["--source", "replay:3"], "--source 'replay:3' is unknown"),
        (["--source", "socket:port"], "folder:PATH or socket:PORT"),
        (["--source", "socket:70000"], "is unknown"),
        (["--source", "camera:0"], "has no joints. Give the port"),
        (["--rate", "0"], "--rate is 0.0; allowed: above 0"),
        (["--loops", "0"], "--loops is 0; allowed: 1 or more"),
        (["--quiet", "--record", tmp_path / "full"], "exists. Choose a new folder"),
        (["--overlay", tmp_path / "a", tmp_path / "b"], "--overlay gives 2 pipes for 1 camera. Give one for each"),
        (["--overlay", tmp_path / "a"], "is missing. Create it with `mkfifo"),
        (["--overlay", tmp_path / "full"], "is not a pipe. Create one with `mkfifo`"),
        (["--overlay", tmp_path / "unread"], "no program reads it. Start its reader first"),
    ):
        assert message in refused("live", sequence, *arguments)
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["note.txt"]


def test_results_are_on_disk_as_they_come_and_stay_after_an_error(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results, track, lines = tmp_path / "results.jsonl", LiveTracker.track, []
    results.write_text("of an earlier run")

    def tracked(self: LiveTracker, *arguments: Any) -> LiveEstimate:
        lines.append(results.read_text().count("\n"))
        if len(lines) == 3:
            raise CartsError("It ends.")
        return track(self, *arguments)

    monkeypatch.setattr(LiveTracker, "track", tracked)
    with pytest.raises(SystemExit):
        main(["live", str(sequence), "--rate", "0.5", "--loops", "20", "--output", str(results)])
    assert lines == [0, 1, 2] and all("id" in json.loads(line) for line in results.read_text().splitlines())
