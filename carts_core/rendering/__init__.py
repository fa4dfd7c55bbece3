"""Differentiable rendering: hard visibility, sparse shading, silhouette gradient."""

from .jacobian import JacobianBlock as JacobianBlock
from .jacobian import Outline as Outline
from .jacobian import Tangents as Tangents
from .rasterizer import visibility as visibility
from .renderer import Renderer as Renderer
from .renderer import Rendering as Rendering
from .renderer import SurfaceRendering as SurfaceRendering
from .renderer import pick_point as pick_point
