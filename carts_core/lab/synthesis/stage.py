"""The arms at each moment of a planned motion."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from ...model.camera import Camera
from ...model.scene import Arm
from .path_tracer import Part, Surface

_DARK = 0.3
"""Parts of a darker colour than this are plastic; so is the longest part of the shaft, whatever the URDF paints it."""


@dataclass(frozen=True)
class Stage:
    """Arms and their motion.

    Links are numbered through all arms: link l of arm a is `a * len(link_names) + l`.
    """

    arms: tuple[Arm, ...]
    joints: tuple[Float[np.ndarray, "frames dofs"], ...]
    """True joint positions [rad, m], one table per arm."""
    times: Float[np.ndarray, " frames"]
    """[s]"""
    scale: float = 1.0
    """How many times larger the arms and their world are than the world of this stage."""
    painted: bool = False
    """Whether the robots' own colours are shown, and not an instrument's materials."""

    def Ts_world_link(self, frame: int, time_offset: float = 0.0) -> dict[int, Float[np.ndarray, "4 4"]]:
        """The place of every link at a frame, or shortly before or after it [s]."""
        transforms = []
        for arm, joints in zip(self.arms, self.joints, strict=True):
            positions = joints[frame]
            if time_offset and len(joints) > 1:
                positions = positions + time_offset * np.gradient(joints, self.times, axis=0)[frame]
            Ts_base_link = arm.robot.forward_kinematics(torch.from_numpy(positions)).numpy()
            Ts_world_link = arm.T_world_base @ Ts_base_link
            Ts_world_link[:, :3, 3] /= self.scale
            transforms.extend(Ts_world_link)
        return dict(enumerate(transforms))

    def parts(self, frame: int) -> list[Part]:
        """The instruments' meshes at a frame."""
        transforms = self.Ts_world_link(frame)
        parts: list[Part] = []
        for index, arm in enumerate(self.arms):
            first = index * len(arm.robot.link_names)
            first_link = (mesh for mesh in arm.robot.meshes if mesh.link == 0)
            shaft = max(first_link, key=lambda mesh: np.ptp(mesh.vertices), default=None)
            for mesh in arm.robot.meshes:
                T_world_link = transforms[first + mesh.link]
                rotation, translation = T_world_link[:3, :3], T_world_link[:3, 3]
                parts.append(
                    Part(
                        arm=index,
                        link=first + mesh.link,
                        vertices=mesh.vertices / self.scale @ rotation.T + translation,
                        normals=mesh.normals @ rotation.T,
                        faces=mesh.faces,
                        metal=bool(mesh is not shaft and mesh.color.mean() > _DARK),
                        paint=tuple(float(value) for value in mesh.color) if self.painted else None,
                    )
                )
        return parts

    def motion_in_image(
        self, frame: int, surface: Surface, camera: Camera, duration: float
    ) -> Float[np.ndarray, "h w 2"]:
        """How far each pixel's surface moves in the picture during `duration` [s], in pixels; 0 on tissue."""
        motion = np.zeros((*surface.link.shape, 2), np.float32)
        now = self.Ts_world_link(frame)
        before, after = self.Ts_world_link(frame, -duration / 2), self.Ts_world_link(frame, duration / 2)
        for link, T_world_link in now.items():
            there = surface.link == link
            if not there.any():
                continue
            points = (surface.position[there] - T_world_link[:3, 3]) @ T_world_link[:3, :3]
            motion[there] = _project(points, after[link], camera) - _project(points, before[link], camera)
        return motion


def _project(points: np.ndarray, T_world_link: np.ndarray, camera: Camera) -> np.ndarray:
    T_camera_link = camera.T_camera_world @ T_world_link
    p_camera = points @ T_camera_link[:3, :3].T + T_camera_link[:3, 3]
    fx, fy, _, _ = camera.intrinsics
    return p_camera[:, :2] / p_camera[:, 2:] * (fx, fy)
