"""Simulated clicks: landmarks projected by a known calibration, with noise."""

from collections.abc import Iterable, Mapping

import numpy as np

from carts_core.model.keypoints import Landmark, LandmarkKind, landmarks
from carts_core.model.scene import Scene
from carts_core.optimization.hand_eye import ImagePoint

NAMES = ("tip", "wrist yaw joint", "wrist pitch joint", "shaft edge")
_FROM_THE_WRIST = 0.015
"""Maximum distance of clicked shaft edges from the wrist [m]."""


def clicked(
    scene: Scene,
    measured: Mapping[str, np.ndarray],
    frames: Iterable[int],
    cameras: Iterable[str],
    *,
    noise: float = 2.0,
    seed: int = 0,
    names: tuple[str, ...] = NAMES,
    side: float | None = None,
) -> list[ImagePoint]:
    """Points of all arms [px], in the recommended order; shaft edges are on one side or on either side."""
    random = np.random.default_rng(seed)
    frames, points = tuple(frames), []
    for camera in cameras:
        for frame in frames:
            for arm in scene.arms:
                known = {name.removeprefix(f"{arm.name} "): mark for name, mark in landmarks(arm).items()}
                Ts = arm.robot.forward_kinematics(measured[arm.name][frame][None])[0]
                T_camera_base = scene.camera(camera).T_camera_world @ arm.T_world_base
                for name in names:
                    place = _seen(known[name], Ts, T_camera_base, side or random.choice([-1.0, 1.0]))
                    fx, fy, cx, cy = scene.camera(camera).intrinsics
                    pixel = np.array([fx * place[0] / place[2] + cx, fy * place[1] / place[2] + cy])
                    u, v = pixel + noise * random.standard_normal(2)
                    points.append(ImagePoint(frame, camera, arm.name, known[name].name, (float(u), float(v))))
    return points


def _seen(mark: Landmark, Ts: np.ndarray, T_camera_base: np.ndarray, side: float) -> np.ndarray:
    """Position of a landmark in the camera's frame [m]; for a shaft, a point on its outline."""
    ends = mark.positions(Ts) @ T_camera_base[:3, :3].T + T_camera_base[:3, 3]
    if mark.kind is LandmarkKind.POINT:
        return ends[0]
    # One end of the axis is at the wrist, the other behind the base.
    near = np.linalg.norm(mark.positions(Ts) - Ts[-1, :3, 3], axis=1).argmin()
    along = (ends[1 - near] - ends[near]) / np.linalg.norm(ends[1] - ends[0])
    place = ends[near] + _FROM_THE_WRIST * along
    across = np.cross(place, along)
    # A ray that touches the cylinder passes the plane through the axis a little further out than its radius.
    distance = np.linalg.norm(across)
    outwards = mark.radius * distance / np.sqrt(distance**2 - mark.radius**2)
    return place + side * outwards * across / distance
