"""The triangles of a whole scene in one place, each still in the frame of its link."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..model.parts import link_parts
from ..model.robot import Robot
from ..model.scene import Scene, SceneState


@dataclass(frozen=True)
class SceneGeometry:
    """All triangles of all arms. Links are numbered through all arms, and vertices stand in the order of their links.

    Vectors are columns (`3 V`, not `V 3`), because products along a short last dimension are slow.
    """

    vertices: Float[Tensor, "3 V"]
    """In link frames [m]."""
    vertex_counts: tuple[int, ...]
    """Number of vertices per link."""
    vertex_links: Int[Tensor, " V"]
    faces: Int[Tensor, "F 3"]
    face_links: Int[Tensor, " F"]
    face_arms: Int[Tensor, " F"]
    face_parts: Int[Tensor, " F"]
    """Index into `carts_core.model.parts.PARTS`."""
    face_surfaces: Int[Tensor, " F"]
    """Index of the closed surface that a triangle is part of, -1 for none; a camera outside sees no back of it."""
    face_colors: Float[Tensor, "3 F"]
    face_barycentric: Float[Tensor, "8 F"]
    """Affine maps from a point on the triangle to its second and third barycentric coordinate, one after the other."""
    face_normals: Float[Tensor, "9 F"]
    """Unit vertex normals of each triangle's corners, in its link's frame, one after the other."""

    @staticmethod
    def of(scene: Scene, device: str | torch.device = "cpu") -> "SceneGeometry":
        """Gather the link meshes of a scene; once, for all renderers of the same robots."""
        return SceneGeometry._of(tuple(arm.robot for arm in scene.arms), torch.device(device))

    @staticmethod
    @lru_cache(maxsize=4)
    def _of(robots: tuple[Robot, ...], device: torch.device) -> "SceneGeometry":
        vertices, normals, faces, face_links, arms, face_parts, surfaces, colors, counts = ([] for _ in range(9))
        first_link, first_vertex = 0, 0
        for arm_index, robot in enumerate(robots):
            counts += [0] * len(robot.link_names)
            parts = link_parts(robot)
            for mesh in sorted(robot.meshes, key=lambda mesh: mesh.link):
                link, count = first_link + mesh.link, len(mesh.faces)
                vertices.append(mesh.vertices)
                normals.append(mesh.normals)
                counts[link] += len(mesh.vertices)
                faces.append(mesh.faces + first_vertex)
                face_links.append(np.full(count, link))
                arms.append(np.full(count, arm_index))
                face_parts.append(np.full(count, parts[mesh.link]))
                surfaces.append(np.full(count, len(surfaces) if mesh.closed else -1))
                colors.append(np.broadcast_to(mesh.color, (count, 3)))
                first_vertex += len(mesh.vertices)
            first_link += len(robot.link_names)
        vertex, face = np.concatenate(vertices).astype(np.float64), np.concatenate(faces)

        def tensor(array: np.ndarray, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.tensor(np.ascontiguousarray(array), dtype=dtype, device=device)

        return SceneGeometry(
            tensor(vertex.T),
            tuple(counts),
            tensor(np.repeat(np.arange(len(counts)), counts), torch.int64),
            tensor(face, torch.int32),
            tensor(np.concatenate(face_links), torch.int64),
            tensor(np.concatenate(arms), torch.int64),
            tensor(np.concatenate(face_parts), torch.int64),
            tensor(np.concatenate(surfaces), torch.int64),
            tensor(np.concatenate(colors).T),
            tensor(_barycentric_maps(vertex[face]).reshape(-1, 8).T),
            tensor(np.concatenate(normals)[face].reshape(-1, 9).T),
        )


def _barycentric_maps(corners: np.ndarray) -> np.ndarray:
    """Affine maps [F, 2, 4] from a point on a triangle [F, 3, 3] to two of its barycentric coordinates."""
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(ab, ac)
    squared = np.maximum((cross**2).sum(-1, keepdims=True), 1e-30)
    # A coordinate grows along the direction in the plane that is normal to the edge opposite its corner.
    maps = np.stack([np.cross(ac, cross) / squared, np.cross(cross, ab) / squared], 1)
    offsets = -np.einsum("fki,fi->fk", maps, a)
    return np.concatenate([maps, offsets[..., None]], -1)


def link_transforms(scene: Scene, state: SceneState) -> Float[Tensor, "*batch cameras links 4 4"]:
    """Ts_camera_link of every link in every camera, differentiable (f_FK of the paper, then F_B and C)."""
    Ts_base_link: dict[int, Tensor] = {}
    for robot in {id(arm.robot): arm.robot for arm in scene.arms}.values():
        # Arms of one kind go through forward kinematics together, which takes as long for all as for one.
        same = [index for index, arm in enumerate(scene.arms) if arm.robot is robot]
        Ts = robot.forward_kinematics(torch.stack([state.joint_positions[index] for index in same]))
        Ts_base_link.update(zip(same, Ts, strict=True))
    bases = state.T_world_base.unbind(-3)
    Ts_world_link = torch.cat([base[..., None, :, :] @ Ts_base_link[index] for index, base in enumerate(bases)], -3)
    return state.T_view_world[..., :, None, :, :] @ Ts_world_link[..., None, :, :, :]


def vertices_in_camera(
    geometry: SceneGeometry, Ts_camera_link: Float[Tensor, "*batch links 4 4"]
) -> Float[Tensor, "*batch 3 V"]:
    """All vertices in the frame of a camera [m]."""
    if Ts_camera_link.device.type != "cpu":
        return vertices_in_camera_at_once(geometry, Ts_camera_link)
    parts = geometry.vertices.split(geometry.vertex_counts, dim=1)
    Ts = Ts_camera_link.unbind(-3)
    return torch.cat([T[..., :3, :3] @ part + T[..., :3, 3:] for T, part in zip(Ts, parts, strict=True)], -1)


def vertices_in_camera_at_once(
    geometry: SceneGeometry, Ts_camera_link: Float[Tensor, "*batch links 4 4"]
) -> Float[Tensor, "*batch 3 V"]:
    """The same in one large operation, as a GPU likes it."""
    T = Ts_camera_link[..., geometry.vertex_links, :3, :]
    return ((T[..., :3] @ geometry.vertices.T[..., None]) + T[..., 3:])[..., 0].mT
