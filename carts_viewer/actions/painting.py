"""Painting on masks and ignore regions, by strokes or by prompts to the segmenter."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import UInt8

from carts_core.errors import CartsError
from carts_core.model.parts import part_classes
from carts_core.project import Edits, Key, Kind, ProjectState
from carts_core.segmentation import Prompt, Segmenter
from carts_viewer.actions import intents
from carts_viewer.actions.context import Context, Handler, clamped
from carts_viewer.picture.layers import Layer
from carts_viewer.picture.strokes import DIAMETERS, Mask, Stroke, Target, Tool, corrected, ignored, relabelled

_STEPS = {
    (Target.MASK, False): "Add to the mask",
    (Target.MASK, True): "Remove from the mask",
    (Target.IGNORE, False): "Ignore pixels",
    (Target.IGNORE, True): "Ignore fewer pixels",
}
_CLEARED = {Target.MASK: "Clear the mask correction", Target.IGNORE: "Clear the ignore region"}


class PaintingHandler(Handler):
    """Handler of painting tools, strokes and prompts."""

    def __init__(self, context: Context, segmenter: Callable[[], Segmenter]) -> None:
        super().__init__(context)
        self._prompting = Prompting(segmenter)

    def _on_NextObject(self, intent: intents.NextObject) -> None:
        self._prompting.finish()

    def _on_SetTool(self, intent: intents.SetTool) -> None:
        self._prompting.finish()
        self._set_brush(tool=intent.tool)

    def _on_ToggleTool(self, intent: intents.ToggleTool) -> None:
        self._set_brush(tool=Tool.OFF if self._context.state.brush.tool is intent.tool else intent.tool)

    def _on_SetTarget(self, intent: intents.SetTarget) -> None:
        other = Target.IGNORE if self._context.state.brush.target is Target.MASK else Target.MASK
        self._set_brush(target=intent.target or other)

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
        painted = {**self._context.state.brush.painted, intent.client_id: stroke.number}
        try:
            self._change(self._step(stroke), self._edits(stroke))
        finally:
            self._set_brush(painted=painted)

    def _on_ClearLayer(self, intent: intents.ClearLayer) -> None:
        state = self._context.state
        target = intent.target or state.brush.target
        painted = (Key.mask_correction, Key.part_labels) if target is Target.MASK else (Key.ignore_region,)
        self._change(_CLEARED[target], {make(state.index, state.camera): None for make in painted})

    def _edits(self, stroke: Stroke) -> Edits:
        """Edits of a stroke or a prompt to the ignore region, or to the mask and the part labels."""
        project, place = self._session.editor.view, (stroke.frame, stroke.camera)
        mask, labels, region = Key.mask_correction(*place), Key.part_labels(*place), Key.ignore_region(*place)

        def changed(layers: Mapping[Key[Any], Any], covered: Mask, erase: bool) -> Edits:
            if stroke.target is Target.IGNORE:
                return {region: ignored(layers[region], covered, erase=erase)}
            return {
                mask: corrected(layers[mask], covered, self._rendered(stroke), erase=erase),
                labels: relabelled(layers[labels], covered, stroke.label, erase=erase),
            }

        keys: tuple[Key[Any], ...] = (region,) if stroke.target is Target.IGNORE else (mask, labels)
        if stroke.prompt:
            return self._prompting.edits(stroke, self._image(stroke), project, keys, changed)
        covered = stroke.covers(self._session.scene.camera(stroke.camera))
        return changed({key: project.get(key) for key in keys}, covered, stroke.erase)

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


Layers = Mapping[Key[Any], Any]


@dataclass(frozen=True)
class _PromptedObject:
    """A segmented object that further clicks refine."""

    place: tuple[int, str, Target, int]
    """Frame, camera, target and class."""
    prompt: Prompt
    before: Layers
    """The layers before the object was added."""
    after: Layers
    """The layers after the object was added."""


class Prompting:
    """Turns clicks and boxes into edits of painted layers.

    A click adds the object under the pointer. Further clicks refine this object by a point on it or, with `erase`, off
    it, until the layers are changed otherwise. Any other click with `erase` removes the object under the pointer. A box
    replaces the content of the layer inside the box by the segmentation.
    """

    def __init__(self, segmenter: Callable[[], Segmenter]) -> None:
        self._segmenter = segmenter
        self._begun: _PromptedObject | None = None

    def finish(self) -> None:
        """Let the next click start a new object."""
        self._begun = None

    def edits(
        self,
        stroke: Stroke,
        image: UInt8[np.ndarray, "height width 3"],
        project: ProjectState,
        keys: tuple[Key[Any], ...],
        changed: Callable[[Layers, Mask, bool], Edits],
    ) -> Edits:
        """Edits of a click or a box.

        Args:
            stroke: one point, or two corners of a box.
            image: RGB image of the stroke's frame and camera.
            project: current state of the project.
            keys: the layers that the stroke may change.
            changed: function of layers, pixels, and whether these are erased, that returns the changed layers.

        Raises:
            CartsError: segmentation failed or found nothing.
        """
        now = {key: project.get(key) for key in keys}
        place = (stroke.frame, stroke.camera, stroke.target, stroke.label)
        begun, prompt = self._begun, prompt_of(stroke)
        self._begun = None
        goes_on = begun is not None and (begun.place, begun.after) == (place, now) and prompt.box is None
        if begun is not None and goes_on:
            point = prompt.inside
            inside, outside = begun.prompt.inside, begun.prompt.outside
            prompt = Prompt(
                *((inside, outside + point) if stroke.erase else (inside + point, outside)), begun.prompt.box
            )
        before = begun.before if begun is not None and goes_on else now
        erase = stroke.erase and not goes_on
        found = self._segmenter().segment(image, prompt)
        cleared = before if prompt.box is None or erase else changed(before, _boxed(prompt.box, found), True)
        edits = changed(cleared, found, erase)
        if not erase:
            self._begun = _PromptedObject(place, prompt, before, dict(edits))
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
