"""A robot's meshes as flat arrays, posed in front of a camera."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Int

from ...model.parts import link_parts
from ...model.robot import Robot

Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy [px]."""


@dataclass(frozen=True)
class PosedRobot:
    """Vertices of one arm in the camera's frame."""

    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]


class Body(Protocol):
    """Triangles that can be rasterised and shaded; see `RobotGeometry` for the attributes."""

    @property
    def vertices(self) -> Float[np.ndarray, "V 3"]:
        """Of all parts, each in the frame of its link [m]."""
        ...

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        """Triangles."""
        ...

    @property
    def face_part(self) -> Int[np.ndarray, " F"]:
        """Index of the part that a triangle belongs to."""
        ...

    @property
    def shaft(self) -> int:
        """Index of the longest part."""
        ...

    @property
    def shaft_axis(self) -> Float[np.ndarray, "3"]:
        """Unit vector along the shaft, pointing away from the tip."""
        ...

    @property
    def shaft_end(self) -> Float[np.ndarray, "3"]:
        """The shaft's end at the tip [m]."""
        ...


class RobotGeometry:
    """What placing and shading need to know about a robot.

    Attributes:
        vertices, normals: of all parts, each in the frame of its link [V, 3].
        faces: triangles [F, 3].
        face_part: index of the part (`Robot.meshes`) that a triangle belongs to [F].
        part_class: index into `carts_core.model.parts.PARTS` of each part.
        shaft: index of the longest part, the instrument's shaft.
        shaft_axis: unit vector along the shaft in its link's frame, pointing away from the tip [3].
        shaft_end: the shaft's end at the tip, in its link's frame [3] [m].
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        meshes = robot.meshes
        counts = [len(mesh.vertices) for mesh in meshes]
        starts = np.concatenate([[0], np.cumsum(counts)])
        self.vertices = np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float32)
        self.normals = np.concatenate([mesh.normals for mesh in meshes]).astype(np.float32)
        self.faces: Int[np.ndarray, "F 3"] = np.concatenate(
            [mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]
        ).astype(np.int32)
        self.face_part = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes]).astype(np.int32)
        self._vertex_part = np.repeat(np.arange(len(meshes)), counts)
        self._vertex_link = np.repeat([mesh.link for mesh in meshes], counts)
        self.part_link = np.array([mesh.link for mesh in meshes])
        self.part_class = link_parts(robot)[self.part_link]
        extents = [np.ptp(mesh.vertices, axis=0).max() for mesh in meshes]
        self.shaft = int(np.argmax(extents))
        self.shaft_axis, self.shaft_end = self._shaft_line()

    def _shaft_line(self) -> tuple[np.ndarray, np.ndarray]:
        points = self.robot.meshes[self.shaft].vertices.astype(np.float64)
        centre = (points.min(0) + points.max(0)) / 2
        axis = np.zeros(3)
        axis[np.argmax(np.ptp(points, axis=0))] = 1.0
        tip = self._tip_in_shaft_link(np.zeros(len(self.robot.joint_names)))
        if axis @ (centre - tip) < 0:
            axis = -axis
        return axis, centre + axis * ((points - centre) @ axis).min()

    def _tip_in_shaft_link(self, joint_positions: np.ndarray) -> np.ndarray:
        Ts = self.link_transforms(joint_positions)
        points = self._posed(Ts)
        shaft_link = self.part_link[self.shaft]
        centre = points[self._vertex_part == self.shaft].mean(0)
        tip = points[np.argmax(((points - centre) ** 2).sum(1))]
        others = self._vertex_link != shaft_link
        if others.any():
            tip = points[others].mean(0)
        return np.linalg.inv(Ts[shaft_link])[:3] @ np.append(tip, 1.0)

    def link_transforms(self, joint_positions: np.ndarray) -> Float[np.ndarray, "links 4 4"]:
        """Ts_base_link [m] at these joint positions [dofs]."""
        return self.robot.forward_kinematics(torch.as_tensor(joint_positions, dtype=torch.float64)).numpy()

    def _posed(self, Ts: np.ndarray) -> np.ndarray:
        Ts = Ts[self._vertex_link]
        return np.einsum("vij,vj->vi", Ts[:, :3, :3], self.vertices) + Ts[:, :3, 3]

    def posed(self, Ts_camera_link: Float[np.ndarray, "links 4 4"]) -> PosedRobot:
        """Vertices and normals in the camera's frame."""
        vertices = np.empty_like(self.vertices)
        normals = np.empty_like(self.normals)
        for link in np.unique(self.part_link):
            chosen = self._vertex_link == link
            T = Ts_camera_link[link].astype(np.float32)
            vertices[chosen] = self.vertices[chosen] @ T[:3, :3].T + T[:3, 3]
            normals[chosen] = self.normals[chosen] @ T[:3, :3].T
        return PosedRobot(vertices, normals)
