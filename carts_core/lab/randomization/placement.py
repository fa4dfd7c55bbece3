"""Random instruments in front of a random camera, as an endoscope sees them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .geometry import Intrinsics, RobotGeometry

DEPTH = (0.05, 0.25)
"""Distance of the wrist from the camera [m]."""
FOCAL_LENGTH = (0.7, 2.0)
"""Focal length in image widths [1]: of whole endoscope images, and of enlarged ones."""
OUTSIDE = 0.12
"""How far outside the image a wrist may be, in image sizes [1]."""
ELEVATION = (-20.0, 60.0)
"""Angle at which the shaft comes towards the camera [deg]; negative goes away from it."""


@dataclass(frozen=True)
class Placement:
    """One arm in front of the camera."""

    joint_positions: Float[np.ndarray, " dofs"]
    """[rad, m], in the order of `Robot.joint_names`."""
    T_camera_base: Float[np.ndarray, "4 4"]


def random_intrinsics(rng: np.random.Generator, width: int, height: int, field: int) -> Intrinsics:
    """fx, fy, cx, cy [px] of a camera that is `field` px wide and of which a part of `width` x `height` px is seen."""
    focal = float(np.exp(rng.uniform(*np.log(FOCAL_LENGTH)))) * field
    cx, cy = rng.uniform(0.3, 0.7) * width, rng.uniform(0.3, 0.7) * height
    return focal, focal * rng.uniform(0.98, 1.02), cx, cy


def random_placement(
    rng: np.random.Generator, geometry: RobotGeometry, intrinsics: Intrinsics, width: int, height: int
) -> Placement:
    """A random configuration whose wrist is in or near the image and whose shaft leaves it across a random border."""
    joints = _random_joints(rng, geometry)
    Ts_base_link = geometry.link_transforms(joints)
    T_base_shaft = Ts_base_link[geometry.part_link[geometry.shaft]]
    wrist = T_base_shaft[:3, :3] @ geometry.shaft_end + T_base_shaft[:3, 3]
    axis = T_base_shaft[:3, :3] @ geometry.shaft_axis
    fx, fy, cx, cy = intrinsics
    depth = float(np.exp(rng.uniform(*np.log(DEPTH))))
    u = rng.uniform(-OUTSIDE, 1 + OUTSIDE) * width
    v = rng.uniform(-OUTSIDE, 1 + OUTSIDE) * height
    target = np.array([(u - cx) / fx * depth, (v - cy) / fy * depth, depth])
    azimuth = rng.uniform(0, 2 * np.pi)
    elevation = np.deg2rad(rng.uniform(*ELEVATION))
    direction = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), -np.sin(elevation)])
    R = _frame(direction, rng.normal(size=3)) @ _frame(axis, rng.normal(size=3)).T
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, target - R @ wrist
    return Placement(joints, T)


def perturbed(rng: np.random.Generator, geometry: RobotGeometry, placement: Placement, scale: float) -> Placement:
    """The placement with wrong kinematics: joints off by some degrees, the arm turned and moved a little.

    Args:
        scale: 1 moves the wrist by some 3 mm and turns joints by some 3 degrees.
    """
    joints = placement.joint_positions.copy()
    for index, kind in enumerate(geometry.robot.joint_types):
        if kind == "revolute":
            joints[index] += rng.normal(0, np.deg2rad(3.0) * scale)
    # The arm turns about its own wrist, so that the error in the image does not grow with the arm's length.
    shaft_link = geometry.part_link[geometry.shaft]
    T_camera_shaft = placement.T_camera_base @ geometry.link_transforms(placement.joint_positions)[shaft_link]
    T_camera_shaft_moved = placement.T_camera_base @ geometry.link_transforms(joints)[shaft_link]
    turn = turned(rng.normal(0, np.deg2rad(2.0) * scale, 3))
    wrist = T_camera_shaft[:3, :3] @ geometry.shaft_end + T_camera_shaft[:3, 3]
    # Farther away, what moves the image by as much is a larger distance.
    wrist = wrist + rng.normal(0, 0.003 * scale, 3) * max(1.0, np.linalg.norm(wrist) / DEPTH[1])
    R = turn @ T_camera_shaft[:3, :3]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, wrist - R @ geometry.shaft_end
    return Placement(joints, T @ np.linalg.inv(T_camera_shaft_moved) @ placement.T_camera_base)


def _random_joints(rng: np.random.Generator, geometry: RobotGeometry) -> np.ndarray:
    limits = geometry.robot.joint_limits.numpy()
    low = np.where(np.isfinite(limits[:, 0]), limits[:, 0], -np.pi)
    high = np.where(np.isfinite(limits[:, 1]), limits[:, 1], np.pi)
    anywhere = rng.uniform(low, high)
    # Instruments are mostly held rather straight and their jaws are mostly nearly closed.
    straight = np.clip(rng.normal(0, 0.4, len(low)), low, high)
    return np.where(rng.random(len(low)) < 0.6, straight, anywhere)


def _frame(axis: np.ndarray, helper: np.ndarray) -> np.ndarray:
    """A rotation whose last column is `axis`, turned about it by chance."""
    x = np.cross(axis, helper)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def turned(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation about a vector by its length [rad]."""
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
