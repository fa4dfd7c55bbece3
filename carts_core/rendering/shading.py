"""Colour of visible surface points: sparse, differentiable, plain torch."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..scene import Light
from .geometry import SceneGeometry

_GRAZING = 1e-6


@dataclass(frozen=True)
class VisiblePoints:
    """What the visible pixels see. `K` counts visible pixels through all views."""

    view: Int[Tensor, " K"]
    """Index of the view (a camera of a hypothesis)."""
    x: Int[Tensor, " K"]
    y: Int[Tensor, " K"]
    face: Int[Tensor, " K"]

    @staticmethod
    def of(face_ids: Int[Tensor, "views height width"]) -> "VisiblePoints":
        """Gather the pixels that see a triangle."""
        view, y, x = (face_ids >= 0).nonzero(as_tuple=True)
        return VisiblePoints(view, x, y, face_ids[view, y, x].long())


def rotate(matrix: Float[Tensor, "K 3 3"], vector: Float[Tensor, "K 3"]) -> Float[Tensor, "K 3"]:
    """Rows of `matrix @ vector`."""
    return (matrix * vector[:, None, :]).sum(-1)


def rotate_back(matrix: Float[Tensor, "K 3 3"], vector: Float[Tensor, "K 3"]) -> Float[Tensor, "K 3"]:
    """Rows of `matrix^T @ vector`."""
    return (matrix * vector[:, :, None]).sum(-2)


def pixel_rays(points: VisiblePoints, intrinsics: Float[Tensor, "views 4"]) -> Float[Tensor, "K 3"]:
    """Rays through pixel centres, scaled to z = 1, in the camera's frame."""
    fx, fy, cx, cy = intrinsics[points.view].unbind(-1)
    x, y = (points.x + 0.5 - cx) / fx, (points.y + 0.5 - cy) / fy
    return torch.stack([x, y, torch.ones_like(x)], -1)


def intersect(
    geometry: SceneGeometry,
    points: VisiblePoints,
    Ts_camera_link: Float[Tensor, "K 4 4"],
    rays: Float[Tensor, "K 3"],
) -> Float[Tensor, "K 3"]:
    """Where each pixel's ray meets the plane of its triangle, in the frame of the link [m], differentiable."""
    rotation, translation = Ts_camera_link[:, :3, :3], Ts_camera_link[:, :3, 3]
    origin, direction = -rotate_back(rotation, translation), rotate_back(rotation, rays)
    plane = geometry.face_planes[points.face]
    normal, offset = plane[:, :3], plane[:, 3]
    towards = (normal * direction).sum(-1)
    towards = torch.where(towards.abs() < _GRAZING, torch.full_like(towards, _GRAZING), towards)
    depth = (offset - (normal * origin).sum(-1)) / towards
    return origin + depth[:, None] * direction


def phong(
    geometry: SceneGeometry,
    points: VisiblePoints,
    Ts_camera_link: Float[Tensor, "K 4 4"],
    points_link: Float[Tensor, "K 3"],
    light: Light,
) -> Float[Tensor, "K 3"]:
    """Phong shading with one point light in the camera's frame, two-sided.

    Returns:
        Linear RGB in [0, 1].
    """
    rotation, translation = Ts_camera_link[:, :3, :3], Ts_camera_link[:, :3, 3]
    maps = geometry.face_barycentric[points.face]
    # A ray that grazes its triangle may leave it by a rounding error; the clamp also stops its useless gradient.
    weight = ((maps[..., :3] * points_link[:, None, :]).sum(-1) + maps[..., 3]).clamp(0.0, 1.0)
    corners = geometry.face_normals[points.face]
    normal_link = corners[:, 0] + weight[:, :1] * (corners[:, 1] - corners[:, 0])
    normal_link = normal_link + weight[:, 1:] * (corners[:, 2] - corners[:, 0])
    normal = torch.nn.functional.normalize(rotate(rotation, normal_link), dim=-1)
    point = rotate(rotation, points_link) + translation
    to_light = torch.nn.functional.normalize(point.new_tensor(light.position) - point, dim=-1)
    to_camera = torch.nn.functional.normalize(-point, dim=-1)
    facing = (normal * to_camera).sum(-1, keepdim=True)
    normal = torch.where(facing < 0, -normal, normal)
    cosine = (normal * to_light).sum(-1, keepdim=True)
    reflected = 2.0 * cosine * normal - to_light
    highlight = (reflected * to_camera).sum(-1, keepdim=True).clamp(min=1e-4) ** light.shininess
    color = geometry.face_colors[points.face] * (light.ambient + light.diffuse * cosine.clamp(min=0.0))
    return (color + light.specular * highlight * (cosine > 0)).clamp(max=1.0)
