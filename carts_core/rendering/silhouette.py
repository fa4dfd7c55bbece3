"""The gradient that a hard visibility image lacks: how occlusion boundaries move.

For each pair of adjacent pixels across a boundary, the nearer surface's projected point x_a moves with its triangle;
along the pair's axis n, the image moves with it. Adding ``0.5 * sg(I_a - I_b) * n . (x_a - sg(x_a))`` (sg: no
gradient) to both pixels changes no value and gives the boundary its gradient: horizontal pairs integrate motion in x,
vertical pairs motion in y. The velocity of the surface point serves for that of the contour, because there the tangent
plane contains the viewing ray.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

_CONTINUOUS = 2.0
"""Depth differences below this many pixel footprints are no occlusion."""


@dataclass(frozen=True)
class BoundaryPairs:
    """Adjacent pixels across an occlusion boundary; `P` counts pairs through all views."""

    near: Int[Tensor, " P"]
    """The nearer pixel, as an index into the flattened `views x height x width`."""
    far: Int[Tensor, " P"]
    axis: Int[Tensor, " P"]
    """0 for a horizontal pair, 1 for a vertical one."""
    sign: Float[Tensor, " P"]
    """+1 when the far pixel is to the right of (or below) the near one, else -1."""


def boundary_pairs(
    face_ids: Int[Tensor, "views height width"],
    depth: Float[Tensor, "views height width"],
    slope: Float[Tensor, "views height width 2"],
    focal: Float[Tensor, "views 2"],
) -> BoundaryPairs:
    """Find the pairs that straddle an occlusion boundary.

    Args:
        face_ids: visible triangle, -1 for background.
        depth: [m].
        slope: change of depth per pixel of the visible triangle's plane, along x and y [m/px].
        focal: fx, fy [px].
    """
    near, far, axes, signs = [], [], [], []
    pixel = torch.arange(face_ids.numel(), device=face_ids.device).view(face_ids.shape)
    for axis, dim in ((0, 2), (1, 1)):
        length = face_ids.shape[dim] - 1

        def first(image: Tensor, dim: int = dim, length: int = length) -> Tensor:
            return image.narrow(dim, 0, length)

        def second(image: Tensor, dim: int = dim, length: int = length) -> Tensor:
            return image.narrow(dim, 1, length)

        covered_a, covered_b = first(face_ids) >= 0, second(face_ids) >= 0
        z_a, z_b = first(depth), second(depth)
        # Two planes that meet explain at most the sum of their own depth changes between the two pixels.
        planes = first(slope[..., axis]).abs() + second(slope[..., axis]).abs()
        footprint = torch.minimum(z_a, z_b) / focal[:, axis, None, None]
        jump = (z_a - z_b).abs() > planes + _CONTINUOUS * footprint
        boundary = (covered_a != covered_b) | (covered_a & covered_b & jump)
        a_is_near = covered_a & (~covered_b | (z_a <= z_b))
        index_a, index_b = first(pixel)[boundary], second(pixel)[boundary]
        a_first = a_is_near[boundary]
        near.append(torch.where(a_first, index_a, index_b))
        far.append(torch.where(a_first, index_b, index_a))
        axes.append(torch.full_like(index_a, axis))
        signs.append(torch.where(a_first, 1.0, -1.0))
    return BoundaryPairs(torch.cat(near), torch.cat(far), torch.cat(axes), torch.cat(signs))


def boundary_term(
    pairs: BoundaryPairs, values: Float[Tensor, "pixels channels"], near_positions: Float[Tensor, "P 2"]
) -> Float[Tensor, "P channels"]:
    """The zero-valued term that carries the boundary's gradient, to be added to both pixels of each pair.

    Args:
        pairs: the boundary.
        values: image values of the flattened pixels, of which no gradient is taken.
        near_positions: projected surface points at the near pixels [px], with gradient.
    """
    position = near_positions.gather(1, pairs.axis[:, None])[:, 0]
    motion = pairs.sign * (position - position.detach())
    difference = (values[pairs.near] - values[pairs.far]).detach()
    return 0.5 * difference * motion[:, None]
