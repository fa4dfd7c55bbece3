"""Slow and obvious twins of the fast pieces, for tests to compare with."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from carts_core.model.scene import Light
from carts_core.rendering.rasterizer import BACKGROUND, NEAR


def visibility_ref(
    vertices_camera: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
) -> tuple[Int[Tensor, "height width"], Float[Tensor, "height width"]]:
    """Cast a ray through each pixel centre at each triangle (Möller and Trumbore) and keep the nearest hit.

    Returns the same as `visibility_numba`. Depth is along the optical axis. Hits before the near plane do not count,
    which is what clipping there means.
    """
    fx, fy, cx, cy = intrinsics
    a, b, c = vertices_camera.double()[faces.long()].unbind(1)
    ab, ac = b - a, c - a
    face_ids = torch.full((height, width), BACKGROUND, dtype=torch.int32)
    depths = torch.zeros(height, width)
    for y in range(height):
        for x in range(width):
            ray = torch.tensor([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, 1.0], dtype=torch.float64)
            normal = torch.cross(ray.expand_as(ac), ac, dim=-1)
            determinant = (ab * normal).sum(-1)
            u = -(a * normal).sum(-1) / determinant
            other = torch.cross(-a, ab, dim=-1)
            v = (other * ray).sum(-1) / determinant
            depth = (ac * other).sum(-1) / determinant
            hit = (determinant.abs() > 1e-30) & (u >= 0) & (v >= 0) & (u + v <= 1) & (depth >= NEAR)
            if bool(hit.any()):
                index = int(torch.where(hit, depth, torch.inf).argmin())
                face_ids[y, x], depths[y, x] = index, float(depth[index])
    return face_ids, depths


def phong_ref(color: Tensor, point: Tensor, normal: Tensor, light: Light) -> Tensor:
    """One point's Phong shading, step by step; see `phong`."""
    to_light = torch.tensor(light.position, dtype=point.dtype) - point
    to_light = to_light / to_light.norm()
    to_camera = -point / point.norm()
    if float(normal @ to_camera) < 0:
        normal = -normal
    cosine = normal @ to_light
    shade = color * light.ambient
    if float(cosine) > 0:
        mirrored = 2 * cosine * normal - to_light
        shade = shade + color * light.diffuse * cosine
        shade = shade + light.specular * (mirrored @ to_camera).clamp(min=1e-4) ** light.shininess
    return shade.clamp(max=1.0)


def carry_motion_ref(
    image: Float[Tensor, "height width channels"],
    positions: Float[Tensor, "height width 2"],
    inverse_depth: Float[Tensor, "height width"],
) -> Float[Tensor, "height width channels"]:
    """Add the zero-valued term of each adjacent pair, one by one; see `carry_motion`, here for one view.

    `positions` of background pixels are not used.
    """
    values, motion = image.detach(), positions - positions.detach()
    moving = [[image[y, x] for x in range(image.shape[1])] for y in range(image.shape[0])]
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            for axis, (next_y, next_x) in enumerate(((y, x + 1), (y + 1, x))):
                if next_y == image.shape[0] or next_x == image.shape[1]:
                    continue
                first_is_near = bool(inverse_depth[y, x] >= inverse_depth[next_y, next_x])
                near = (y, x) if first_is_near else (next_y, next_x)
                if inverse_depth[near] == 0:
                    continue
                term = 0.5 * (values[y, x] - values[next_y, next_x]) * motion[near][axis]
                moving[y][x] = moving[y][x] + term
                moving[next_y][next_x] = moving[next_y][next_x] + term
    return torch.stack([torch.stack(row) for row in moving])
