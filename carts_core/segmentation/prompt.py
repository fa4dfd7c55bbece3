"""What a segmenter is asked, and what it is: places in an image in, the mask of what is there out."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, UInt8

from ..errors import SettingsError

MOST_POINTS = 100
"""Of one prompt."""


@dataclass(frozen=True)
class Prompt:
    """Where something is in an image: points on it, points beside it, a box around it.

    Raises:
        SettingsError: neither a point on it nor a box, too many points, a place that is not finite, or an empty box.
    """

    inside: tuple[tuple[float, float], ...] = ()
    """Points on it: column and row, pixel centres at 0.5 [px]."""
    outside: tuple[tuple[float, float], ...] = ()
    """Points beside it [px]."""
    box: tuple[float, float, float, float] | None = None
    """Left, top, right and lower end of a box that it is in [px]."""

    def __post_init__(self) -> None:
        if not self.inside and self.box is None:
            raise SettingsError("a prompt needs a point on the thing, or a box around it.")
        if len(self.inside) + len(self.outside) > MOST_POINTS:
            raise SettingsError(f"a prompt has at most {MOST_POINTS} points. Begin another one.")
        numbers = [value for place in (*self.inside, *self.outside, self.box or ()) for value in place]
        if not np.isfinite(numbers).all():
            raise SettingsError("a place of a prompt is not finite.")
        if self.box is not None and not (self.box[0] < self.box[2] and self.box[1] < self.box[3]):
            raise SettingsError(f"the box {self.box} is empty. Give left, top, right and lower end.")


class Segmenter(Protocol):
    """Segments what a prompt points at; a plug-in may be anything that has this method."""

    def segment(self, image: UInt8[np.ndarray, "height width 3"], prompt: Prompt) -> Bool[np.ndarray, "height width"]:
        """The mask of what is there.

        Args:
            image: RGB.
            prompt: places in it.

        Raises:
            CartsError: it could not be done.
        """
        ...
