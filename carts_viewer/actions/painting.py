"""Painting on masks and ignore regions, by strokes or by prompts to the segmenter."""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import UInt8

from carts_core.errors import CartsError
from carts_core.model.parts import part_classes
from carts_core.project import Edits, Key, Kind
from carts_core.segmentation import Prompt
from carts_viewer.actions import intents
from carts_viewer.actions.context import Context, Handler, clamped
from carts_viewer.jobs.optimizers import wait_for
from carts_viewer.jobs.solver_process import Reply
from carts_viewer.picture.layers import Layer
from carts_viewer.picture.strokes import DIAMETERS, Mask, Stroke, Target, Tool, corrected, ignored, relabelled

_STEPS = {
    (Target.MASK, False): "Add to the mask",
    (Target.MASK, True): "Remove from the mask",
    (Target.IGNORE, False): "Ignore pixels",
    (Target.IGNORE, True): "Ignore fewer pixels",
}
_CLEARED = {Target.MASK: "Clear the mask correction", Target.IGNORE: "Clear the ignore region"}


Layers = Mapping[Key[Any], Any]
Segment = Callable[[UInt8[np.ndarray, "height width 3"], Prompt], Reply[Mask]]
"""Function that segments the object of a prompt."""


class PaintingHandler(Handler):
    """Handler of painting tools, strokes and prompts."""

    def __init__(self, context: Context, segment: Segment) -> None:
        super().__init__(context)
        self._segment, self._prompting = segment, Prompting()
        self._prompts: deque[intents.Paint] = deque()
        """Prompts that are not segmented yet, oldest first."""
        self._reply: Reply[Mask] | None = None
        """Mask of the first prompt, if it was requested."""

    def wait_time(self) -> float | None:
        """Time until the reply to a prompt is due [s]; None without a prompt."""
        return wait_for(self._reply) if self._prompts else None

    def advance(self) -> None:
        """Apply the masks of prompts that have arrived.

        Raises:
            CartsError: segmentation failed or found nothing.
        """
        while self._prompts and wait_for(self._reply) == 0.0:
            stroke, reply, self._reply = self._prompts[0].stroke, self._reply, None
            try:
                if reply is None:
                    self._reply = self._segment(
                        self._image(stroke), self._prompting.begin(stroke, self._layers(stroke))
                    )
                else:
                    edits = self._prompting.edits(reply.result(), self._layers(stroke), self._changed(stroke))
                    self._change(self._step(stroke), edits)
            finally:
                if self._reply is None:
                    self.answer(self._prompts.popleft())

    def _on_NextObject(self, intent: intents.NextObject) -> None:
        self._prompting.finish()

    def _on_SetTool(self, intent: intents.SetTool) -> None:
        self._prompting.finish()
        self._set_brush(tool=intent.tool)

    def _on_ToggleTool(self, intent: intents.ToggleTool) -> None:
        self._set_brush(tool=Tool.SELECT if self._context.state.brush.tool is intent.tool else intent.tool)

    def _on_SetTarget(self, intent: intents.SetTarget) -> None:
        brush = self._context.state.brush
        target = intent.target or (Target.IGNORE if brush.target is Target.MASK else Target.MASK)
        needs_brush = target is Target.IGNORE and not brush.tool.paints
        self._set_brush(target=target, tool=Tool.BRUSH if needs_brush else brush.tool)

    def _on_SetPaintClass(self, intent: intents.SetPaintClass) -> None:
        known = {0, *(one.number for one in part_classes(self._session.scene.arms))}
        if intent.number not in known:
            raise CartsError(f"Unknown class {intent.number!r}. Choose one of: {', '.join(map(str, sorted(known)))}.")
        self._set_brush(label=intent.number, target=Target.MASK)
        if intent.number:
            # The layer of parts shows the painted classes.
            self._context.change(layer=Layer.PARTS)

    def _on_SetDiameter(self, intent: intents.SetDiameter) -> None:
        self._set_brush(diameter=round(clamped(intent.diameter, *DIAMETERS)))

    def _on_ScaleBrush(self, intent: intents.ScaleBrush) -> None:
        now = self._context.state.brush.diameter
        by = max(1, round(abs(now * intent.factor - now)))
        self.handle(intents.SetDiameter(now + by if intent.factor > 1 else now - by))

    def _on_Paint(self, intent: intents.Paint) -> None:
        stroke = intent.stroke
        if stroke.prompt:
            self._prompts.append(intent)
            self.advance()
            return
        try:
            covered = stroke.covers(self._session.scene.camera(stroke.camera))
            self._change(self._step(stroke), self._changed(stroke)(self._layers(stroke), covered, stroke.erase))
        finally:
            self.answer(intent)

    def answer(self, intent: intents.Paint) -> None:
        """Report to the page that a stroke is applied or refused."""
        self._set_brush(painted={**self._context.state.brush.painted, intent.client_id: intent.stroke.number})

    def _on_ClearLayer(self, intent: intents.ClearLayer) -> None:
        state = self._context.state
        target = intent.target or state.brush.target
        painted = (Key.mask_correction, Key.part_labels) if target is Target.MASK else (Key.ignore_region,)
        self._change(_CLEARED[target], {make(state.index, state.camera): None for make in painted})

    def _layers(self, stroke: Stroke) -> Layers:
        """The layers that a stroke may change: the ignore region, or the mask and the part labels."""
        make = (Key.ignore_region,) if stroke.target is Target.IGNORE else (Key.mask_correction, Key.part_labels)
        keys: list[Key[Any]] = [one(stroke.frame, stroke.camera) for one in make]
        return {key: self._session.editor.view.get(key) for key in keys}

    def _changed(self, stroke: Stroke) -> Callable[[Layers, Mask, bool], Edits]:
        """Function of layers, pixels, and whether these are erased, that returns the changed layers."""

        def changed(layers: Layers, covered: Mask, erase: bool) -> Edits:
            if stroke.target is Target.IGNORE:
                return {key: ignored(layer, covered, erase=erase) for key, layer in layers.items()}
            (mask, correction), (labels, painted) = layers.items()
            return {
                mask: corrected(correction, covered, self._rendered(stroke), erase=erase),
                labels: relabelled(painted, covered, stroke.label, erase=erase),
            }

        return changed

    def _image(self, stroke: Stroke) -> UInt8[np.ndarray, "height width 3"]:
        """The image on which a stroke was drawn."""
        state = self._context.state
        if stroke.frame == state.index and stroke.camera in state.frame.images:
            return state.frame.images[stroke.camera]
        frame = self._session.sequence.frame(stroke.frame, state.domain, [stroke.camera])
        return frame.images[stroke.camera]

    def _step(self, stroke: Stroke) -> str:
        """Name of a stroke in the history."""
        if stroke.prompt:
            return "Segment with a prompt"
        if stroke.label and not stroke.erase and stroke.target is Target.MASK:
            names = {one.number: one.name for one in part_classes(self._session.scene.arms)}
            return f"Paint {names[stroke.label]}"
        return _STEPS[stroke.target, stroke.erase]

    def _change(self, name: str, edits: Edits) -> None:
        """Save the layers that have changed as one undo step."""
        view = self._session.editor.view
        changed = {key: layer for key, layer in edits.items() if view.get(key) != layer}
        if changed:
            self._context.end_run("Stopped: a layer was painted; Run starts from the current pose")
            self._context.edit(name, changed, loss=self._loss(next(iter(changed))))

    def _loss(self, key: Key[Any]) -> float | None:
        """Loss of the shown frame; None if a change of this layer affects it, as for ignore regions."""
        figures = self._session.editor.view.figures(key.frame)
        shown = key.frame == self._context.state.index
        return figures.loss if figures and shown and key.kind is not Kind.IGNORE_REGION else None

    def _rendered(self, stroke: Stroke) -> Mask:
        """The rendered mask that the stroke corrects."""
        state = self._context.state
        if stroke.frame == state.index:
            pose = state.pose
        else:
            pose = self._session.pose(self._session.sequence.frame(stroke.frame, cameras=[]))
        return self._context.renderer.mask(pose.scene, stroke.camera)

    def _set_brush(self, **changes: Any) -> None:
        self._context.change(brush=replace(self._context.state.brush, **changes))


@dataclass(frozen=True)
class _PromptedObject:
    """A segmented object that further clicks refine."""

    place: tuple[int, str, Target, int]
    """Frame, camera, target and class."""
    prompt: Prompt
    before: Layers
    """The layers before the object was added."""
    after: Layers
    """The layers after the object was added; before that, those at the prompt."""


class Prompting:
    """Turns clicks and boxes into edits of painted layers.

    A click adds the object under the pointer. Further clicks refine this object by a point on it or, with `erase`, off
    it, until the layers are changed otherwise. A box replaces the content of the layer inside the box by the
    segmentation. With `erase`, a box or any other click removes the segmented object.
    """

    def __init__(self) -> None:
        self._begun: _PromptedObject | None = None
        """The object that the next click may refine."""
        self._asked: tuple[_PromptedObject, bool] | None = None
        """The object of the prompt that is being segmented, and whether it is erased."""

    def finish(self) -> None:
        """Let the next click start a new object."""
        self._begun = None

    def begin(self, stroke: Stroke, layers: Layers) -> Prompt:
        """The prompt of a click or a box.

        Args:
            stroke: one point, or two corners of a box.
            layers: the layers that the stroke may change.
        """
        place = (stroke.frame, stroke.camera, stroke.target, stroke.label)
        begun, prompt = self._begun, prompt_of(stroke)
        self._begun = None
        before, erase = layers, stroke.erase
        if begun is not None and (begun.place, begun.after) == (place, layers) and prompt.box is None:
            point = prompt.inside
            inside, outside = begun.prompt.inside, begun.prompt.outside
            prompt = Prompt(
                *((inside, outside + point) if stroke.erase else (inside + point, outside)), begun.prompt.box
            )
            before, erase = begun.before, False
        self._asked = _PromptedObject(place, prompt, before, layers), erase
        return prompt

    def edits(self, found: Mask, layers: Layers, changed: Callable[[Layers, Mask, bool], Edits]) -> Edits:
        """Edits of the prompt that was begun last.

        Args:
            found: the segmented pixels.
            layers: the layers that the prompt may change; changes since `begin` are kept.
            changed: function of layers, pixels, and whether these are erased, that returns the changed layers.
        """
        assert self._asked is not None
        (asked, erase), self._asked = self._asked, None
        before, box = asked.before if layers == asked.after else layers, asked.prompt.box
        cleared = before if box is None or erase else changed(before, _boxed(box, found), True)
        edits = changed(cleared, found, erase)
        if not erase:
            self._begun = replace(asked, before=before, after=dict(edits))
        return edits


def _boxed(box: tuple[float, float, float, float], found: Mask) -> Mask:
    """The pixels whose centres are in a box."""
    rows, columns = np.ogrid[: found.shape[0], : found.shape[1]]
    left, top, right, low = box
    return (columns + 0.5 > left) & (columns + 0.5 < right) & (rows + 0.5 > top) & (rows + 0.5 < low)


def prompt_of(stroke: Stroke) -> Prompt:
    """The prompt of a stroke: one point, or two corners of a box in any order."""
    low, high = stroke.points.min(0).tolist(), stroke.points.max(0).tolist()
    if len(stroke.points) == 1:
        return Prompt(inside=((low[0], low[1]),))
    return Prompt(box=(low[0], low[1], high[0], high[1]))
