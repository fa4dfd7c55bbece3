"""Link meshes as the renderer wants them: few triangles, smooth normals, one colour."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

SLENDER = 0.1
"""Largest width of a shaft, in lengths [1]."""


@dataclass(frozen=True)
class LinkMesh:
    """One part of a link, of one colour, in the frame of its link [m]."""

    link: int
    """Index into `Robot.link_names`."""
    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    """Unit vertex normals; vertices are split at sharp edges."""
    faces: Int[np.ndarray, "F 3"]
    color: Float[np.ndarray, "3"]
    """Linear RGB in [0, 1]."""
    closed: bool
    """Whether each part of it encloses a volume, with its normals outwards."""


@dataclass(frozen=True)
class Decimation:
    """What became of a robot's meshes."""

    before: int
    """Triangles of the files."""
    after: int
    """Triangles that are rendered."""
    deviation: float
    """How far the surface of a part moved at most [m]."""

    def __str__(self) -> str:
        if self.deviation == 0.0:
            return f"{self.after} triangles, as in the files"
        return (
            f"{self.after} of {self.before} triangles are kept, which moves no surface by more than "
            f"{self.deviation * 1e3:.2f} mm"
        )
