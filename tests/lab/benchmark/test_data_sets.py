"""SurgPose and SurgSync in the layouts of their owners; SurgPose rendered with known delay, base frame and dots."""

import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
import yaml
from optimization.perfect_predictor import PerfectPredictor
from surgsync_recordings import clip
from swaying import swaying_joints
from tiny import tiny_scene
from videos import write_video

from carts_core.cli import main
from carts_core.errors import CartsError
from carts_core.export.video import image_and_mask
from carts_core.lab.benchmark.data_sets import ArmResult, KeypointError, bench_recording, recordings, table
from carts_core.model.robot import Robot
from carts_core.model.scene import Scene
from carts_core.optimization import FramePredictor
from carts_core.recording import Frame
from carts_core.recording import Sequence as Recording
from carts_core.rendering import Renderer

FRAMES, WIDTH, HEIGHT, RATE, SEED = 240, 320, 240, 30, 3
ROWS_LATE = 6
"""Rows of the kinematics are this many frames late."""
NOISE = 0.1
"""Standard deviation of the published keypoints [px]. With 0.3, triangulated dots alone are 1.6 mm off."""
DOTS = {1: (0, (0.004, 0.0, -0.009)), 2: (1, (0.003, 0.001, 0.003)), 3: (2, (0.0, 0.002, 0.001)), 7: (0, (0, 0.004, 0))}
"""Number -> link and position of a painted dot [m]; 4 and 5 are on the jaws."""


def true_joints(robot: Robot, times: np.ndarray) -> np.ndarray:
    """Joint positions [rad, m] with a closed jaw, which SurgPose does not record."""
    return swaying_joints(robot, times, SEED) * np.array([1, 1, 1, 1, 1, 1, 0])


class Truths:
    """Predicts the true surface maps of each frame of a trajectory."""

    device = torch.device("cpu")

    def __init__(self, scene: Scene, joints: np.ndarray) -> None:
        self.scene, self._joints = scene, joints

    def for_frame(self, frame: Frame, cameras: Sequence[str]) -> FramePredictor:
        """The truth, whatever the images show."""
        truth = self.scene.state({"PSM1": self._joints[frame.index]})
        return PerfectPredictor(SimpleNamespace(scene=self.scene), truth).for_frame(frame, cameras)  # pyright: ignore


def trajectory(folder: Path, robot: Robot) -> Truths:
    """Write a trajectory of SurgPose with one arm; only the left video shows it."""
    scene = tiny_scene(robot, 1, ("left", "right"), WIDTH, HEIGHT).scene
    times, random = np.arange(FRAMES) / RATE, np.random.default_rng(0)
    joints = true_joints(robot, times)
    texture = cv2.resize(random.uniform(60, 200, (30, 40, 3)).astype(np.float32), (WIDTH, HEIGHT)).astype(np.uint8)
    renderer = Renderer(scene, cameras=["left"])
    shown = (image_and_mask(renderer, scene.state({"PSM1": positions})) for positions in joints)
    pictures = [np.where(mask[..., None], picture, texture) for picture, mask in shown]
    write_video(folder / "regular/left_video.mp4", pictures, RATE)
    write_video(folder / "regular/right_video.mp4", [texture] * FRAMES, RATE)
    Ts = scene.arms[0].robot.forward_kinematics(joints)
    for camera in scene.cameras:
        points: dict[int, dict[int, list[float] | None]] = {
            number: {4: [1.0, 1.0], 6: None} for number in range(FRAMES)
        }
        for dot, (link, position) in DOTS.items():
            p = (Ts[:, link] @ [*position, 1.0]) @ camera.T_camera_world.T
            fx, fy, cx, cy = camera.intrinsics
            seen = np.stack([fx * p[:, 0] / p[:, 2] + cx, fy * p[:, 1] / p[:, 2] + cy], 1) - 0.5
            for number, pixel in enumerate(seen + NOISE * random.standard_normal(seen.shape)):
                points[number][dot] = pixel.tolist()
        (folder / f"keypoints_{camera.name}.yaml").write_text(yaml.safe_dump(points))
    late = times - ROWS_LATE / RATE
    rows = true_joints(robot, late)[:, :6]
    rows[:, :2] += np.radians(0.8) * np.sin(late[:, None] * [5.0, 6.0])
    named = {str(number): {"PSM1": row} for number, row in enumerate(rows.tolist())}
    (folder / "api_jp_data.yaml").write_text(yaml.safe_dump(named))
    left, right = scene.cameras
    T = right.T_camera_world @ np.linalg.inv(left.T_camera_world)
    fx, fy, cx, cy = left.intrinsics
    one = f"fc_x={fx}\nfc_y={fy}\ncc_x={cx + 0.5}\ncc_y={cy + 0.5}\nkc_0=0\nkc_1=0\nres_x={WIDTH}\nres_y={HEIGHT}\n"
    turn = "".join(f"R_{index}={value}\n" for index, value in enumerate(T[:3, :3].reshape(-1)))
    shift = "".join(f"T_{index}={1e3 * value}\n" for index, value in enumerate(T[:3, 3]))
    (folder / "StereoCalibrationDVRK.ini").write_text(f"[StereoLeft]\n{one}[StereoRight]\n{one}{turn}{shift}")
    return Truths(scene, joints)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_trajectory_of_surgpose_gets_its_delay_base_frame_and_corrected_joints(
    tmp_path: Path, shipped_psm: Robot
) -> None:
    predictor = trajectory(tmp_path / "SurgPose/000000", shipped_psm)
    (path,) = recordings(tmp_path / "SurgPose", "surgpose")
    (result,) = bench_recording(path, "surgpose", tmp_path / "out", predictor, frames=4)
    assert (result.recording, result.arm, result.hand_eye, result.frames) == ("000000", "PSM1", "keypoints", 4)
    assert result.delay == pytest.approx(ROWS_LATE / RATE, abs=0.01)
    found = Recording.open(tmp_path / "out/calibrated/sequence.toml").scene
    # The world of the import is the left camera.
    T = np.linalg.inv(predictor.scene.cameras[0].T_camera_world) @ found.arms[0].T_world_base
    assert np.degrees(np.arccos((np.trace(T[:3, :3]) - 1) / 2)) < 2.0 and np.linalg.norm(T[:3, 3]) < 0.01
    assert result.measured is not None and result.corrected is not None
    assert result.measured.keypoints == 4 * 2 * len(DOTS)
    assert result.measured.mm is not None and result.corrected.mm is not None
    assert result.corrected.px < 0.5 * result.measured.px and result.corrected.mm < 0.5 * result.measured.mm


def test_surgsync_uses_the_published_hand_eye_calibration_and_has_no_keypoints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clip(tmp_path / "1")
    main(["bench", "surgsync", str(tmp_path), "--output", str(tmp_path / "out"), "--frames", "1", "--frame-rate", "30"])
    (line,) = (tmp_path / "out/table.md").read_text().splitlines()[2:]
    (result,) = json.loads((tmp_path / "out/results.json").read_text())
    assert (result["recording"], result["arm"], result["hand_eye"]) == ("1", "PSM1", "published")
    assert result["delay"] is None and result["measured"] is None and result["rotation_deg"] is not None
    assert line.startswith("| 1 | PSM1 |  | published |  | 1 |") and line in capsys.readouterr().out


def test_the_table_leaves_unknown_values_empty() -> None:
    error = KeypointError(2.5, None, 8)
    result = ArmResult("000003", "PSM1", 0.2, 0.004, None, "keypoints", 1.25, 50, 0.5, 0.25, error, None)
    *_, line = table([result])
    assert line == "| 000003 | PSM1 | 0.200 ± 0.004 | keypoints | 1.25 | 50 | 0.50 | 0.25 | 2.50 |  |  |  |"


def test_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CartsError, match=r"has no recording of surgpose: a folder with api_jp_data\.yaml"):
        recordings(tmp_path, "surgpose")
