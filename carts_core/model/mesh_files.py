"""Where the mesh that a URDF names lies, beside the URDF or inside a ROS package, and what is read of it."""

import io
import os
import re
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver

from ..errors import RobotError
from ..files.image_size import size_problem
from ..files.reading import IMAGE, MESH, is_regular, open_regular, read_bytes
from ..wording import shown

FORMATS = ("obj", "stl", "ply", "glb", "gltf", "dae")
MOST_FACES = 1_000_000
"""Triangles of one mesh file before it is simplified."""
MOST_PARTS = 1_000
"""Instances of meshes in one file."""
FARTHEST = 100.0
"""Largest coordinate of a mesh after scaling [m]; instruments and robots are far smaller."""
_HEAD = 2**16
"""Bytes of a COLLADA file in which its unit and up axis are looked for."""
_UNIT = re.compile(rb"<unit\b[^>]*?\bmeter\s*=\s*[\"']\s*([0-9.eE+-]+)\s*[\"']")
_UP_AXIS = re.compile(rb"<up_axis>\s*([XYZ]_UP)\s*</up_axis>")
_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")

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


class _BesideTheMesh(FilePathResolver):
    """Materials and textures that a mesh names: regular files below its folder, of a bounded size."""

    def get(self, name: str) -> bytes:
        """The content of a file.

        Raises:
            OSError, ValueError: it is missing, outside the folder, or not one that is read.
        """
        for candidate in (name.strip(), name.strip().lstrip("/"), os.path.split(name)[-1]):
            path = Path(self.absolute(candidate))
            if is_regular(path):
                image = path.suffix.lower() in _IMAGES
                content = read_bytes(path, IMAGE if image else MESH)
                if image and (problem := size_problem(content)) is not None:
                    raise ValueError(f"{path} {problem}")
                return content
        raise FileNotFoundError(name)


def read_mesh(path: Path, scale: np.ndarray, named: str) -> list[trimesh.Trimesh]:
    """The triangle meshes of a file, those of COLLADA files scaled by their unit.

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
    try:
        content = io.BytesIO(read_bytes(path, MESH))
        loaded = trimesh.load_scene(content, file_type=kind, resolver=_BesideTheMesh(str(path)))
        if sum(len(getattr(part, "faces", ())) for part in loaded.geometry.values()) > MOST_FACES:
            raise RobotError(f"mesh {path} has more than {MOST_FACES:,} triangles. Export a simpler one.")
        if len(loaded.graph.nodes_geometry) > MOST_PARTS:
            raise RobotError(f"mesh {path} has more than {MOST_PARTS:,} parts. Export it as one mesh.")
        meshes = [part for part in loaded.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    except RobotError:
        raise
    except Exception as error:  # trimesh raises whatever its format readers raise
        raise RobotError(f"mesh {path} cannot be read ({error}). {allowed}") from error
    scale = scale * collada_asset(path)[0]
    if not meshes:
        raise RobotError(f"mesh {path} holds no triangles. Export it again as a triangle mesh.")
    for mesh in meshes:
        check_mesh(mesh, f"mesh {path}", FARTHEST / min(np.abs(scale)))
        if (scale != 1.0).any():
            mesh.apply_transform(np.diag([*scale, 1.0]))
            check_mesh(mesh, f"mesh {path}, scaled,")
    if sum(len(mesh.faces) for mesh in meshes) > MOST_FACES:
        raise RobotError(f"mesh {path} has more than {MOST_FACES:,} triangles. Export a simpler one.")
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
