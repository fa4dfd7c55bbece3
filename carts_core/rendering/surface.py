"""Surface maps of visible points, and the picture that a person sees of them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..model.surface import NORMALS, SURFACE_CHANNELS
from .jacobian import JacobianBlock


@dataclass(frozen=True)
class SurfaceRendering:
    """Surface maps of all cameras, without autograd."""

    maps: Float[Tensor, "cameras 6 height width"]
    """See `carts_core.model.surface`."""
    image: Float[Tensor, "cameras 3 height width"]
    """Shaded, linear RGB in [0, 1]."""
    jacobian: tuple[JacobianBlock, ...]
    """Derivative of the maps by the unknowns; empty if it was not asked for."""


def surface_values(parts: Int[Tensor, " K"], normal: Float[Tensor, "3 K"]) -> Float[Tensor, "6 K"]:
    """Surface map where points are seen, from their parts (index into `carts_core.model.parts.PARTS`) and their
    normals, which point to the camera."""
    values = normal.new_zeros(SURFACE_CHANNELS, len(parts))
    values[parts, torch.arange(len(parts), device=parts.device)] = 1.0
    values[NORMALS] = normal
    return values


def scattered(
    values: Float[Tensor, "channels K"], pixel: Int[Tensor, " K"], shape: torch.Size
) -> Float[Tensor, "views channels height width"]:
    """Values of pixels, as indices into flattened images of a shape [views, height, width], in their places; 0 between
    them."""
    dense = values.new_zeros(len(values), shape.numel())
    dense[:, pixel] = values
    return dense.view(-1, *shape).transpose(0, 1).contiguous()
