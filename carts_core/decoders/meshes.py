"""Triangle meshes, read with trimesh."""

import io
import os
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int
from trimesh.resolvers import FilePathResolver

from ..errors import RobotError
from ..files.reading import IMAGE, MESH, is_regular, read_bytes, size_problem

MAX_FACES = 1_000_000
"""Maximum number of triangles in a mesh file, before simplification."""
MAX_PARTS = 1_000
"""Maximum number of mesh instances in a file."""
_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


class _BesideTheMesh(FilePathResolver):
    """Resolver of a mesh's materials and textures: regular files of limited size in its folder or below."""

    def get(self, name: str) -> bytes:
        """Content of a file.

        Raises:
            OSError, ValueError: the file is missing, outside of the folder or too large, or an image cannot be decoded.
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


def mesh_parts(
    path: Path, kind: str
) -> list[tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"], Float[np.ndarray, "3"] | None]]:
    """Vertices, triangles, and colour (or None) of each mesh in a file.

    Args:
        path: path of the mesh file.
        kind: file type in trimesh, such as "stl".

    Raises:
        OSError: the file cannot be read.
        RobotError: the file has too many triangles or parts.
        Exception: the file is damaged; the class depends on the reader.
    """
    content = read_bytes(path, MESH)
    # A binary STL has a header of 84 bytes and 50 bytes per triangle.
    if kind == "stl" and len(content) > 84 + 50 * MAX_FACES and not content.startswith(b"solid"):
        raise RobotError(f"mesh {path} has more than {MAX_FACES:,} triangles. Export a simpler mesh.")
    loaded = trimesh.load_scene(io.BytesIO(content), file_type=kind, resolver=_BesideTheMesh(str(path)))
    if sum(len(getattr(part, "faces", ())) for part in loaded.geometry.values()) > MAX_FACES:
        raise RobotError(f"mesh {path} has more than {MAX_FACES:,} triangles. Export a simpler mesh.")
    if len(loaded.graph.nodes_geometry) > MAX_PARTS:
        raise RobotError(f"mesh {path} has more than {MAX_PARTS:,} parts. Export it as one mesh.")
    meshes = [part for part in loaded.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if sum(len(mesh.faces) for mesh in meshes) > MAX_FACES:
        raise RobotError(f"mesh {path} has more than {MAX_FACES:,} triangles. Export a simpler mesh.")
    return [(np.asarray(mesh.vertices), np.asarray(mesh.faces), mesh_color(mesh)) for mesh in meshes]


def mesh_color(mesh: trimesh.Trimesh) -> Float[np.ndarray, "3"] | None:
    """Main colour of a mesh's material, RGB in [0, 1], or None."""
    visual = mesh.visual
    material = getattr(visual, "material", None)
    rgba = getattr(material, "main_color", None) if material is not None else getattr(visual, "main_color", None)
    return None if rgba is None else np.asarray(rgba, dtype=float)[:3] / 255.0
