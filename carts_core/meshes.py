"""Link meshes as the renderer wants them: few triangles, smooth normals, one colour."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import yourdfpy
from jaxtyping import Float, Int

from .errors import RobotError
from .mesh_files import mesh_path

SHARP_EDGE = np.deg2rad(38.0)
"""Faces that meet at a larger angle [rad] do not share a smooth normal."""

_DEFAULT_COLOR = np.array([0.6, 0.6, 0.6])
_OPAQUE = 0.99


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


def is_closed(mesh: LinkMesh) -> bool:
    """Whether each part of a mesh encloses a volume, with its normals outwards.

    Copies of a vertex at sharp edges count as one.
    """
    joined = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    joined.merge_vertices(merge_norm=True, digits_vertex=7)
    if not (joined.is_watertight and joined.is_winding_consistent):
        return False
    parts = trimesh.graph.connected_component_labels(joined.face_adjacency, node_count=len(joined.faces))
    a, b, c = joined.triangles.swapaxes(0, 1)
    volumes = np.bincount(parts, weights=np.einsum("fi,fi->f", a, np.cross(b, c)))
    return bool((volumes > 0).all())


def load_visual(visual: yourdfpy.Visual, folder: Path, materials: dict) -> list[tuple[trimesh.Trimesh, np.ndarray]]:
    """Meshes of one URDF visual in its link's frame, each with its colour.

    Translucent visuals are markers for people (a ball at the remote centre, say) and are left out.

    Raises:
        RobotError: a mesh file is missing or cannot be read.
    """
    color, opacity = _urdf_color(visual, materials)
    if opacity < _OPAQUE or visual.geometry is None:
        return []
    parts: list[tuple[trimesh.Trimesh, np.ndarray]] = []
    for mesh in _geometry(visual.geometry, folder):
        if visual.origin is not None:
            mesh.apply_transform(visual.origin)
        parts.append((mesh, color if color is not None else _mesh_color(mesh)))
    return parts


def _urdf_color(visual: yourdfpy.Visual, materials: dict) -> tuple[np.ndarray | None, float]:
    material = visual.material
    if material is not None and material.color is None and material.name in materials:
        material = materials[material.name]
    if material is None or material.color is None:
        return None, 1.0
    rgba = np.asarray(material.color.rgba, dtype=float)
    return rgba[:3], float(rgba[3])


def _geometry(geometry: yourdfpy.Geometry, folder: Path) -> list[trimesh.Trimesh]:
    if geometry.box is not None:
        return [trimesh.creation.box(extents=geometry.box.size)]
    if geometry.cylinder is not None:
        return [trimesh.creation.cylinder(radius=geometry.cylinder.radius, height=geometry.cylinder.length)]
    if geometry.sphere is not None:
        return [trimesh.creation.icosphere(radius=geometry.sphere.radius)]
    if geometry.mesh is None:
        return []
    path = mesh_path(folder, geometry.mesh.filename)
    if not path.is_file():
        raise RobotError(
            f"mesh {path} is missing; the URDF in {folder} names it as {geometry.mesh.filename!r}. "
            "Put the file there, or correct the path in the URDF."
        )
    try:
        loaded = trimesh.load_scene(path)
        meshes = [part for part in loaded.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    except Exception as error:  # trimesh raises whatever its format readers raise
        allowed = "OBJ, STL, PLY, GLB and DAE files"
        raise RobotError(f"mesh {path} cannot be read ({error}). Allowed are {allowed}.") from error
    if not meshes:
        raise RobotError(f"mesh {path} holds no triangles. Export it again as a triangle mesh.")
    if geometry.mesh.scale is not None:
        scale = np.ones(3) * np.asarray(geometry.mesh.scale)
        for mesh in meshes:
            mesh.apply_transform(np.diag([*scale, 1.0]))
    return meshes


def _mesh_color(mesh: trimesh.Trimesh) -> np.ndarray:
    visual = mesh.visual
    material = getattr(visual, "material", None)
    rgba = getattr(material, "main_color", None) if material is not None else getattr(visual, "main_color", None)
    return _DEFAULT_COLOR if rgba is None else np.asarray(rgba, dtype=float)[:3] / 255.0


def face_budget(counts: Sequence[int], max_faces: int) -> list[int]:
    """Share `max_faces` among meshes: small ones keep every face, the others get the same cap."""
    cap = max_faces
    remaining, open_meshes = max_faces, len(counts)
    for count in sorted(counts):
        cap = remaining // max(open_meshes, 1)
        if count > cap:
            break
        remaining -= count
        open_meshes -= 1
    else:
        return list(counts)
    return [min(count, cap) for count in counts]


def simplify(mesh: trimesh.Trimesh, faces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [V, 3], vertex normals [V, 3] and faces [F, 3] of `mesh` with at most about `faces` triangles."""
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    mesh.merge_vertices(digits_vertex=7)
    mesh.update_faces(mesh.nondegenerate_faces())
    if len(mesh.faces) > faces:
        mesh = mesh.simplify_quadric_decimation(face_count=max(faces, 4))
        mesh.update_faces(mesh.nondegenerate_faces())
    smooth = trimesh.graph.smooth_shade(mesh, angle=SHARP_EDGE)
    normals = np.array(smooth.vertex_normals)
    return np.array(smooth.vertices), normals, np.array(smooth.faces)


def build_link_meshes(
    parts: Sequence[tuple[int, trimesh.Trimesh, np.ndarray]], max_faces: int, progress: Callable[[str], None]
) -> tuple[LinkMesh, ...]:
    """Decimate `parts` (link index, mesh, colour) to at most about `max_faces` triangles in all."""
    budgets = face_budget([len(mesh.faces) for _, mesh, _ in parts], max_faces)
    result = []
    for number, ((link, mesh, color), budget) in enumerate(zip(parts, budgets, strict=True), start=1):
        progress(f"mesh {number}/{len(parts)}: {len(mesh.faces)} -> {min(len(mesh.faces), budget)} triangles")
        vertices, normals, faces = simplify(mesh, budget)
        result.append(
            LinkMesh(link, vertices.astype(np.float32), normals.astype(np.float32), faces.astype(np.int32), color)
        )
    return tuple(result)
