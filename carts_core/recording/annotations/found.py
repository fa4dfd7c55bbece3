"""What a reader of foreign annotations gives: images as the file has them, and then frames of the sequence."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, UInt8

from ...errors import SequenceError

MOST_LABELS = 255
"""Of a layer, whose pixels have 8 bits."""
MOST_IMAGES = 100_000
"""In one source."""
MOST_KEYPOINTS = 200
"""In one image."""


@dataclass(frozen=True)
class ForeignImage:
    """One image of a source, with what is marked in it."""

    name: str
    """Its file, as the source calls it."""
    parts: Callable[[], Iterable[tuple[str, Bool[np.ndarray, "height width"]]]] = tuple
    """Labels and their pixels, decoded when asked for; later ones lie above earlier ones. One without a name says that
    nothing else is marked; an image without any has no mask."""
    keypoints: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Name -> column and row [px], from the upper left corner."""
    frame: str = ""
    """Id of the frame, where the source says it."""
    camera: str = ""
    """The same of the camera."""


@dataclass(frozen=True, eq=False)
class FrameAnnotation:
    """What is marked in one frame through one camera."""

    frame: int
    """Position in the sequence."""
    camera: str
    labels: UInt8[np.ndarray, "height width"] | None
    """Of each pixel of the undistorted image the label, counted from 1; 0 elsewhere. None without masks."""
    keypoints: Mapping[str, tuple[float, float]]
    """Name -> column and row in the undistorted image [px]."""


class Labels:
    """Names of labels, numbered as they come."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def number(self, name: str) -> int:
        """Of a label, from 1.

        Raises:
            SequenceError: there are too many.
        """
        if name not in self.names:
            if len(self.names) == MOST_LABELS:
                raise SequenceError(f"there are more than {MOST_LABELS} labels, say {name!r}. Join some of them.")
            self.names.append(name)
        return self.names.index(name) + 1


@dataclass(frozen=True, eq=False)
class Annotations:
    """All that a source marks in a sequence. The frames are decoded while they are gone through, which is done once."""

    kind: str
    """The source's format, for people."""
    frames: Iterator[FrameAnnotation]
    label_names: list[str]
    """Of label 1 and so on; complete once all frames were gone through."""
    unknown: list[str]
    """Names of images that belong to no frame; complete likewise."""
    remarks: Counter[str] = field(default_factory=Counter)
    """What was decided about masks, and annotations that were left out with the reason, and how often; complete
    likewise."""
