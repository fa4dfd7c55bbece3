"""Points of an arm that a person can find in an image: the tips of its last links, and the joints behind them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .robot import Robot
from .scene import Arm, Scene, SceneState

MOST_KEYPOINTS = 6
"""Per arm; those nearest to the tip are kept."""
_SAME_POINT = 5e-4
"""Joints closer to each other than this are one point [m]."""


@dataclass(frozen=True)
class Keypoint:
    """A point that is fixed to a link."""

    arm: str
    name: str
    """Of the point, unique in its arm, for people."""
    link: int
    """Index into `Robot.link_names`."""
    position: tuple[float, float, float]
    """In the link's frame [m]."""


def keypoints(arm: Arm) -> tuple[Keypoint, ...]:
    """The named points of an arm, from the tip backwards: the tips of its last links, then the links' joints.

    The shipped instrument has the tips of both jaws, the centre of the wrist's yaw joint (where the jaws turn) and
    that of its pitch joint (where the shaft ends).
    """
    robot = arm.robot
    moved_by = _moved_by(robot)
    depth = moved_by.sum(-1)
    last = [link for link in range(len(robot.link_names)) if depth[link] == depth.max()]
    points = [Keypoint(arm.name, f"{_named(robot, link)} tip", link, _tip(robot, link)) for link in last]
    for link, name in reversed(_joints(robot, depth)):
        points.append(Keypoint(arm.name, f"{name} joint", link, (0.0, 0.0, 0.0)))
    return tuple(points[:MOST_KEYPOINTS])


def project_keypoints(
    scene: Scene, state: SceneState, points: Sequence[Keypoint], camera: str
) -> Float[Tensor, "points 2"]:
    """Where the points are in a camera's image [px], differentiable; NaN behind the camera.

    Raises:
        RobotError: there is no such camera or arm.
    """
    view = scene.cameras.index(scene.camera(camera))
    arms = {arm.name: index for index, arm in enumerate(scene.arms)}
    links = {
        name: scene.arm(name).robot.forward_kinematics(state.joint_positions[arms[name]])
        for name in dict.fromkeys(point.arm for point in points)
    }
    pixels = []
    for point in points:
        T_camera_base = state.T_view_world[view] @ state.T_world_base[arms[point.arm]]
        T_camera_link = T_camera_base @ links[point.arm][point.link]
        p_camera = T_camera_link[:3, :3] @ T_camera_link.new_tensor(point.position) + T_camera_link[:3, 3]
        fx_fy, cx_cy = state.intrinsics[view].split(2)
        depth = torch.where(p_camera[2] > 0, p_camera[2], torch.nan)
        pixels.append(fx_fy * p_camera[:2] / depth + cx_cy)
    return torch.stack(pixels) if pixels else state.intrinsics.new_zeros(0, 2)


def _moved_by(robot: Robot) -> np.ndarray:
    """Which degrees of freedom move which link [links, dofs]."""
    rest = torch.full((len(robot.joint_names),), 0.01, dtype=torch.float64)
    before = robot.forward_kinematics(rest)
    after = robot.forward_kinematics(rest + 0.01 * torch.eye(len(rest), dtype=torch.float64))
    return ((after - before).abs().amax((-2, -1)) > 1e-9).T.numpy()


def _joints(robot: Robot, depth: np.ndarray) -> list[tuple[int, str]]:
    """Points about which links turn, from the base on: a link that they are fixed to, and a name."""
    # Not at 0, where joints may lie on each other that move apart later.
    somewhere = torch.full((len(robot.joint_names),), 0.1, dtype=torch.float64)
    origins = robot.forward_kinematics(somewhere)[:, :3, 3].numpy()
    groups: list[list[int]] = []
    for link in sorted(np.flatnonzero(depth).tolist(), key=lambda index: depth[index]):
        together = (group for group in groups if np.linalg.norm(origins[group[0]] - origins[link]) < _SAME_POINT)
        if (group := next(together, None)) is None:
            groups.append([link])
        else:
            group.append(link)
    named = []
    for group in groups:
        # The shaft ends where the wrist begins: called after the wrist. Two jaws turn on one link: called after that.
        alone = [link for link in group if (depth[group] == depth[link]).sum() == 1]
        named.append((group[0], _named(robot, alone[-1] if alone else group[0])))
    return named


def _tip(robot: Robot, link: int) -> tuple[float, float, float]:
    """The point of a link's meshes that is furthest from its joint."""
    vertices = np.concatenate([mesh.vertices for mesh in robot.meshes if mesh.link == link]).astype(np.float64)
    x, y, z = vertices[np.linalg.norm(vertices, axis=-1).argmax()]
    return float(x), float(y), float(z)


def _named(robot: Robot, link: int) -> str:
    return robot.link_names[link].removesuffix("_link").replace("_", " ")
