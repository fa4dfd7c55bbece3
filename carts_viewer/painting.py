"""Painting over frames: what people ask for, and what that does to the project."""

import math
from dataclasses import dataclass, replace
from functools import singledispatchmethod
from typing import TYPE_CHECKING, Any

from carts_core.errors import CartsError
from carts_core.project import Key, Kind
from carts_viewer.intents import Intent, Latest
from carts_viewer.strokes import DIAMETERS, Mask, Stroke, Target, Tool, corrected, ignored

if TYPE_CHECKING:
    from carts_viewer.controller import Controller

_STEPS = {
    (Target.MASK, False): "Add to the mask",
    (Target.MASK, True): "Remove from the mask",
    (Target.IGNORE, False): "Ignore pixels",
    (Target.IGNORE, True): "Ignore fewer pixels",
}
_CLEARED = {Target.MASK: "Clear the mask correction", Target.IGNORE: "Clear the ignore region"}


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
class ClearLayer(Painting):
    """Remove what was painted on a layer of the shown frame and camera; None: the layer that is painted on."""

    target: Target | None = None


class Brushwork:
    """The part of the controller that painting is about."""

    def __init__(self, controller: "Controller") -> None:
        self._controller = controller
        self._session = controller.session

    @singledispatchmethod
    def handle(self, intent: Painting) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        raise CartsError(f"The viewer does not know what to do with {type(intent).__name__}; this is a bug.")

    @handle.register
    def _(self, intent: SetTool) -> None:
        self._hold(tool=intent.tool)

    @handle.register
    def _(self, intent: ToggleTool) -> None:
        self._hold(tool=Tool.OFF if self._controller.state.brush.tool is intent.tool else intent.tool)

    @handle.register
    def _(self, intent: SetTarget) -> None:
        other = Target.IGNORE if self._controller.state.brush.target is Target.MASK else Target.MASK
        self._hold(target=intent.target or other)

    @handle.register
    def _(self, intent: SetDiameter) -> None:
        if not math.isfinite(intent.diameter):
            raise CartsError(f"{intent.diameter} is no size of a brush. Give {DIAMETERS[0]} to {DIAMETERS[1]} pixels.")
        self._hold(diameter=round(min(max(intent.diameter, DIAMETERS[0]), DIAMETERS[1])))

    @handle.register
    def _(self, intent: ScaleBrush) -> None:
        now = self._controller.state.brush.diameter
        least = 1 if intent.factor > 1 else -1
        self.handle(SetDiameter(now + least * max(1, round(abs(now * intent.factor - now)))))

    @handle.register
    def _(self, intent: Paint) -> None:
        stroke = intent.stroke
        painted = {**self._controller.state.brush.painted, intent.client_id: stroke.number}
        try:
            covered = stroke.covers(self._session.scene.camera(stroke.camera))
            project = self._session.editor.view
            if stroke.target is Target.MASK:
                key: Key[Any] = Key.mask_correction(stroke.frame, stroke.camera)
                layer = corrected(project.get(key), covered, self._rendered(stroke), erase=stroke.erase)
            else:
                key = Key.ignore_region(stroke.frame, stroke.camera)
                layer = ignored(project.get(key), covered, erase=stroke.erase)
            self._change(_STEPS[stroke.target, stroke.erase], key, layer)
        finally:
            self._hold(painted=painted)

    @handle.register
    def _(self, intent: ClearLayer) -> None:
        state = self._controller.state
        target = intent.target or state.brush.target
        make = Key.mask_correction if target is Target.MASK else Key.ignore_region
        self._change(_CLEARED[target], make(state.index, state.camera), None)

    def _change(self, name: str, key: Key[Any], layer: Any) -> None:
        """Save a layer as one step of undo, if it is another one."""
        if self._session.editor.view.get(key) != layer:
            self._controller.end_run("Stopped: something was painted; Run starts anew from here")
            self._controller.stage(name, {key: layer}, loss=self._loss(key), frame=key.frame)

    def _loss(self, key: Key[Any]) -> float | None:
        """The optimizer's loss that still holds after this layer changes: a corrected mask changes nothing for it."""
        figures = self._session.editor.view.figures(key.frame)
        shown = key.frame == self._controller.state.index
        return figures.loss if figures and shown and key.kind is Kind.MASK_CORRECTION else None

    def _rendered(self, stroke: Stroke) -> Mask:
        """The mask that the stroke corrects, as it is rendered in the stroke's frame."""
        state = self._controller.state
        if stroke.frame == state.index:
            pose = state.pose
        else:
            pose = self._session.pose(self._session.sequence.frame(stroke.frame, cameras=[]))
        return self._controller.painter.mask(pose.scene, stroke.camera)

    def _hold(self, **changes: Any) -> None:
        self._controller.change(brush=replace(self._controller.state.brush, **changes))
