"""Painting over the picture: tools, strokes and layers."""

from dataclasses import dataclass

from carts_viewer.intents.base import Intent, Latest
from carts_viewer.strokes import Stroke, Target, Tool


@dataclass(frozen=True)
class Painting(Intent):
    """An intent about painted layers and the tools for them."""


@dataclass(frozen=True)
class SetTool(Painting, Latest):
    """Take a tool."""

    tool: Tool


@dataclass(frozen=True)
class ToggleTool(Painting):
    """Take a tool or, if it is in hand, put it away."""

    tool: Tool


@dataclass(frozen=True)
class SetTarget(Painting, Latest):
    """Paint on this layer; None changes over."""

    target: Target | None = None


@dataclass(frozen=True)
class SetPaintClass(Painting, Latest):
    """Paint this class on the mask (`carts_core.model.parts.PartClass`); 0: any arm."""

    number: int


@dataclass(frozen=True)
class SetDiameter(Painting, Latest):
    """Make the brush this thick [px]."""

    diameter: float


@dataclass(frozen=True)
class ScaleBrush(Painting):
    """Make the brush thicker or thinner by a factor, by a pixel at least."""

    factor: float


@dataclass(frozen=True)
class Paint(Painting):
    """Apply a finished stroke."""

    client_id: int
    stroke: Stroke


@dataclass(frozen=True)
class NextObject(Painting):
    """The next click with the prompt is about something else."""


@dataclass(frozen=True)
class ClearLayer(Painting):
    """Remove what was painted on a layer of the shown frame and camera; None: the layer that is painted on."""

    target: Target | None = None
