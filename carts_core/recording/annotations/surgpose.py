"""Keypoints of SurgPose: `keypoints_left.yaml`, a table of numbered points for every frame."""

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from ...errors import SequenceError
from ...files.reading import VALUES, parse_yaml, read_text
from ...model.camera import HALF_PIXEL
from .found import MOST_IMAGES, MOST_KEYPOINTS, ForeignImage


def is_surgpose(path: Path) -> bool:
    """Whether a file can be one: it ends with .yaml."""
    return path.suffix.lower() in (".yaml", ".yml")


def read_surgpose(path: Path, remarks: Counter[str]) -> Iterator[ForeignImage]:
    """The frames of a file of keypoints; nothing is remarked about them.

    Raises:
        SequenceError: it is none.
    """
    del remarks
    try:
        content = parse_yaml(read_text(path, VALUES))
        if not isinstance(content, dict) or len(content) > MOST_IMAGES:
            raise ValueError("it is no table of frames")
        frames = {int(frame): dict(points or {}) for frame, points in content.items()}
        found = [(frame, _points(points)) for frame, points in sorted(frames.items())]
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise SequenceError(
            f"{path} has no keypoints as SurgPose writes them ({error}): {{frame: {{1: [x, y], ...}}}}."
        ) from error
    for frame, points in found:
        yield ForeignImage(f"{path.name} {frame}", keypoints=points, frame=str(frame), camera="")


def _points(points: dict) -> dict[str, tuple[float, float]]:
    if len(points) > MOST_KEYPOINTS:
        raise ValueError(f"a frame has {len(points)} keypoints; {MOST_KEYPOINTS} are allowed")
    found = {}
    for name, place in points.items():
        if place is not None:
            u, v = (float(value) + HALF_PIXEL for value in place)
            if not (math.isfinite(u) and math.isfinite(v)):
                raise ValueError(f"keypoint {name} is at {place}")
            found[str(name)] = (u, v)
    return found
