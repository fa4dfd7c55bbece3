"""Where the cameras and the arms stand. World: origin in the middle of the tissue, x right, y away, z up [m]."""

import numpy as np
import torch
from jaxtyping import Float

from ...model.camera import Camera
from ...model.robot import Robot
from ...model.scene import Arm
from ...settings import EndoscopeConfig, SynthesisConfig

ARM_NAMES = ("psm1", "psm2")
"""Seen from the camera: the arm that comes in from the left, and the one from the right."""

JOINT_TYPES = ("revolute", "revolute", "prismatic", "revolute", "revolute", "revolute", "revolute")
"""Yaw, pitch, insertion, roll, wrist pitch, wrist yaw, jaw; instruments whose jaws do not move lack the last."""

_REMOTE_CENTRES_CAMERA = ((-0.092, 0.062, 0.006), (0.098, -0.010, 0.002))
"""Where the instruments pass the body wall, in the left camera's frame [m]."""

WORK_POINTS = ((-0.011, -0.001, 0.014), (0.012, 0.002, 0.014))
"""What the instruments point at when their joints stand in the middle, in the world [m]."""


def place_cameras(config: EndoscopeConfig) -> tuple[Camera, ...]:
    """The left camera and, if wanted, the right one beside it."""
    forward = np.array([0.0, np.cos(config.elevation), -np.sin(config.elevation)])
    right = np.array([1.0, 0.0, 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    position = np.array([0.0, 0.0, 0.006]) - config.distance * forward
    focal = config.focal_length * config.width / 640.0
    names = ("left", "right") if config.stereo else ("left",)
    cameras = []
    for number, name in enumerate(names):
        T_camera_world = np.eye(4)
        T_camera_world[:3, :3] = rotation
        T_camera_world[:3, 3] = -rotation @ (position + number * config.baseline * right)
        intrinsics = (focal, focal, config.width / 2.0, config.height / 2.0)
        cameras.append(Camera(name, config.width, config.height, intrinsics, T_camera_world))
    return tuple(cameras)


def load_robot(config: SynthesisConfig) -> Robot:
    """The robot, with finer meshes than the optimizer uses.

    Raises:
        RobotError: the URDF is unusable.
    """
    return Robot.load(config.robot, max_faces=config.render.robot_faces)


def is_instrument(robot: Robot) -> bool:
    """Whether the joints are those of a PSM: its seven, or all but the last."""
    return robot.joint_types in (JOINT_TYPES, JOINT_TYPES[:-1])


def place_arms(robot: Robot, tip_link: str, camera: Camera) -> tuple[Arm, ...]:
    """Base frames such that, with all joints at zero, both instruments point at the middle of the scene."""
    T_world_camera = np.linalg.inv(camera.T_camera_world)
    arms = []
    for name, centre, work in zip(ARM_NAMES, _REMOTE_CENTRES_CAMERA, WORK_POINTS, strict=True):
        centre_world = (T_world_camera @ np.append(centre, 1.0))[:3]
        T_world_base = np.eye(4)
        T_world_base[:3, :3] = rotation_between(_shaft_direction(robot, tip_link), np.asarray(work) - centre_world)
        T_world_base[:3, 3] = centre_world
        arms.append(Arm(name, robot, T_world_base))
    return tuple(arms)


def _shaft_direction(robot: Robot, tip_link: str) -> Float[np.ndarray, "3"]:
    """Direction of insertion in the base frame with all joints at zero."""
    joints = torch.zeros(2, len(robot.joint_names), dtype=torch.float64)
    joints[1, 2] = 0.1
    tips = robot.link_transform(joints, tip_link)[:, :3, 3].numpy()
    return tips[1] - tips[0]


def rotation_between(a: np.ndarray, b: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """A rotation that takes direction a to direction b and keeps their common 'up' as far as it can."""
    return _frame(b) @ _frame(a).T


def _frame(direction: np.ndarray) -> np.ndarray:
    z = direction / np.linalg.norm(direction)
    helper = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=-1)
