"""Base frames and camera poses compared with what a camera can see: inverse transforms, other axes, swapped sides."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float

from ...model.camera import T_DVRK_OPENCV
from ...model.psm_kinematics import CLASSIC, JOINT_NAMES, forward
from ...model.robot import Robot
from .found import FoundArm, FoundCamera, Note

_ROWS = 200
_NEAREST, _FARTHEST = 0.01, 0.6
"""[m] Depths at which an endoscope sees an instrument."""
_BORDER = 0.5
"""Share of the image's size by which a tip may be outside, since base frames are some centimetres off."""
_IN_VIEW, _OUT = 0.5, 0.1
"""Shares of rows with the tip in view that are enough, and that are too few."""


def tips_of(arm: FoundArm) -> Float[np.ndarray, "rows 3"]:
    """Places of the tip, or of the last link of another robot, in the base frame [m]."""
    assert arm.values is not None
    if arm.columns[: len(JOINT_NAMES)] == JOINT_NAMES:
        return forward(arm.values[:, : len(JOINT_NAMES)], CLASSIC)[:, :3, 3]
    robot = Robot.load(arm.robot)
    joints = np.zeros((len(arm.values), len(robot.joint_names)))
    for column, name in enumerate(arm.columns):
        joints[:, robot.joint_names.index(name)] = arm.values[:, column]
    return robot.forward_kinematics(torch.from_numpy(joints)).numpy()[:, -1, :3, 3]


def check_in_view(arm: FoundArm, camera: FoundCamera, note: Callable[[Note], None]) -> None:
    """Say where a base frame puts the tip out of view, and another reading of it puts it in view."""
    if arm.values is None or arm.T_world_base is None or camera.intrinsics is None:
        return
    tips = tips_of(arm)[:: max(1, len(arm.values) // _ROWS)]
    if _in_view(tips, arm.T_world_base, camera) > _OUT:
        return
    readings = {
        "its inverse (the camera in the base's frame)": np.linalg.inv(arm.T_world_base),
        "the other axes of the camera (--axes)": T_DVRK_OPENCV @ arm.T_world_base,
        "the inverse with the other axes": np.linalg.inv(T_DVRK_OPENCV @ arm.T_world_base),
        "millimetres for metres": _scaled(arm.T_world_base, 1e-3),
    }
    fitting = [name for name, T in readings.items() if _in_view(tips, T, camera) >= _IN_VIEW]
    if fitting:
        text = f"{arm.name}: the base frame from {arm.base_from} puts the tip where {camera.name} cannot see it"
        note(Note("warning", f"{text}; {' or '.join(fitting)} would fit. Correct the file."))


def _scaled(T: np.ndarray, factor: float) -> np.ndarray:
    result = T.copy()
    result[:3, 3] *= factor
    return result


def _in_view(tips: np.ndarray, T_camera_base: np.ndarray, camera: FoundCamera) -> float:
    """Share of tips that a camera sees."""
    assert camera.intrinsics is not None
    points = tips @ T_camera_base[:3, :3].T + T_camera_base[:3, 3]
    depth = points[:, 2]
    fx, fy, cx, cy = camera.intrinsics
    u = fx * points[:, 0] / np.where(depth > 0, depth, np.nan) + cx
    v = fy * points[:, 1] / np.where(depth > 0, depth, np.nan) + cy
    width, height = camera.size
    inside = (np.abs(u / width - 0.5) < 0.5 + _BORDER) & (np.abs(v / height - 0.5) < 0.5 + _BORDER)
    return float(np.mean(inside & (depth > _NEAREST) & (depth < _FARTHEST)))


def check_pair(cameras: tuple[FoundCamera, ...], note: Callable[[Note], None]) -> None:
    """Say where the right camera of a pair stands at the left of the left one."""
    by_name = {camera.name: camera for camera in cameras}
    if not {"left", "right"} <= set(by_name):
        return
    left, right = (by_name[side].T_camera_world for side in ("left", "right"))
    if right is None:
        return
    T_right_left = right if left is None else right @ np.linalg.inv(left)
    if T_right_left[0, 3] > abs(T_right_left[1, 3]):
        distance = 1e3 * float(T_right_left[0, 3])
        text = f"the right camera is {distance:.1f} mm at the left of the left one: left and right are swapped, or the"
        note(Note("warning", f"{text} calibration is the inverse (left in the right one's frame)."))
