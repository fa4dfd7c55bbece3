"""Import of SurgSync's raw clips and packed episodes."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from recordings import SIZE, T_CAMERA_BASE, assert_refused, copied, jaw_at, joints_at, write
from surgsync_recordings import FRAMES, clip, episode

from carts_core.recording import Sequence
from carts_core.recording.importing.importer import find, import_recording


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
