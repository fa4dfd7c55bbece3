"""What a project keeps of the masks and keypoints of others, besides their pixels."""

import math
from dataclasses import dataclass

from ..errors import ProjectError
from .values import JsonValue


@dataclass(frozen=True)
class ImportedLabels(JsonValue):
    """What the numbers in imported masks mean.

    Raises:
        ProjectError: there are more than 255 names, or one is no text.
    """

    names: tuple[str, ...]
    """Of label 1 and so on."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        if len(self.names) > 255 or not all(isinstance(name, str) and len(name) <= 1000 for name in self.names):
            raise ProjectError("imported labels must be at most 255 names of at most 1000 characters.")


@dataclass(frozen=True)
class ImportedKeypoints(JsonValue):
    """Points that others marked in a frame.

    Raises:
        ProjectError: a place is not finite, or a name is no text.
    """

    points: tuple[tuple[str, float, float], ...]
    """Name, column and row in the undistorted image [px]."""

    def __post_init__(self) -> None:
        points = []
        for point in self.points:
            if len(point) != 3 or not isinstance(point[0], str):
                raise ProjectError(f"an imported keypoint is {point!r}. Give a name, a column and a row.")
            place = float(point[1]), float(point[2])
            if not all(map(math.isfinite, place)):
                raise ProjectError(f"the imported keypoint {point[0]!r} is at {place}. Give finite numbers.")
            points.append((point[0], *place))
        object.__setattr__(self, "points", tuple(points))
