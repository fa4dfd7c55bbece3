"""Visible surface points and their colour: sparse, differentiable, plain torch.

Points and normals are taken in the frame of their link, where they stand still; what the state moves is the link. So a
point's shading has the gradient of its turning against light and camera, and its projection the gradient of its motion.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..scene import Light
from .geometry import SceneGeometry

_GRAZING = 1e-9


@dataclass(frozen=True)
class VisiblePoints:
    """What the visible pixels see. `K` counts visible pixels through all views. Nothing here carries a gradient."""

    view: Int[Tensor, " K"]
    """Index of the view (a camera of a hypothesis)."""
    pixel: Int[Tensor, " K"]
    """Index into the flattened `views x height x width`."""
    face: Int[Tensor, " K"]
    point_link: Float[Tensor, "K 3"]
    """The surface point, in the frame of its link [m]."""
    normal_link: Float[Tensor, "K 3"]
    """Interpolated normal there, in the frame of its link."""


def rotate(matrix: Float[Tensor, "K 3 3"], vector: Float[Tensor, "K 3"]) -> Float[Tensor, "K 3"]:
    """Rows of `matrix @ vector`."""
    return (matrix * vector[:, None, :]).sum(-1)


def rotate_back(matrix: Float[Tensor, "K 3 3"], vector: Float[Tensor, "K 3"]) -> Float[Tensor, "K 3"]:
    """Rows of `matrix^T @ vector`."""
    return (matrix * vector[:, :, None]).sum(-2)


@torch.no_grad()
def visible_points(
    geometry: SceneGeometry,
    face_ids: Int[Tensor, "views height width"],
    Ts_camera_link: Float[Tensor, "views links 4 4"],
    intrinsics: Float[Tensor, "views 4"],
) -> VisiblePoints:
    """Meet each visible pixel's ray with the plane of its triangle."""
    view, y, x = (face_ids >= 0).nonzero(as_tuple=True)
    face = face_ids[view, y, x].long()
    T = Ts_camera_link[view, geometry.face_links[face]]
    fx, fy, cx, cy = intrinsics[view].unbind(-1)
    ray = torch.stack([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, torch.ones_like(fx)], -1)
    origin, direction = -rotate_back(T[:, :3, :3], T[:, :3, 3]), rotate_back(T[:, :3, :3], ray)
    plane = geometry.face_planes[face]
    towards = (plane[:, :3] * direction).sum(-1)
    towards = torch.where(towards.abs() < _GRAZING, torch.full_like(towards, _GRAZING), towards)
    depth = (plane[:, 3] - (plane[:, :3] * origin).sum(-1)) / towards
    point = origin + depth[:, None] * direction
    maps = geometry.face_barycentric[face]
    # A ray that grazes its triangle may leave it by a rounding error.
    weight = ((maps[..., :3] * point[:, None, :]).sum(-1) + maps[..., 3]).clamp(0.0, 1.0)
    corners = geometry.face_normals[face]
    normal = corners[:, 0] + weight[:, :1] * (corners[:, 1] - corners[:, 0])
    normal = normal + weight[:, 1:] * (corners[:, 2] - corners[:, 0])
    height, width = face_ids.shape[1:]
    pixel = (view * height + y) * width + x
    return VisiblePoints(view, pixel, face, point, torch.nn.functional.normalize(normal, dim=-1))


def phong(
    color: Float[Tensor, "K 3"], points: Float[Tensor, "K 3"], normals: Float[Tensor, "K 3"], light: Light
) -> Float[Tensor, "K 3"]:
    """Phong shading with one point light, two-sided.

    Args:
        color: of the surface, linear RGB.
        points: in the camera's frame [m].
        normals: unit vectors in the camera's frame.
        light: its position is in the camera's frame.

    Returns:
        Linear RGB in [0, 1].
    """
    to_light = torch.nn.functional.normalize(points.new_tensor(light.position) - points, dim=-1)
    to_camera = torch.nn.functional.normalize(-points, dim=-1)
    facing = (normals * to_camera).sum(-1, keepdim=True)
    normals = torch.where(facing < 0, -normals, normals)
    cosine = (normals * to_light).sum(-1, keepdim=True)
    reflected = 2.0 * cosine * normals - to_light
    highlight = (reflected * to_camera).sum(-1, keepdim=True).clamp(min=1e-4) ** light.shininess
    lit = color * (light.ambient + light.diffuse * cosine.clamp(min=0.0))
    return (lit + light.specular * highlight * (cosine > 0)).clamp(max=1.0)
