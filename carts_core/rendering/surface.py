"""Surface maps of a state, and how they change with it.

The derivative is that of `motion.py`, but forward: for every unknown, the velocity of every visible point in the image
carries the map along, and the turning of its link turns its normal.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..scene import Light
from ..surface import NORMALS, SURFACE_CHANNELS
from .shading import VisiblePoints, phong


@dataclass(frozen=True)
class Tangents:
    """Derivatives of what a renderer places and projects with, one per unknown."""

    Ts_camera_link: Float[Tensor, "unknowns cameras links 4 4"]
    intrinsics: Float[Tensor, "unknowns cameras 4"]
    """[px] of the rendered size."""


@dataclass(frozen=True)
class SurfaceRendering:
    """Surface maps of all cameras, without autograd."""

    maps: Float[Tensor, "cameras 6 height width"]
    """See `carts_core.surface`."""
    image: Float[Tensor, "cameras 3 height width"]
    """Shaded, linear RGB in [0, 1]."""
    jacobian: Float[Tensor, "unknowns cameras 6 height width"] | None
    """Derivative of the maps by each unknown, if asked for."""


def surface_maps(
    points: VisiblePoints,
    parts: Int[Tensor, " K"],
    colors: Float[Tensor, "3 K"],
    light: Light,
    Ts_camera_link: Float[Tensor, "cameras links 4 4"],
    intrinsics: Float[Tensor, "cameras 4"],
    inverse_depth: Float[Tensor, "cameras height width"],
    tangents: Tangents | None = None,
) -> SurfaceRendering:
    """Surface maps of visible points.

    Args:
        points: what each pixel sees.
        parts: index into `carts_core.parts.PARTS` per point.
        colors, light: what the image is shaded with.
        Ts_camera_link, intrinsics: where links are, and the cameras.
        inverse_depth: 1 / depth [1/m], 0 for background.
        tangents: of the unknowns; without them there is no Jacobian.
    """
    position, normal = points.transformed(Ts_camera_link)
    side = torch.where((position * normal).sum(0) > 0, -1.0, 1.0)
    values = position.new_zeros(SURFACE_CHANNELS, len(points.pixel))
    values[parts, torch.arange(len(parts), device=parts.device)] = 1.0
    values[NORMALS] = normal * side
    values = torch.cat([values, phong(colors, position, normal, light)])
    dense = values.new_zeros(len(values), inverse_depth.numel())
    dense[:, points.pixel] = values
    dense = dense.view(len(values), *inverse_depth.shape).transpose(0, 1).contiguous()
    maps, image = dense[:, :SURFACE_CHANNELS].contiguous(), dense[:, SURFACE_CHANNELS:]
    if tangents is None:
        return SurfaceRendering(maps, image, None)
    velocity, turning = _motion(points, position, side, intrinsics, inverse_depth, tangents)
    jacobian = _carried(maps, velocity, inverse_depth)
    jacobian[:, :, NORMALS] += turning
    return SurfaceRendering(maps, image, jacobian)


def _motion(
    points: VisiblePoints,
    position: Float[Tensor, "3 K"],
    side: Float[Tensor, " K"],
    intrinsics: Float[Tensor, "cameras 4"],
    inverse_depth: Float[Tensor, "cameras height width"],
    tangents: Tangents,
) -> tuple[Float[Tensor, "unknowns cameras 2 height width"], Float[Tensor, "unknowns cameras 3 height width"]]:
    """Velocity of what each pixel sees [px per unit of each unknown], and the change of its normal."""
    unknowns = len(tangents.Ts_camera_link)
    flat = position.new_zeros(unknowns, 5, inverse_depth.numel())
    begin = 0
    for view, link, count in points.groups:
        here = slice(begin, begin + count)
        begin += count
        dT, dK, K = tangents.Ts_camera_link[:, view, link], tangents.intrinsics[:, view], intrinsics[view]
        moving = ((dT.abs().amax((1, 2)) > 0) | (dK.abs().amax(1) > 0)).nonzero()[:, 0]
        dT, dK = dT[moving], dK[moving]
        dX = dT[:, :3, :3] @ points.point_link[:, here] + dT[:, :3, 3:]
        X, Y, Z = position[:, here]
        motion = torch.cat(
            [
                (K[0] * (dX[:, 0] - X / Z * dX[:, 2]) / Z + dK[:, 0:1] * (X / Z) + dK[:, 2:3])[:, None],
                (K[1] * (dX[:, 1] - Y / Z * dX[:, 2]) / Z + dK[:, 1:2] * (Y / Z) + dK[:, 3:4])[:, None],
                dT[:, :3, :3] @ (points.normal_link[:, here] * side[here]),
            ],
            1,
        )
        pixel = points.pixel[here]
        for unknown, value in zip(moving.tolist(), motion, strict=True):
            flat[unknown][:, pixel] = value
    shaped = flat.view(unknowns, 5, *inverse_depth.shape).transpose(1, 2)
    return shaped[:, :, :2], shaped[:, :, 2:]


def _carried(
    maps: Float[Tensor, "cameras 6 height width"],
    velocity: Float[Tensor, "unknowns cameras 2 height width"],
    inverse_depth: Float[Tensor, "cameras height width"],
) -> Float[Tensor, "unknowns cameras 6 height width"]:
    """Change of the maps as adjacent pixels are carried by the nearer one's point; see `motion.py`."""
    jacobian = maps.new_zeros(len(velocity), *maps.shape)
    size = maps.shape[2:]
    for axis, dim in ((0, 3), (1, 2)):
        length = size[dim - 2] - 1
        first, second = maps.narrow(dim, 0, length), maps.narrow(dim, 1, length)
        half = 0.5 * (first - second)
        first_nearer = inverse_depth.narrow(dim - 1, 0, length) >= inverse_depth.narrow(dim - 1, 1, length)
        along = velocity[:, :, axis]
        speed = torch.where(first_nearer, along.narrow(dim, 0, length), along.narrow(dim, 1, length))
        moved = speed[:, :, None] * half
        jacobian.narrow(dim + 1, 0, length).add_(moved)
        jacobian.narrow(dim + 1, 1, length).add_(moved)
    return jacobian
