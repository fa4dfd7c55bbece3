"""Differentiable rendering: hard visibility, sparse shading, silhouette gradient.

Names that require PyTorch are imported on first use.
"""

from typing import TYPE_CHECKING

from ..package_imports import names_on_first_use
from .image_renderer import ImageRenderer as ImageRenderer
from .image_renderer import pick_point as pick_point
from .rasterizer import visibility as visibility

if TYPE_CHECKING:
    from .jacobian import JacobianBlock as JacobianBlock
    from .jacobian import Outline as Outline
    from .jacobian import Tangents as Tangents
    from .renderer import Renderer as Renderer
    from .renderer import Rendering as Rendering
    from .renderer import SurfaceRendering as SurfaceRendering

__getattr__, __dir__ = names_on_first_use(
    __name__,
    {
        "jacobian": ("JacobianBlock", "Outline", "Tangents"),
        "renderer": ("Renderer", "Rendering", "SurfaceRendering"),
    },
)
