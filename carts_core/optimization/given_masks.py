"""Masks that are not part of a recording, as targets of fits."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from ..recording import Frame

GivenMask = Bool[np.ndarray, "h w"] | Float[np.ndarray, "h w"]
"""Coverage of each pixel by all arms, in [0, 1]."""


@dataclass(frozen=True, eq=False)
class GivenMasks:
    """Masks that are not part of the recording, by frame."""

    origin: str
    """Name of such a mask in messages, such as "imported mask"."""
    masks: Callable[[int], Mapping[str, GivenMask]]
    """Frame index -> camera name -> mask at the camera's size, for the cameras with a mask."""
    available: Callable[[int, str], bool]
    """(frame index, camera name) -> whether a mask is available."""
    ignored: Callable[[int], Mapping[str, Bool[np.ndarray, "h w"]]] = lambda _: {}
    """Frame index -> camera name -> unlabelled pixels, which are not compared."""

    def filled(self, frame: Frame) -> Frame:
        """Copy of the frame with these masks for those of its cameras without recorded masks."""
        recorded = frame.masks or {}
        masks = {**self.masks(frame.index), **recorded}
        whole = {name: np.asarray(mask) >= 0.5 for name, mask in masks.items() if name in frame.images}
        unlabelled = {name: pixels for name, pixels in self.ignored(frame.index).items() if name not in recorded}
        return replace(frame, masks=whole or None, unlabelled=unlabelled)
