"""SurgSync's raw clips and packed episodes, with the columns and files that its packer writes."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from recordings import (
    SIZE,
    T_CAMERA_BASE,
    assert_refused,
    copied,
    image,
    jaw_at,
    joints_at,
    pose_of,
    ros_yaml,
    write,
    write_images,
)
from videos import write_video

from carts_core.model.camera import T_DVRK_OPENCV
from carts_core.model.psm_kinematics import forward
from carts_core.recording import Sequence
from carts_core.recording.importing.importer import find, import_recording

FRAMES = 25


def write_calibration(folder: Path, hand_eye: str) -> None:
    folder.mkdir(parents=True)
    for side in ("left", "right"):
        (folder / f"{side}.yaml").write_text(ros_yaml())
    stereo = {"R": np.eye(3).tolist(), "T": [[-5.0], [0.0], [0.0]]}
    (folder / "stereo_calib_params.json").write_text(json.dumps(stereo))
    place = folder / hand_eye
    place.mkdir(parents=True, exist_ok=True)
    for name, T in (("dVRK", T_DVRK_OPENCV @ T_CAMERA_BASE), ("open-cv", T_CAMERA_BASE)):
        entry = {"base-frame": {"reference-frame": "camera", "transform": T.tolist()}}
        (place / f"PSM1-registration-{name}.json").write_text(json.dumps(entry))


def poses(number: int) -> tuple[list[float], list[float]]:
    T = forward(joints_at(number / 30))
    return pose_of(T_DVRK_OPENCV @ T_CAMERA_BASE @ T), pose_of(T)


def episode(folder: Path) -> Path:
    for side in ("left", "right"):
        write_video(folder / f"video_raw/stereo_{side}.mkv", [image(n, side) for n in range(FRAMES)], 30)
    both = [poses(number) for number in range(FRAMES)]
    columns = {
        "frame_index": list(range(FRAMES)),
        "measured_js.position": [joints_at(number / 30).tolist() for number in range(FRAMES)],
        "measured_cp.position": [pose[:3] for pose, _ in both],
        "measured_cp.orientation": [pose[3:] if row else None for row, (pose, _) in enumerate(both)],
        "local_measured_cp.position": [pose[:3] for _, pose in both],
        "local_measured_cp.orientation": [pose[3:] for _, pose in both],
        "setpoint_cp.position": pyarrow.nulls(FRAMES, pyarrow.list_(pyarrow.float32())),
        "jaw.measured_position": [float(jaw_at(number / 30)) for number in range(FRAMES)],
    }
    pyarrow.parquet.write_table(pyarrow.table(columns), folder / "PSM1.parquet")
    write_calibration(folder / "calibration", "hand_eye")
    return folder


def clip(folder: Path) -> Path:
    for side in ("left", "right"):
        write_images(folder / "image" / side, FRAMES, "{}.png", side)
    (folder / "kinematic/PSM1").mkdir(parents=True)
    for number in range(FRAMES):
        seen, local = poses(number)
        measured = {
            "measured_js": {"position": joints_at(number / 30).tolist(), "velocity": [0] * 6, "effort": [0] * 6},
            "measured_cp": {"position": seen[:3], "orientation": seen[3:]},
            "local_measured_cp": {"position": local[:3], "orientation": local[3:]},
        }
        jaw = {"measured_data": {"position": [float(jaw_at(number / 30))]}}
        content = [{"arm": {"measured_data": measured, "setpoint_data": {}}, "jaw": jaw, "measured_frequency": 100.0}]
        (folder / f"kinematic/PSM1/{number}.json").write_text(json.dumps(content))
    write_calibration(folder / "camera_calibration", "../hand_eye_calibration")
    return folder


@pytest.mark.parametrize("make", [episode, clip])
def test_clips_and_episodes_bring_joints_jaw_calibration_and_hand_eye(tmp_path, make: Callable[[Path], Path]):
    file, found = import_recording(make(tmp_path / "source"), tmp_path / "out")
    sequence = Sequence.open(file)
    assert len(sequence) == FRAMES
    frame = sequence.frame(11)
    assert np.abs(frame.measured["PSM1"][:6] - joints_at(11 / 30)).max() < 1e-8
    assert frame.measured["PSM1"][6] == pytest.approx(float(jaw_at(11 / 30)), abs=1e-6)
    assert frame.images["left"].shape == (SIZE[1], SIZE[0], 3)
    left, right = sequence.scene.cameras
    assert left.intrinsics == pytest.approx((110, 110, 48, 36)) and left.distortion[0] == -0.1
    assert np.allclose(right.T_camera_world[:3, 3], [-0.005, 0, 0])
    assert np.allclose(sequence.scene.arms[0].T_world_base, T_CAMERA_BASE)
    assert any("are consistent with a 9.1 mm wrist" in str(note) for note in found.notes)
    assert not [note for note in found.notes if note.kind == "missing"]


def test_frames_without_kinematics_are_left_out(tmp_path):
    path = clip(tmp_path / "source")
    (path / "kinematic/PSM1/3.json").unlink()
    assert "3" not in find(path).frame_ids


MUTATIONS: dict[str, tuple[Callable[[Path], Path], Callable[[Path], object], str]] = {
    "no kinematics": (
        episode,
        lambda p: pyarrow.parquet.write_table(pyarrow.table({"frame_index": [0]}), p / "PSM1.parquet"),
        "has no kinematics of PSM1",
    ),
    "no videos": (episode, lambda p: [f.unlink() for f in (p / "video_raw").iterdir()], "has neither video_raw"),
    "broken registration": (
        episode,
        write("calibration/hand_eye/PSM1-registration-open-cv.json", "{"),
        "is not readable JSON",
    ),
    "broken extrinsics": (episode, write("calibration/stereo_calib_params.json", "{"), "JSON"),
    "cut JSON": (clip, write("kinematic/PSM1/2.json", "[{"), "2.json is not readable JSON"),
    "empty list": (clip, write("kinematic/PSM1/2.json", "[]"), "not the kinematics of a frame"),
    "other names": (clip, write("kinematic/PSM1/2.json", '[{"a": 1}]'), "not the kinematics of a frame"),
    "texts": (
        clip,
        write(
            "kinematic/PSM1/2.json", json.dumps([{"arm": {"measured_data": {"measured_js": {"position": ["a"] * 6}}}}])
        ),
        "not the kinematics of a frame",
    ),
    "no files": (clip, lambda p: [f.unlink() for f in (p / "kinematic/PSM1").iterdir()], "has no kinematics of PSM1"),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_broken_recording_is_an_error_in_words(tmp_path, name):
    make, mutate, message = MUTATIONS[name]
    path = copied(make, tmp_path / "source")
    mutate(path)
    assert_refused(path, message)
