"""Link meshes as the renderer wants them: few triangles, smooth normals, one colour."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import yourdfpy
from jaxtyping import Float, Int

from ..errors import RobotError
from ..wording import shown
from .decimation import DecimationError, decimated
from .mesh_files import MOST_FACES, check_mesh, mesh_path, read_mesh

SHARP_EDGE = np.deg2rad(38.0)
"""Faces that meet at a larger angle [rad] do not share a smooth normal."""

_DEFAULT_COLOR = np.array([0.6, 0.6, 0.6])
_OPAQUE = 0.99
_MOST_KEPT = 10
"""Times as many triangles as asked for are too many."""


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
            check_mesh(mesh, "a mesh at its <origin>")
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
    scale = np.ones(3) if geometry.mesh.scale is None else np.ones(3) * np.asarray(geometry.mesh.scale)
    named = f"the URDF in {folder} names it as {shown(geometry.mesh.filename)}"
    return read_mesh(mesh_path(folder, geometry.mesh.filename), scale, named)


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
    """Vertices [V, 3], vertex normals [V, 3] and faces [F, 3] of `mesh` with at most about `faces` triangles.

    Raises:
        DecimationError: the mesh is degenerate, or so irregular that it takes too long.
    """
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    mesh.merge_vertices(digits_vertex=7)
    mesh.update_faces(mesh.nondegenerate_faces())
    if len(mesh.faces) > faces:
        mesh = trimesh.Trimesh(*decimated(np.array(mesh.vertices), np.array(mesh.faces), max(faces, 4)))
        mesh.update_faces(mesh.nondegenerate_faces())
    if not len(mesh.faces):
        raise DecimationError("all its triangles are without area")
    smooth = trimesh.graph.smooth_shade(mesh, angle=SHARP_EDGE)
    normals = np.array(smooth.vertex_normals)
    if not np.isfinite(normals).all():
        raise DecimationError("its normals are not finite")
    return np.array(smooth.vertices), normals, np.array(smooth.faces)


def build_link_meshes(
    parts: Sequence[tuple[int, trimesh.Trimesh, np.ndarray]], max_faces: int, progress: Callable[[str], None]
) -> tuple[LinkMesh, ...]:
    """Decimate `parts` (link index, mesh, colour) to at most about `max_faces` triangles in all.

    Raises:
        RobotError: a mesh is degenerate, or so irregular that it takes too long or keeps too many triangles.
    """
    if sum(len(mesh.faces) for _, mesh, _ in parts) > MOST_FACES:
        raise RobotError(f"the meshes have more than {MOST_FACES:,} triangles together. Export simpler ones.")
    budgets = face_budget([len(mesh.faces) for _, mesh, _ in parts], max_faces)
    result = []
    for number, ((link, mesh, color), budget) in enumerate(zip(parts, budgets, strict=True), start=1):
        progress(f"mesh {number}/{len(parts)}: {len(mesh.faces)} -> {min(len(mesh.faces), budget)} triangles")
        try:
            vertices, normals, faces = simplify(mesh, budget)
        except DecimationError as error:
            raise RobotError(
                f"mesh {number} of {len(parts)}, with {len(mesh.faces)} triangles, is not usable: {error}. "
                "Export it again as a clean triangle mesh."
            ) from error
        result.append(
            LinkMesh(link, vertices.astype(np.float32), normals.astype(np.float32), faces.astype(np.int32), color)
        )
    if sum(len(mesh.faces) for mesh in result) > _MOST_KEPT * max_faces:
        raise RobotError(
            f"the meshes cannot be simplified to about {max_faces} triangles. Export them as clean triangle meshes."
        )
    return tuple(result)
