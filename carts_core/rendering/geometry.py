"""The triangles of a whole scene in one place, each still in the frame of its link."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..scene import Scene, SceneState


@dataclass(frozen=True)
class SceneGeometry:
    """All triangles of all arms. Links are numbered through all arms."""

    vertices: Float[Tensor, "V 3"]
    """In link frames [m]."""
    vertex_links: Int[Tensor, " V"]
    faces: Int[Tensor, "F 3"]
    face_links: Int[Tensor, " F"]
    face_arms: Int[Tensor, " F"]
    face_colors: Float[Tensor, "F 3"]
    face_planes: Float[Tensor, "F 4"]
    """Unit plane normal n and offset d of each triangle in its link's frame: n . p = d."""
    face_barycentric: Float[Tensor, "F 2 4"]
    """Affine maps from a point on the triangle to its second and third barycentric coordinate."""
    face_normals: Float[Tensor, "F 3 3"]
    """Unit vertex normals of each triangle's corners, in its link's frame."""

    @staticmethod
    def of(scene: Scene, device: str | torch.device = "cpu") -> "SceneGeometry":
        """Gather the link meshes of a scene."""
        vertices, normals, links, faces, face_links, arms, colors = [], [], [], [], [], [], []
        first_link, first_vertex = 0, 0
        for arm_index, arm in enumerate(scene.arms):
            for mesh in arm.robot.meshes:
                count = len(mesh.faces)
                vertices.append(mesh.vertices)
                normals.append(mesh.normals)
                links.append(np.full(len(mesh.vertices), first_link + mesh.link))
                faces.append(mesh.faces + first_vertex)
                face_links.append(np.full(count, first_link + mesh.link))
                arms.append(np.full(count, arm_index))
                colors.append(np.broadcast_to(mesh.color, (count, 3)))
                first_vertex += len(mesh.vertices)
            first_link += len(arm.robot.link_names)
        vertex, face = np.concatenate(vertices).astype(np.float64), np.concatenate(faces)
        planes, barycentric = _triangle_maps(vertex[face])

        def tensor(array, dtype=torch.float32) -> Tensor:
            return torch.tensor(np.ascontiguousarray(array), dtype=dtype, device=device)

        return SceneGeometry(
            tensor(vertex),
            tensor(np.concatenate(links), torch.int64),
            tensor(face, torch.int32),
            tensor(np.concatenate(face_links), torch.int64),
            tensor(np.concatenate(arms), torch.int64),
            tensor(np.concatenate(colors)),
            tensor(planes),
            tensor(barycentric),
            tensor(np.concatenate(normals)[face]),
        )


def _triangle_maps(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Planes [F, 4] and barycentric maps [F, 2, 4] of triangles [F, 3, 3]."""
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(ab, ac)
    squared = np.maximum((cross**2).sum(-1, keepdims=True), 1e-30)
    normal = cross / np.sqrt(squared)
    planes = np.concatenate([normal, (normal * a).sum(-1, keepdims=True)], -1)
    # w_b grows along the direction in the plane that is normal to the opposite edge a-c, and likewise w_c.
    gradient_b, gradient_c = np.cross(ac, cross) / squared, np.cross(cross, ab) / squared
    maps = np.stack([gradient_b, gradient_c], 1)
    offsets = -np.einsum("fki,fi->fk", maps, a)
    return planes, np.concatenate([maps, offsets[..., None]], -1)


def link_transforms(scene: Scene, state: SceneState) -> Float[Tensor, "*batch cameras links 4 4"]:
    """Ts_camera_link of every link in every camera, differentiable (f_FK of the paper, then F_B and C)."""
    Ts_world_link = torch.cat(
        [
            state.T_world_base[..., index, None, :, :] @ arm.robot.forward_kinematics(state.joint_positions[index])
            for index, arm in enumerate(scene.arms)
        ],
        dim=-3,
    )
    return state.T_camera_world[..., :, None, :, :] @ Ts_world_link[..., None, :, :, :]
