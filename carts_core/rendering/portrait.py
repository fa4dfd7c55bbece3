"""Portrait of a single robot: a close-up of an instrument's tip, or a whole arm."""

import numpy as np
from jaxtyping import Float, UInt8

from ..model.camera import Camera
from ..model.parts import link_parts
from ..model.robot import Robot
from ..model.scene import Arm, Light, Scene
from .image_renderer import ImageRenderer

_BACKDROP = 0.92
_FOCAL_LENGTH = 2.4
"""Focal length, relative to the width of the picture [1]."""
_MARGIN = 1.25
_TILT = np.deg2rad(35.0)
_OPEN = 0.45
"""Joint position of open jaws, relative to the upper limit [1]."""
_SUPERSAMPLING = 2
_GAMMA = 1 / 1.5
_STEP = 0.1
"""Motion of the last joint by which its moving links are identified [rad]."""


def portrait(robot: Robot, width: int = 480, height: int = 320) -> UInt8[np.ndarray, "height width 3"]:
    """Render a robot on a plain background, RGB: the tip beyond the shaft for an instrument, else the whole robot.

    Args:
        width, height: size of the picture [px].
    """
    joints, opening = _pose(robot)
    parts = link_parts(robot)[[mesh.link for mesh in robot.meshes]]
    points = _points(robot, joints)
    shown = [cloud for cloud, part in zip(points, parts, strict=True) if part > 0]
    carried_by = [cloud for cloud, part in zip(points, parts, strict=True) if part == 0]
    if shown and carried_by:
        R = _side_view(np.concatenate(shown).mean(0) - np.concatenate(carried_by).mean(0), opening)
    else:
        shown, R = points, _from_above()
    cloud = np.concatenate(shown)
    centre = (cloud.min(0) + cloud.max(0)) / 2
    radius = np.linalg.norm(cloud - centre, axis=1).max() * _MARGIN
    T_camera_base = np.eye(4)
    T_camera_base[:3, :3] = R
    T_camera_base[:3, 3] = (0, 0, radius * (1 + 2 * _FOCAL_LENGTH * width / min(width, height))) - R @ centre
    focal = _FOCAL_LENGTH * width
    camera = Camera("portrait", width, height, (focal, focal, width / 2, height / 2), np.eye(4))
    scene = Scene((Arm("robot", robot, T_camera_base),), (camera,), Light(ambient=0.35, diffuse=0.75, specular=0.3))
    renderer = ImageRenderer(scene, width=width * _SUPERSAMPLING, height=height * _SUPERSAMPLING)
    images, arms = renderer.shaded(scene.state({"robot": joints}, None))
    image = np.moveaxis(images[0], 0, -1) ** _GAMMA + _BACKDROP * (arms[0, ..., None] < 0)
    fine = np.clip(image, 0, 1).reshape(height, _SUPERSAMPLING, width, _SUPERSAMPLING, 3)
    return np.rint(fine.mean((1, 3)) * 255).astype(np.uint8)


def _pose(robot: Robot) -> tuple[Float[np.ndarray, " dofs"], Float[np.ndarray, "3"]]:
    """Straight joint positions with open jaws, and direction of motion of the links moved by the last joint."""
    low, high = robot.joint_limits.clip(-np.pi, np.pi).T
    joints = np.zeros(len(low)).clip(low, high)
    moved = joints.copy()
    moved[-1] += _STEP
    ways = [after - before for before, after in zip(_points(robot, joints), _points(robot, moved), strict=True)]
    means = np.array([way.mean(0) for way in ways])
    if (means @ means.T).min() < -1e-9:
        # Jaws move in opposite directions.
        joints[-1] = np.clip(_OPEN * high[-1], low[-1], high[-1])
    _, _, axes = np.linalg.svd(np.concatenate(ways), full_matrices=False)
    return joints, axes[0]


def _points(robot: Robot, joints: Float[np.ndarray, " dofs"]) -> list[Float[np.ndarray, "V 3"]]:
    """Vertices of every mesh in the base frame [m]."""
    Ts = robot.forward_kinematics(joints)
    return [mesh.vertices @ Ts[mesh.link, :3, :3].T + Ts[mesh.link, :3, 3] for mesh in robot.meshes]


def _side_view(along: Float[np.ndarray, "3"], opening: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """R_camera_base of a view with the tip on the right, oblique to the opening plane of the jaws."""
    right = along / np.linalg.norm(along)
    across = opening - (opening @ right) * right
    across /= np.linalg.norm(across)
    down = np.cos(_TILT) * across + np.sin(_TILT) * np.cross(right, across)
    return np.stack([right, down, np.cross(right, down)])


def _from_above() -> Float[np.ndarray, "3 3"]:
    """R_camera_base of a view of the base frame's origin, obliquely from above; z is up."""
    forward = np.array([-1.0, 0.8, -0.55])
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])
