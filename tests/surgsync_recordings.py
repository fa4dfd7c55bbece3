"""SurgSync's raw clips and packed episodes, with the columns and files that its packer writes."""

import json
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
from recordings import T_CAMERA_BASE, image, jaw_at, joints_at, pose_of, ros_yaml, write_images
from videos import write_video

from carts_core.model.camera import T_DVRK_OPENCV
from carts_core.model.psm_kinematics import forward

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
