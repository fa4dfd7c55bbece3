"""Colour of visible surface points: sparse, differentiable, plain torch.

A point's shading has the gradient of its link's turning against light and camera. Vectors are columns (`3 K`).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from ..model.scene import Light


def unit(vectors: Float[Tensor, "3 K"]) -> Float[Tensor, "3 K"]:
    """Columns scaled to length 1."""
    return vectors * vectors.square().sum(0).clamp(min=1e-24).rsqrt()


def phong(
    color: Float[Tensor, "3 K"], points: Float[Tensor, "3 K"], normals: Float[Tensor, "3 K"], light: Light
) -> Float[Tensor, "3 K"]:
    """Phong shading with one point light, two-sided.

    Args:
        color: of the surface, linear RGB.
        points: in the camera's frame [m].
        normals: unit vectors in the camera's frame.
        light: its position is in the camera's frame.

    Returns:
        Linear RGB in [0, 1].
    """
    to_light = unit(points.new_tensor(light.position)[:, None] - points)
    to_camera = -unit(points)
    towards_camera = (normals * to_camera).sum(0)
    # A surface that is seen from behind is lit from behind.
    side = torch.where(towards_camera.detach() < 0, -1.0, 1.0)
    cosine = (normals * to_light).sum(0) * side
    # The mirrored direction of the light is 2 (n . l) n - l; only its cosine to the camera is needed.
    mirrored = 2.0 * cosine * towards_camera * side - (to_light * to_camera).sum(0)
    highlight = light.specular * mirrored.clamp(min=1e-4) ** light.shininess * (cosine > 0)
    lit = light.ambient + light.diffuse * cosine.clamp(min=0.0)
    return (color * lit + highlight).clamp(max=1.0)
