"""Meshes of links as they are rendered, and paths and units of their files."""

import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
from jaxtyping import Float, Int

from ..files.reading import MESH, is_regular, open_regular
from ..reprs import short_repr

CLUSTERING_RATIO = 10
"""Ratio of triangles to the requested number above which meshes are first clustered [1]."""

OPAQUE = 0.99
"""Minimum alpha of rendered visuals [1]."""

_HEAD = 2**16
"""Number of bytes at the start of a COLLADA file that are searched for its unit and up axis."""
_UNIT = re.compile(rb"<unit\b[^>]*?\bmeter\s*=\s*[\"']\s*([0-9.eE+-]+)\s*[\"']")
_UP_AXIS = re.compile(rb"<up_axis>\s*([XYZ]_UP)\s*</up_axis>")

_PACKAGE_LEVELS = 6
"""Number of parent folders of the URDF that are searched for a ROS package."""


@dataclass(frozen=True)
class LinkMesh:
    """Part of a link with a single colour, in the frame of its link [m]."""

    link: int
    """Index into `Robot.link_names`."""
    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    """Unit vertex normals; vertices are split at sharp edges."""
    faces: Int[np.ndarray, "F 3"]
    color: Float[np.ndarray, "3"]
    """Linear RGB in [0, 1]."""
    closed: bool
    """Whether the mesh encloses a volume, so that the backs of triangles are never visible."""

    __repr__ = short_repr


@dataclass(frozen=True)
class Decimation:
    """Summary of the decimation of a robot's meshes."""

    before: int
    """Number of triangles in the files."""
    after: int
    """Number of rendered triangles."""
    deviation: float
    """Maximum surface deviation of a part [m]."""

    def __str__(self) -> str:
        if self.deviation == 0.0:
            return f"{self.after} triangles, as in the files"
        return (
            f"{self.after} of {self.before} triangles are kept; the surface moves by at most "
            f"{self.deviation * 1e3:.2f} mm"
        )


def mesh_path(urdf_folder: Path, name: str) -> Path:
    """Path of the file of a `<mesh filename=...>`, which need not exist.

    `package://NAME/REST` is resolved as in ROS packages: `REST` in a folder `NAME` that is the folder of the URDF or
    one of its parents (`NAME/urdf` beside `NAME/meshes`), or lies in one of these. Without such a file, it is `REST` in
    the folder of the URDF or one of its parents, whatever its name. `file://` and plain paths are used directly,
    relative to the folder of the URDF.
    """
    scheme, mark, rest = name.partition("://")
    if not mark:
        return urdf_folder / name
    if scheme == "package":
        package, _, inside = rest.partition("/")
        folder = urdf_folder.resolve()
        parents = (folder, *folder.parents[:_PACKAGE_LEVELS])
        named = [each for parent in parents for each in _in_package(parent, package)]
        any_name = [each for parent in parents for each in (parent, parent / package)]
        found = (each / inside for each in (*named, *any_name) if is_regular(each / inside))
        return next(found, folder / inside)
    return urdf_folder / (unquote(urlsplit(name).path) if scheme == "file" else rest)


def _in_package(parent: Path, package: str) -> list[Path]:
    """Folders of a package, given a parent folder of the URDF."""
    return [parent / package, *([parent] if parent.name == package else [])]


def collada_asset(path: Path) -> tuple[float, str]:
    """Unit [m] and up axis ("X_UP", "Y_UP", "Z_UP") of a COLLADA file; 1 and "" for other files and missing values."""
    if path.suffix.lower() != ".dae" or not is_regular(path):
        return 1.0, ""
    with open_regular(path, MESH) as file:
        # The first asset is that of the document.
        head = file.read(_HEAD)
    unit, axis = _UNIT.search(head), _UP_AXIS.search(head)
    metres = float(unit[1]) if unit is not None else 1.0
    return metres if 0 < metres < np.inf else 1.0, "" if axis is None else axis[1].decode()
