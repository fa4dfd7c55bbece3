"""What a click or a box on the picture means: the mask of what is there, and clicks that go on with it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8

from carts_core.project import Edits, Key, ProjectState
from carts_core.segmentation import Prompt, Segmenter
from carts_viewer.strokes import Mask, Stroke, Target

Layers = Mapping[Key[Any], Any]


@dataclass(frozen=True)
class _Begun:
    """A thing that was pointed at, which further clicks are about."""

    place: tuple[int, str, Target, int]
    """Frame, camera, target and class."""
    prompt: Prompt
    before: Layers
    """The layers before it was there."""
    after: Layers
    """The layers with it."""


class Prompting:
    """Turns clicks and boxes into edits of painted layers.

    A click adds what is there. As long as nothing else changes these layers, further clicks are about the same thing:
    one more point on it, or with `erase` one beside it. Otherwise a click with `erase` takes away what is there. A box
    replaces: what is in it and not segmented is taken away.
    """

    def __init__(self, segmenter: Callable[[], Segmenter]) -> None:
        """
        Args:
            segmenter: loads what segments, once.
        """
        self._segmenter = segmenter
        self._begun: _Begun | None = None

    def finish(self) -> None:
        """The next click is about something else."""
        self._begun = None

    def edits(
        self,
        stroke: Stroke,
        image: UInt8[np.ndarray, "height width 3"],
        project: ProjectState,
        keys: tuple[Key[Any], ...],
        changed: Callable[[Layers, Mask, bool], Edits],
    ) -> Edits:
        """What a click or a box changes.

        Args:
            stroke: one point, or two corners of a box.
            image: of its frame and camera, RGB.
            project: as it is.
            keys: the layers that it may change.
            changed: layers, pixels and whether they are erased -> these layers afterwards.

        Raises:
            CartsError: there is nothing to segment, or it could not be done.
        """
        now = {key: project.get(key) for key in keys}
        place = (stroke.frame, stroke.camera, stroke.target, stroke.label)
        begun, prompt = self._begun, asked(stroke)
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
            self._begun = _Begun(place, prompt, before, dict(edits))
        return edits


def _boxed(box: tuple[float, float, float, float], found: Mask) -> Mask:
    """The pixels whose middles are in a box."""
    rows, columns = np.ogrid[: found.shape[0], : found.shape[1]]
    left, top, right, low = box
    return (columns + 0.5 > left) & (columns + 0.5 < right) & (rows + 0.5 > top) & (rows + 0.5 < low)


def asked(stroke: Stroke) -> Prompt:
    """The prompt that a stroke is: one point, or two corners of a box in any order."""
    low, high = stroke.points.min(0).tolist(), stroke.points.max(0).tolist()
    if len(stroke.points) == 1:
        return Prompt(inside=((low[0], low[1]),))
    return Prompt(box=(low[0], low[1], high[0], high[1]))
