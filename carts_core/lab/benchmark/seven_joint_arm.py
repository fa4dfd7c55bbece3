"""A robot of our own with seven joints in the proportions of a lightweight arm, and ten views of it in a room.

It is drawn by casting rays (trimesh, Embree), which shares nothing with the optimizer's renderer, and is a test
condition alone: no network was trained on it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, UInt8

from ...errors import CartsError
from ...files import write_text
from ...model.camera import Camera
from ...model.robot import Robot
from ...model.scene import Arm, Scene
from ...recording import Frame

_SECTIONS = (0.16, 0.18, 0.22, 0.19, 0.2, 0.19, 0.08)
"""Length of what each joint turns [m]."""

_RADII = (0.075, 0.07, 0.065, 0.06, 0.055, 0.05, 0.04)
_COLOURS = ((0.85, 0.85, 0.83), (0.9, 0.45, 0.1))
_LIMIT = 2.9
_SIZE, _FOCAL = (640, 480), 620.0
_SAMPLES = 3
"""Rays per pixel and axis; odd, so that a mask of pixels that are covered by half is neither wide nor narrow."""

_HIDDEN = 0.25
"""Largest brightness that a side turned from the light has [1]."""


def write_arm(folder: Path) -> Path:
    """Write the URDF, of cylinders, spheres and boxes alone; returns its path."""
    lines = ['<robot name="seven_joint_arm">', '<link name="base">', _visual("cylinder", 0.09, 0.14, 0.07), "</link>"]
    parent, height = "base", 0.14
    for index, (length, radius) in enumerate(zip(_SECTIONS, _RADII, strict=True)):
        axis = "0 0 1" if index % 2 == 0 else "0 1 0"
        lines += [
            f'<joint name="joint_{index + 1}" type="revolute"><parent link="{parent}"/>',
            f'<child link="link_{index + 1}"/><origin xyz="0 0 {height}"/><axis xyz="{axis}"/>',
            f'<limit lower="-{_LIMIT}" upper="{_LIMIT}" effort="1" velocity="1"/></joint>',
            f'<link name="link_{index + 1}">',
            _visual("sphere", 1.15 * radius, 0.0, 0.0),
            _visual("cylinder", 0.85 * radius, length, length / 2),
            "</link>",
        ]
        parent, height = f"link_{index + 1}", length
    finger = '<visual><origin xyz="0 {y} 0.1"/><geometry><box size="0.03 0.02 0.09"/></geometry></visual>'
    lines[-1] = finger.format(y=0.03) + finger.format(y=-0.03) + "</link>"
    path = folder / "seven_joint_arm.urdf"
    write_text(path, "\n".join([*lines, "</robot>"]))
    return path


def _visual(kind: str, radius: float, length: float, z: float) -> str:
    size = f'radius="{radius}"' + (f' length="{length}"' if kind == "cylinder" else "")
    return f'<visual><origin xyz="0 0 {z}"/><geometry><{kind} {size}/></geometry></visual>'


def looking_at(eye: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "4 4"]:
    """T_camera_world of a camera at `eye` whose z axis meets `target`, level with the floor (z up)."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.block([[rotation, -(rotation @ eye)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


@dataclass(frozen=True)
class ArmViews:
    """Views of the arm from one camera that stands still, each in another pose."""

    scene: Scene
    """With the true base frame and camera."""
    frames: tuple[Frame, ...]
    """With masks; measured joint positions are true."""


def arm_views(folder: Path, count: int, seed: int, room: UInt8[np.ndarray, "h w 3"] | None = None) -> ArmViews:
    """Draw views of the arm.

    Args:
        folder: for the robot's URDF.
        count: how many.
        seed: of poses, camera and noise.
        room: what is behind the arm, of 640 x 480 pixels; grey by default.
    """
    rng = np.random.default_rng(seed)
    robot = Robot.load(write_arm(folder))
    angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(1.6, 2.2)
    eye = np.array([distance * np.cos(angle), distance * np.sin(angle), rng.uniform(0.5, 1.1)])
    T = looking_at(eye, np.array([0.0, 0.0, 0.5]) + rng.uniform(-0.05, 0.05, 3))
    intrinsics = (_FOCAL, _FOCAL, _SIZE[0] / 2, _SIZE[1] / 2)
    camera = Camera(name="left", width=_SIZE[0], height=_SIZE[1], intrinsics=intrinsics, T_camera_world=T)
    scene = Scene((Arm("arm", robot, np.eye(4)),), (camera,))
    behind = np.full((_SIZE[1], _SIZE[0], 3), 128, np.uint8) if room is None else room
    frames = []
    for index in range(count):
        joints = rng.uniform(-1.0, 1.0, len(robot.joint_names)) * np.array([1.5, 0.9, 1.5, 1.2, 1.5, 1.2, 1.5])
        coverage, shade = _rays(robot, joints, camera)
        picture = (1 - coverage[..., None]) * behind + 255 * shade + rng.normal(0, 2.0, (*coverage.shape, 3))
        mask: Bool[np.ndarray, "h w"] = coverage >= 0.5
        frames.append(
            Frame(
                index=index,
                frame_id=f"{index:03d}",
                timestamp=None,
                domain="regular",
                images={"left": picture.clip(0, 255).astype(np.uint8)},
                measured={"arm": joints},
                masks={"left": mask},
                truth={"arm": joints},
            )
        )
    return ArmViews(scene, tuple(frames))


def _rays(
    robot: Robot, joints: Float[np.ndarray, " dofs"], camera: Camera
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w 3"]]:
    """Which share of each pixel the robot covers, and its colour there times that share."""
    Ts = robot.forward_kinematics(torch.tensor(joints)).numpy()
    parts, colours = [], []
    for mesh in robot.meshes:
        vertices = mesh.vertices @ Ts[mesh.link, :3, :3].T + Ts[mesh.link, :3, 3]
        parts.append(trimesh.Trimesh(vertices, mesh.faces, process=False))
        colours += [_COLOURS[mesh.link % len(_COLOURS)]] * len(mesh.faces)
    body = trimesh.util.concatenate(parts)
    assert isinstance(body, trimesh.Trimesh)
    if type(body.ray).__module__ != "trimesh.ray.ray_pyembree":
        raise CartsError("Rays are cast with Embree, which is not installed. Install it with: pip install embreex")
    n = _SAMPLES
    x, y = (np.arange(n * size) / n + 0.5 / n for size in (camera.width, camera.height))
    fx, fy, cx, cy = camera.intrinsics
    rays = np.stack(np.broadcast_arrays((x[None] - cx) / fx, (y[:, None] - cy) / fy, 1.0), -1).reshape(-1, 3)
    T_world_camera = np.linalg.inv(camera.T_camera_world)
    directions = rays @ T_world_camera[:3, :3].T
    hit = body.ray.intersects_first(np.broadcast_to(T_world_camera[:3, 3], directions.shape), directions)
    facing = np.abs((body.face_normals[hit] * directions).sum(1)) / np.linalg.norm(directions, axis=1)
    shade = np.array(colours)[hit] * (_HIDDEN + (1 - _HIDDEN) * facing)[:, None]
    shade[hit < 0] = 0.0
    shape = (camera.height, n, camera.width, n)
    coverage = (hit >= 0).reshape(shape).mean((1, 3))
    return coverage, shade.reshape(*shape, 3).mean((1, 3))
