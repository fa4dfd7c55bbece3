"""A camera that moves, in the sequence format."""

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from moving import Motion, swing
from scipy.spatial.transform import Rotation

from carts_core.errors import SequenceError
from carts_core.model.ecm_kinematics import forward
from carts_core.recording import Sequence, calibrated_sequence_file

FRAMES = 4


@pytest.fixture
def moving(tiny_sequence: Callable[..., Path]) -> Path:
    path = tiny_sequence(frames=FRAMES, edit=lambda text: text + 'motion = "ecm.csv"\n')
    swing(FRAMES).write(path.parent / "ecm.csv")
    return path


def with_motion(path: Path, lines: str) -> Path:
    path.write_text(path.read_text().replace('motion = "ecm.csv"', lines))
    return path


def rewrite(path: Path, change: Callable[[list[list[str]]], object]) -> None:
    with path.open() as handle:
        rows = list(csv.reader(handle))
    change(rows)
    with path.open("w", newline="") as handle:
        csv.writer(handle).writerows(rows)


def test_each_frame_knows_where_the_mount_of_its_camera_was(moving: Path) -> None:
    sequence = Sequence.open(moving)
    assert sequence.moving_cameras == ("left",)
    for index, T in enumerate(swing(FRAMES).Ts_world_mount):
        frame = sequence.frame(index)
        assert np.allclose(frame.mounts["left"], np.linalg.inv(T), atol=1e-9)
        state = sequence.scene.state(frame.measured, mounts=frame.mounts)
        expected = sequence.scene.cameras[0].T_camera_world @ np.linalg.inv(T)
        assert np.allclose(state.T_view_world[0].numpy(), expected, atol=1e-6)


def test_poses_of_the_camera_in_the_world_may_be_given_the_other_way_round_and_in_millimetres(moving: Path) -> None:
    Ts = np.linalg.inv(swing(FRAMES).Ts_world_mount)
    Ts[:, :3, 3] *= 1000.0
    Motion(Ts).write(moving.parent / "ecm.csv")
    with_motion(moving, 'motion = { table = "ecm.csv", pose = "T_mount_world", length_unit = "mm" }')
    sequence = Sequence.open(moving)
    for index, T in enumerate(swing(FRAMES).Ts_world_mount):
        assert np.allclose(sequence.mounts(index)["left"], np.linalg.inv(T), atol=1e-9)


def test_joints_of_the_ecm_are_a_motion_as_well(moving: Path) -> None:
    joints = np.column_stack([np.linspace(-0.2, 0.3, FRAMES), np.linspace(0.1, 0.0, FRAMES), [0.12] * 4, [0.4] * 4])
    with (moving.parent / "ecm.csv").open("w", newline="") as handle:
        csv.writer(handle).writerows([["frame", *"abcd"], *([n + 1, *row] for n, row in enumerate(joints.tolist()))])
    with_motion(moving, 'motion = { table = "ecm.csv", ecm_joints = ["a", "b", "c", "d"] }')
    sequence = Sequence.open(moving)
    for index in range(FRAMES):
        T = np.linalg.inv(forward(joints[index]))
        assert np.allclose(sequence.mounts(index)["left"], T, atol=1e-9)


def timed(path: Path, offset: float = 0.0) -> Path:
    """The moving sequence with frames between the rows of its logs."""
    (path.parent / "times.csv").write_text("frame,timestamp\n001,0.05\n002,0.15\n003,0.25\n")
    frames = f'[frames]\ntable = "times.csv"\ntime_offset = {offset}\n[kinematics]'
    text = path.read_text().replace("[kinematics]", frames).replace('frame_id = "{frame:03d}"\n', "")
    path.write_text(text.replace('truth = "truth.csv"', ""))
    swing(FRAMES).write(path.parent / "ecm.csv", np.arange(FRAMES) / 10)
    return path


def test_between_rows_of_a_log_places_and_turns_are_interpolated(moving: Path) -> None:
    sequence = Sequence.open(timed(moving))
    Ts = swing(FRAMES).Ts_world_mount
    for index in range(3):
        T = np.linalg.inv(sequence.mounts(index)["left"])
        assert np.allclose(T[:3, 3], (Ts[index, :3, 3] + Ts[index + 1, :3, 3]) / 2, atol=1e-9)
        back = Ts[index, :3, :3].T
        whole, half = (Rotation.from_matrix(back @ R[:3, :3]) for R in (Ts[index + 1], T))
        assert np.allclose(2 * half.as_rotvec(), whole.as_rotvec(), atol=1e-9)


def test_another_time_offset_moves_the_camera_as_it_moves_the_joints(moving: Path) -> None:
    sequence = Sequence.open(timed(moving)).with_time_offset(0.05)
    Ts = swing(FRAMES).Ts_world_mount
    assert np.allclose(np.linalg.inv(sequence.mounts(1)["left"]), Ts[2], atol=1e-9)


def test_the_background_of_a_moving_camera_is_not_relied_on(moving: Path) -> None:
    found = Sequence.open(moving).mean_background("left")
    assert found.problem is not None and "moves" in found.problem and not found.known.any()


def test_a_calibrated_file_in_another_folder_finds_the_motion(moving: Path) -> None:
    scene = Sequence.open(moving).scene
    for text in (moving.read_text(), with_motion(moving, 'motion = { table = "ecm.csv" }').read_text()):
        moving.write_text(text)
        other = moving.parent / "elsewhere"
        other.mkdir(exist_ok=True)
        (other / "sequence.toml").write_text(calibrated_sequence_file(moving, other, scene, scene))
        assert np.allclose(
            Sequence.open(other / "sequence.toml").mounts(2)["left"], Sequence.open(moving).mounts(2)["left"]
        )


def _set(row: int, column: int, text: str) -> Callable[[list[list[str]]], object]:
    return lambda rows: rows[row].__setitem__(column, text)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows.pop(), "has 3 rows, but the kinematics table has 4"),
        (_set(2, 0, "9"), "line 3 is frame '009', but the kinematics table has frame '002'"),
        (_set(2, 4, "0.9"), "the norm of the quaternion is .* must be 1"),
        (_set(2, 1, "812.5"), "a coordinate of the position is 812.5 m; at most 100 m is allowed.*length_unit"),
        (_set(2, 1, "nan"), "'nan' is not a finite number"),
        (_set(0, 1, "X"), "no column 'x', which .*motion: position"),
    ],
)
def test_impossible_motions_are_refused(
    moving: Path, change: Callable[[list[list[str]]], object], message: str
) -> None:
    rewrite(moving.parent / "ecm.csv", change)
    with pytest.raises(SequenceError, match=message):
        Sequence.open(moving)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ('motion = "other.csv"', "other.csv is missing"),
        ('motion = { table = "ecm.csv", pose = "T_camera_world" }', "must be one of: T_world_mount, T_mount_world"),
        ('motion = { table = "ecm.csv", orientation = ["qx", "qy"] }', "Give the names of 4 columns"),
        ('motion = { table = "ecm.csv", ecm_joints = ["x", "y", "z"] }', "Give the names of 4 columns"),
        ('motion = { table = "ecm.csv", speed = 3 }', "speed is not a key of the format"),
        ('motion = "ecm.csv"\nbackground = "regular/left/001.png"', "cannot be combined with `motion`"),
    ],
)
def test_a_wrong_description_of_the_motion_is_refused(moving: Path, lines: str, message: str) -> None:
    with pytest.raises(SequenceError, match=message):
        Sequence.open(with_motion(moving, lines))
