"""Base frames from the dVRK's own files, and the way there and back."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from carts_core.errors import SequenceError
from carts_core.model.camera import T_DVRK_OPENCV
from carts_core.recording.importing import read_base_frames

T_CAMERA_BASE = np.eye(4)
T_CAMERA_BASE[:3, :3] = Rotation.from_rotvec([2.0, 0.3, -0.5]).as_matrix()
T_CAMERA_BASE[:3, 3] = 0.1, -0.05, 0.2
DVRK = (T_DVRK_OPENCV @ T_CAMERA_BASE).tolist()
OPENCV = T_CAMERA_BASE.tolist()


def written(folder: Path, name: str, content: object) -> Path:
    path = folder / name
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("PSM1-registration-open-cv.json", {"base-frame": {"reference-frame": "left", "transform": OPENCV}}),
        ("PSM1-registration-dVRK.json", {"base-frame": {"reference-frame": "left", "transform": DVRK}}),
        ("PSM1-registration-dVRK.json", {"base_frame": {"reference_frame": "left", "transform": DVRK}}),
        (
            "console-PSM1.json",
            {"arms": [{"name": "PSM1", "base-frame": {"reference-frame": "left", "transform": DVRK}}]},
        ),
        ("system.json", {"arms": [{"name": "PSM1", "base_frame": {"reference_frame": "left", "transform": DVRK}}]}),
        ("suj-fixed.json", {"arms": [{"name": "PSM1", "measured_cp": DVRK}]}),
    ],
)
def test_every_kind_of_file_gives_the_same_base_frame_in_opencvs_axes(tmp_path, name, content):
    (frame,) = read_base_frames(written(tmp_path, name, content))
    assert frame.arm == "PSM1"
    assert frame.reference == ("" if name.startswith("suj") else "left")
    assert np.allclose(frame.T_camera_base, T_CAMERA_BASE, atol=1e-12)


def test_arms_without_a_base_frame_are_left_out_and_others_keep_their_names(tmp_path):
    arms = [{"name": "MTMR"}, {"name": "PSM2", "measured_cp": DVRK}, {"name": "ECM", "measured_cp": DVRK}]
    assert [frame.arm for frame in read_base_frames(written(tmp_path, "suj.json", {"arms": arms}))] == ["PSM2", "ECM"]


def test_a_file_that_does_not_say_its_axes_is_asked_about(tmp_path):
    path = written(tmp_path, "hand_eye.json", {"base_frame": {"transform": OPENCV}})
    with pytest.raises(SequenceError, match="states the camera axes"):
        read_base_frames(path)
    (frame,) = read_base_frames(path, "opencv")
    assert (frame.arm, frame.reference) == ("", "")
    assert np.allclose(frame.T_camera_base, T_CAMERA_BASE)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[1, 2", "not readable JSON"),
        ("[" * 100_000, "not readable JSON"),
        ('{"arms": []}', "has no base frame"),
        ('{"arms": [{"name": "PSM1", "base_frame": 5}]}', "shape"),
        ('{"arms": [{"name": "PSM1", "base_frame": {"reference_frame": "left"}}]}', "4 rows of 4"),
        (json.dumps({"arms": [{"name": "PSM1", "measured_cp": (10 * np.eye(4)).tolist()}]}), "not rigid"),
    ],
)
def test_other_files_are_refused_in_words(tmp_path, content, message):
    path = tmp_path / "suj.json"
    path.write_text(content)
    with pytest.raises(SequenceError, match=message):
        read_base_frames(path)
