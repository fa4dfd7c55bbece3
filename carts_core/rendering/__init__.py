"""Differentiable rendering: hard visibility, sparse shading, silhouette gradient."""

from .jacobian import JacobianBlock as JacobianBlock
from .jacobian import Tangents as Tangents
from .outline import Outline as Outline
from .picking import pick_point as pick_point
from .renderer import Renderer as Renderer
from .renderer import Rendering as Rendering
from .surface import SurfaceRendering as SurfaceRendering
from .visibility_numba import visibility_numba as visibility
from .visibility_torch import visibility_torch as visibility_torch

__all__ = [
    "JacobianBlock",
    "Outline",
    "Renderer",
    "Rendering",
    "SurfaceRendering",
    "Tangents",
    "pick_point",
    "visibility",
    "visibility_torch",
]
