"""Fingerprints of inputs: arrays, robots, cameras and source code."""

import hashlib
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import numpy as np
import torch

from .model.camera import Camera
from .model.robot import Robot
from .model.scene import Scene

_NOT_CODE = {"bench.py", "cli.py", "wording.py"}
_PROBES = (0.0, 0.1, -0.2)
"""Joint positions at which the links of two robots are compared [rad, m]."""


def fingerprint(*parts: bytes | str | float | np.ndarray | Iterable) -> str:
    """SHA-256 of numbers, strings, arrays (with dtype and shape), and tuples of these."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            content = np.ascontiguousarray(part)
            kind, data = f"array {content.dtype.str} {content.shape}", content.tobytes()
        elif isinstance(part, bytes):
            kind, data = "bytes", part
        elif isinstance(part, Iterable) and not isinstance(part, str):
            kind, data = "tuple", fingerprint(*part).encode()
        else:
            kind, data = type(part).__name__, (part if isinstance(part, str) else repr(part)).encode()
        digest.update(f"{kind} {len(data)}\n".encode())
        digest.update(data)
    return digest.hexdigest()


@cache
def code_fingerprint(patterns: tuple[str, ...]) -> str:
    """SHA-256 of modules of the package, given by patterns such as `rendering/**/*.py`."""
    package = Path(__file__).resolve().parent
    digest = hashlib.sha256()
    for pattern in patterns:
        for path in sorted(package.glob(pattern)):
            if path.name not in _NOT_CODE:
                digest.update(path.relative_to(package).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def robot_fingerprint(robot: Robot) -> str:
    """Fingerprint of a robot's joints, kinematics and meshes."""
    probes = torch.tensor(_PROBES, dtype=torch.float64)[:, None].expand(-1, len(robot.joint_names))
    meshes = [(mesh.link, mesh.vertices, mesh.normals, mesh.faces, mesh.color) for mesh in robot.meshes]
    return fingerprint(
        robot.joint_names,
        robot.joint_types,
        robot.joint_limits.numpy(),
        robot.link_names,
        robot.forward_kinematics(probes).numpy(),
        meshes,
    )


def calibration_fingerprint(scene: Scene, cameras: Iterable[Camera]) -> str:
    """Fingerprint of the poses of arms and cameras, and of the cameras' intrinsics.

    Args:
        cameras: cameras of the recorded images, with distortion.
    """
    arms = [(arm.name, arm.robot.base_link, np.asarray(arm.T_world_base)) for arm in scene.arms]
    views = [
        (camera.name, camera.width, camera.height, camera.intrinsics, camera.distortion, camera.T_camera_world)
        for camera in cameras
    ]
    return fingerprint(arms, views)
