"""Where the mesh that a URDF names lies, beside the URDF or inside a ROS package, and what is read of it."""

import re
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
import trimesh

from ..decoders.meshes import mesh_parts
from ..errors import RobotError
from ..files.decoding import Limits, called
from ..files.reading import MESH, is_regular, open_regular
from ..wording import shown

FORMATS = ("obj", "stl", "ply", "glb", "gltf", "dae")
FARTHEST = 100.0
"""Largest coordinate of a mesh after scaling [m]; instruments and robots are far smaller."""
_HEAD = 2**16
"""Bytes of a COLLADA file in which its unit and up axis are looked for."""
_UNIT = re.compile(rb"<unit\b[^>]*?\bmeter\s*=\s*[\"']\s*([0-9.eE+-]+)\s*[\"']")
_UP_AXIS = re.compile(rb"<up_axis>\s*([XYZ]_UP)\s*</up_axis>")

_PACKAGE_LEVELS = 6
"""How many folders above the URDF's own a ROS package is looked for in."""


def mesh_path(urdf_folder: Path, name: str) -> Path:
    """The file that a `<mesh filename=...>` means; it need not exist.

    `package://NAME/REST` is looked for as ROS lays packages out: `REST` inside the folder of the URDF or one above it
    (`NAME/urdf` beside `NAME/meshes`), or inside a folder `NAME` in one of these. `file://` and plain paths are taken
    as they are; relative ones belong to the URDF's folder.

    Args:
        urdf_folder: folder of the URDF, absolute.
        name: as the URDF has it.
    """
    scheme, mark, rest = name.partition("://")
    if not mark:
        return urdf_folder / name
    if scheme == "package":
        package, _, inside = rest.partition("/")
        folder = urdf_folder.resolve()
        for parent in (folder, *folder.parents[:_PACKAGE_LEVELS]):
            for candidate in (parent / inside, parent / package / inside):
                if is_regular(candidate):
                    return candidate
        return folder / inside
    return urdf_folder / (unquote(urlsplit(name).path) if scheme == "file" else rest)


def collada_asset(path: Path) -> tuple[float, str]:
    """Unit [m] and up axis ("X_UP", "Y_UP", "Z_UP") of a COLLADA file; 1 and "" of other files and where not stated."""
    if path.suffix.lower() != ".dae" or not is_regular(path):
        return 1.0, ""
    with open_regular(path, MESH) as file:
        # The document's own asset comes first.
        head = file.read(_HEAD)
    unit, axis = _UNIT.search(head), _UP_AXIS.search(head)
    metres = float(unit[1]) if unit is not None else 1.0
    return metres if 0 < metres < np.inf else 1.0, "" if axis is None else axis[1].decode()


def read_mesh(path: Path, scale: np.ndarray, named: str) -> list[tuple[trimesh.Trimesh, np.ndarray | None]]:
    """The triangle meshes of a file with their colours; those of COLLADA files scaled by their unit.

    The up axis of COLLADA files is not applied, as in RViz: a URDF's <origin> is for coordinates as they are stored.

    Args:
        path: the file.
        scale: factors of x, y and z.
        named: what names the file, for errors.

    Raises:
        RobotError: it is missing, cannot be read, has no or too many triangles, or is not finite or huge.
    """
    allowed = f"Allowed are {', '.join(FORMATS).upper()} files."
    if not is_regular(path):
        raise RobotError(f"mesh {path} is missing; {named}. Put the file there, or correct the path in the URDF.")
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise RobotError(f"mesh {path} is of an unknown kind, {shown(path.suffix)}. {allowed}")
    limits = Limits.of(path.parent if kind == "gltf" else path)  # glTF keeps its numbers in a file beside it.
    try:
        parts = called(mesh_parts, path, kind, limits=limits)
    except RobotError:
        raise
    except (OSError, ValueError) as error:
        raise RobotError(f"mesh {path} cannot be read ({error}). {allowed}") from error
    scale = scale * collada_asset(path)[0]
    if not parts:
        raise RobotError(f"mesh {path} holds no triangles. Export it again as a triangle mesh.")
    meshes = []
    for vertices, faces, color in parts:
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        check_mesh(mesh, f"mesh {path}", FARTHEST / min(np.abs(scale)))
        if (scale != 1.0).any():
            mesh.apply_transform(np.diag([*scale, 1.0]))
            check_mesh(mesh, f"mesh {path}, scaled,")
        meshes.append((mesh, color))
    return meshes


def check_mesh(mesh: trimesh.Trimesh, name: str, farthest: float = FARTHEST) -> None:
    """Check that a mesh can be worked on.

    Args:
        mesh: of triangles.
        name: how errors call it.
        farthest: largest coordinate.

    Raises:
        RobotError: a coordinate is not finite or too large, or a triangle names a vertex that is not there.
    """
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise RobotError(f"{name} is not one of triangles in space. Export it again.")
    if not np.isfinite(vertices).all() or np.abs(vertices).max(initial=0.0) > farthest:
        raise RobotError(
            f"{name} has coordinates beyond {FARTHEST:g} m, or not finite. Give it in metres, or scale it in the URDF."
        )
    if faces.min(initial=0) < 0 or faces.max(initial=0) >= len(vertices):
        raise RobotError(f"{name} has triangles of vertices that it does not have. Export it again.")
