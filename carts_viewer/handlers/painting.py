"""What intents about painting do: tools in hand, and layers of the project."""

from dataclasses import replace
from functools import singledispatchmethod
from typing import Any

from carts_core.project import Key, Kind
from carts_viewer import intents
from carts_viewer.checks import clamped, unknown
from carts_viewer.context import Context, OpenRun
from carts_viewer.strokes import DIAMETERS, Mask, Stroke, Target, Tool, corrected, ignored

_STEPS = {
    (Target.MASK, False): "Add to the mask",
    (Target.MASK, True): "Remove from the mask",
    (Target.IGNORE, False): "Ignore pixels",
    (Target.IGNORE, True): "Ignore fewer pixels",
}
_CLEARED = {Target.MASK: "Clear the mask correction", Target.IGNORE: "Clear the ignore region"}


class PaintingHandler:
    """The handler that painting is about."""

    def __init__(self, context: Context, run: OpenRun) -> None:
        self._context = context
        self._open_run = run
        self._session = context.session

    @singledispatchmethod
    def handle(self, intent: intents.Painting) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        raise unknown(intent)

    @handle.register
    def _(self, intent: intents.SetTool) -> None:
        self._hold(tool=intent.tool)

    @handle.register
    def _(self, intent: intents.ToggleTool) -> None:
        self._hold(tool=Tool.OFF if self._context.state.brush.tool is intent.tool else intent.tool)

    @handle.register
    def _(self, intent: intents.SetTarget) -> None:
        other = Target.IGNORE if self._context.state.brush.target is Target.MASK else Target.MASK
        self._hold(target=intent.target or other)

    @handle.register
    def _(self, intent: intents.SetDiameter) -> None:
        self._hold(diameter=round(clamped(intent.diameter, *DIAMETERS)))

    @handle.register
    def _(self, intent: intents.ScaleBrush) -> None:
        now = self._context.state.brush.diameter
        by = max(1, round(abs(now * intent.factor - now)))
        self.handle(intents.SetDiameter(now + by if intent.factor > 1 else now - by))

    @handle.register
    def _(self, intent: intents.Paint) -> None:
        stroke = intent.stroke
        painted = {**self._context.state.brush.painted, intent.client_id: stroke.number}
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
    def _(self, intent: intents.ClearLayer) -> None:
        state = self._context.state
        target = intent.target or state.brush.target
        make = Key.mask_correction if target is Target.MASK else Key.ignore_region
        self._change(_CLEARED[target], make(state.index, state.camera), None)

    def _change(self, name: str, key: Key[Any], layer: Any) -> None:
        """Save a layer as one step of undo, if it is another one."""
        if self._session.editor.view.get(key) != layer:
            self._open_run.end("Stopped: something was painted; Run starts anew from here")
            self._context.edit(name, {key: layer}, loss=self._loss(key))

    def _loss(self, key: Key[Any]) -> float | None:
        """The optimizer's loss that still holds after this layer changes: a corrected mask changes nothing for it."""
        figures = self._session.editor.view.figures(key.frame)
        shown = key.frame == self._context.state.index
        return figures.loss if figures and shown and key.kind is Kind.MASK_CORRECTION else None

    def _rendered(self, stroke: Stroke) -> Mask:
        """The mask that the stroke corrects, as it is rendered in the stroke's frame."""
        state = self._context.state
        if stroke.frame == state.index:
            pose = state.pose
        else:
            pose = self._session.pose(self._session.sequence.frame(stroke.frame, cameras=[]))
        return self._context.renderer.mask(pose.scene, stroke.camera)

    def _hold(self, **changes: Any) -> None:
        self._context.change(brush=replace(self._context.state.brush, **changes))
