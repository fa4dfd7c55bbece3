"""Training samples of the surface network: an image, where arms are expected, and where they are."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Int

from ...model.robot import Robot
from ...model.surface import COVERAGE, NORMALS, SURFACE_CHANNELS
from ...settings import ImageSettings
from .gbuffer import GBuffer
from .geometry import RobotGeometry
from .observer import Observer, look, to_uint8
from .placement import perturbed

SURFACE_UNIT = 127
"""What 1 is in a surface map of a sample."""

_LARGEST_ERROR = 3.0
"""Scale of the largest error of the given kinematics; 1 is about 3 degrees and 3 mm."""

_UNKNOWN = 0.08
"""Share of samples in which nothing is given."""


@dataclass(frozen=True)
class SurfaceSample:
    """One sample; see `carts_core.model.surface` for the maps."""

    observed: Int[np.ndarray, "h w 3"]
    """RGB uint8."""
    given: Int[np.ndarray, "h w 6"]
    """Surface map of wrong kinematics, times `SURFACE_UNIT`, int8."""
    surface: Int[np.ndarray, "h w 6"]
    """Surface map of what the image shows, times `SURFACE_UNIT`, int8."""


class SurfaceGenerator:
    """Makes samples without end; every one depends on the seed and its number only.

    Args:
        robots: the robots that arms are made of.
        settings: what the images look like.
        seed: seed of the random numbers.
    """

    def __init__(self, robots: Sequence[Robot], settings: ImageSettings, seed: int | Sequence[int]) -> None:
        self._observer = Observer(robots, settings, seed)

    def __call__(self, number: int | None = None) -> SurfaceSample:
        """The sample of a number, counted from 0; by default the next one."""
        seen, rng = self._observer(number), self._observer.rng
        size = self._observer.settings.width, self._observer.settings.height
        # Small errors are frequent, so that the network learns to be exact.
        scale = _LARGEST_ERROR * float(rng.random()) ** 1.5
        given = [
            perturbed(rng, geometry, placement, scale)
            for geometry, placement in zip(seen.variant.rendered, seen.claimed, strict=True)
        ]
        wrong = _surface(seen.variant.rendered, look(seen.variant.rendered, given, seen.intrinsics, *size), size)
        if rng.random() < _UNKNOWN:
            wrong = np.zeros_like(wrong)
        return SurfaceSample(to_uint8(seen.image), wrong, _surface(seen.variant.geometries, seen.fine, size))


def _surface(geometries: Sequence[RobotGeometry], view: GBuffer, size: tuple[int, int]) -> np.ndarray:
    """Surface map of arms seen at the given size or a finer one, as int8."""
    values = np.zeros((len(view.rows), SURFACE_CHANNELS), np.float32)
    for index, geometry in enumerate(geometries):
        mine = np.flatnonzero(view.arm == index)
        values[mine, COVERAGE.start + geometry.part_class[view.part[mine]]] = 1.0
    values[:, NORMALS] = view.normals
    return np.rint(cv2.resize(view.image(values), size, interpolation=cv2.INTER_AREA) * SURFACE_UNIT).astype(np.int8)
