"""A stream of a camera that moves, on disk."""

import os
import stat
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from moving import swing

from carts_core.errors import OutputError
from carts_core.export.kinematics import read_kinematics_csv
from carts_core.files import OutputPath, synchronize, write_bytes
from carts_core.live.loop import Tracked
from carts_core.live.messages import StreamFrame
from carts_core.live.recorder import Recorder
from carts_core.live.tracker import Effort, LiveEstimate, LiveVerdict
from carts_core.project import Project, Provenance, Source
from carts_core.recording import Sequence

FRAMES = 4


def record(
    sequence: Sequence, folder: Path, poses: list[dict[str, np.ndarray]], verdicts: tuple[LiveVerdict, ...] = ()
) -> Sequence:
    """Record frames whose cameras are at poses, as they were sent, and open what was recorded.

    Joints are said to be .01 (rad, m) from what was measured.
    """
    recorder = Recorder(sequence, ("left",), folder, Provenance(Source.HAND))
    for number, sent in enumerate(poses):
        frame = replace(sequence.frame(number), timestamp=0.1 * number)
        joints = {arm: values + 0.01 for arm, values in frame.measured.items()}
        estimate = LiveEstimate(
            frame.frame_id,
            0.1 * number,
            verdicts[number] if verdicts else LiveVerdict.GOOD,
            Effort.SMALL,
            0.01,
            sequence.scene.state(joints),
            joints,
            {arm: np.full_like(values, 1e-3) for arm, values in joints.items()},
            0.0,
        )
        recorder(Tracked(StreamFrame(frame, sent), estimate, 0.0))
    path = recorder.close()
    assert path is not None
    return Sequence.open(path)


def test_the_motion_of_a_camera_is_recorded(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    sequence = Sequence.open(tiny_sequence(frames=FRAMES))
    T = sequence.scene.cameras[0].T_camera_world
    mounts = np.linalg.inv(swing(FRAMES).Ts_world_mount)
    found = record(sequence, tmp_path / "recorded", [{}, *({"left": T @ moved} for moved in mounts[1:])])
    assert found.moving_cameras == ("left",)
    assert np.allclose(found.mounts(0)["left"], np.eye(4), atol=1e-8)
    for index in range(1, FRAMES):
        assert np.allclose(found.mounts(index)["left"], mounts[index], atol=1e-7)


def test_where_no_frame_came_nothing_is_left(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    sequence = Sequence.open(tiny_sequence(frames=1))
    for _ in range(2):
        assert Recorder(sequence, ("left",), tmp_path / "recorded", Provenance(Source.HAND)).close() is None
        assert not any((tmp_path / "recorded").iterdir())


def test_frames_before_a_write_error_are_recorded_with_their_corrections(
    tiny_sequence: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence, folder = Sequence.open(tiny_sequence(frames=3)), tmp_path / "recorded"

    def full(path: OutputPath, content: bytes, **options: bool) -> None:
        if path.path.name == "000002.png":
            raise OutputError("No space left on device.")
        write_bytes(path, content, **options)

    monkeypatch.setattr("carts_core.live.recorder.write_bytes", full)
    with pytest.raises(OutputError, match=r"No space left.* The 2 frames before this error are in .*recorded"):
        record(sequence, folder, [{}, {}, {}])
    project = Project.open(Sequence.open(folder / "sequence.toml"), folder / "sequence.carts", read_only=True)
    assert [len(project.state.joints(index)) for index in range(2)] == [1, 1]
    project.close()


def test_frames_do_not_wait_for_the_disk_which_has_all_of_them_at_the_end(
    tiny_sequence: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited, fsync, folder, at_the_end = list[str](), os.fsync, tmp_path / "recorded", list[str]()

    def noted(descriptor: int) -> None:
        if threading.current_thread().name == "carts-live-recorder" and stat.S_ISREG(os.fstat(descriptor).st_mode):
            waited.append(os.readlink(f"/proc/self/fd/{descriptor}"))
        fsync(descriptor)

    def synchronized(output: OutputPath) -> None:
        at_the_end.extend(sorted(path.name for path in output.path.rglob("*") if path.is_file()))
        synchronize(output)

    monkeypatch.setattr(os, "fsync", noted)
    monkeypatch.setattr("carts_core.live.recorder.synchronize", synchronized)
    record(Sequence.open(tiny_sequence(frames=2)), folder, [{}, {}])
    assert not waited
    tables = ["camera_left.csv", "corrected.csv", "kinematics.csv", "sequence.toml"]
    assert at_the_end == ["000000.png", "000001.png", *tables]


def test_a_disk_that_fails_at_the_end_is_an_error(
    tiny_sequence: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(output: OutputPath) -> None:
        raise OutputError(f"{output} cannot be written (Input/output error).")

    monkeypatch.setattr("carts_core.live.recorder.synchronize", failing)
    with pytest.raises(OutputError, match=r"Input/output error.* The 2 frames before this error are in .*recorded"):
        record(Sequence.open(tiny_sequence(frames=2)), tmp_path / "recorded", [{}, {}])


def test_a_camera_that_stays_is_recorded_without_a_motion(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    found = record(Sequence.open(tiny_sequence(frames=2)), tmp_path / "recorded", [{}, {}])
    assert not found.moving_cameras and len(found) == 2


def test_verdicts_are_recorded(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    sequence = Sequence.open(tiny_sequence(frames=3))
    said = (LiveVerdict.GOOD, LiveVerdict.DOUBTFUL, LiveVerdict.LOST)
    found = record(sequence, tmp_path / "recorded", [{}, {}, {}], said)
    project = Project.open(found, tmp_path / "recorded" / "sequence.carts", read_only=True)
    verdicts = [project.state.verdict(index) for index in range(3)]
    assert [verdict and verdict.verdict for verdict in verdicts] == ["good", "doubtful", "failed"]
    assert [len(project.state.joints(index)) for index in range(3)] == [1, 1, 0]
    project.close()
    rows = read_kinematics_csv(tmp_path / "recorded" / "corrected.csv", found.scene)
    assert [row.source for row in rows] == ["optimized", "optimized", "measured"]
    assert [row.verdict for row in rows] == ["good", "doubtful", "failed"]
    for index, off in enumerate((0.01, 0.01, 0.0)):
        (values,) = rows[index].joint_positions.values()
        np.testing.assert_allclose(values, found.frame(index).measured["PSM1"] + off, atol=1e-8)
