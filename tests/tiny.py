"""Smallest complete scene: one arm in front of one or two cameras."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch

from carts_core.model.camera import Camera
from carts_core.model.robot import Robot
from carts_core.model.scene import Arm, Scene, SceneState
from carts_core.rendering import Renderer

FOCAL_PER_WIDTH = 1.2
BIAS = 0.01
"""Error of the measured revolute joints [rad]; that of prismatic joints is a tenth of this number [m]."""


@dataclass(frozen=True)
class TinyScene:
    """Scene of the tiny sequences: one arm in front of one or two cameras, and its true joint positions."""

    scene: Scene
    truth: np.ndarray
    measured: np.ndarray


def _look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    rotation = np.stack([right, np.cross(forward, right), forward])
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3], T_camera_world[:3, 3] = rotation, -rotation @ eye
    return T_camera_world


def _tip(robot: Robot, joint_positions: np.ndarray) -> np.ndarray:
    """Middle of the robot's last link [m], which is a jaw of the instrument."""
    T_base_link = robot.forward_kinematics(torch.tensor(joint_positions))[robot.meshes[-1].link].numpy()
    return T_base_link[:3, :3] @ robot.meshes[-1].vertices.mean(0) + T_base_link[:3, 3]


@cache
def tiny_scene(robot: Robot, frames: int, cameras: tuple[str, ...], width: int, height: int) -> TinyScene:
    """Arm whose tip is at the centre of every camera's image."""
    prismatic = np.array([kind == "prismatic" for kind in robot.joint_types])
    rest = np.where(prismatic, 0.15, 0.0)
    sway = np.linspace(-1.0, 1.0, frames)[:, None] if frames > 1 else np.zeros((1, 1))
    truth = rest + sway * np.where(prismatic, 0.004, 0.06)
    tip = _tip(robot, rest)
    axis = tip / np.linalg.norm(tip)
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    views = []
    for number, name in enumerate(cameras):
        eye = tip - 0.06 * axis + 0.09 * side + 0.006 * number * np.cross(axis, side)
        intrinsics = (FOCAL_PER_WIDTH * width, FOCAL_PER_WIDTH * width, width / 2, height / 2)
        views.append(Camera(name, width, height, intrinsics, _look_at(eye, tip - 0.01 * axis, -axis)))
    signs = np.where(np.arange(len(robot.joint_names)) % 2, -1.0, 1.0)
    measured = truth + signs * np.where(prismatic, 0.1 * BIAS, BIAS)
    return TinyScene(Scene((Arm("PSM1", robot, np.eye(4)),), tuple(views)), truth, measured)


def recorded_mask(scene: Scene, state: SceneState, camera: Camera) -> np.ndarray:
    """Mask of the arms in the recorded image of a camera with distortion, looked up in a rendering of three times its
    width and height."""
    width, height = camera.width, camera.height
    around = (-width, -height, 3 * width, 3 * height)
    arms = Renderer(scene, cameras=[camera.name], window=around).segment(state)[0] >= 0
    y, x = np.mgrid[:height, :width] + 0.5
    u, v = np.floor(camera.undistort_points(np.column_stack([x.ravel(), y.ravel()]))).astype(int).T
    return arms[v + height, u + width].reshape(height, width)


@dataclass(frozen=True)
class TinyImage:
    """One image of a tiny sequence."""

    camera: str
    row: int
    image: np.ndarray
    """Image [height, width, 3] in [0, 1] of the arm at its true joint positions over a smooth background."""
    mask: np.ndarray


# Many tests ask for the same small pictures, so each is rendered once.
@cache
def tiny_images(robot: Robot, frames: int, cameras: tuple[str, ...], width: int, height: int) -> tuple[TinyImage, ...]:
    """Every image of a tiny sequence."""
    tiny = tiny_scene(robot, frames, cameras, width, height)
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    background = np.stack([0.55 + 0.1 * x, 0.3 + 0.1 * y, 0.25 + 0.05 * x * y], -1)
    images = []
    for camera in cameras:
        renderer = Renderer(tiny.scene, width=width, height=height, cameras=[camera])
        for row, joint_positions in enumerate(tiny.truth):
            with torch.no_grad():
                rendering = renderer(tiny.scene.state({"PSM1": joint_positions}))
            cover = rendering.silhouette[0].numpy()[..., None]
            image = cover * rendering.image[0].permute(1, 2, 0).numpy() + (1 - cover) * background
            images.append(TinyImage(camera, row, image.clip(0, 1), cover[..., 0] > 0.5))
    return tuple(images)
