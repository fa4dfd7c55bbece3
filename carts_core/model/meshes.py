"""Conversion of the mesh files of a URDF to few triangles, smooth normals and one colour."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import trimesh
import yourdfpy
from jaxtyping import Float, Int

from ..decoders.meshes import MAX_FACES, mesh_color, mesh_parts
from ..errors import RobotError
from ..files.decoding import Limits, called
from ..files.reading import is_regular
from ..wording import shown
from .decimation import DecimationError, decimated
from .link_mesh import CLUSTERING_RATIO, OPAQUE, Decimation, LinkMesh, collada_asset, mesh_path

FORMATS = ("obj", "stl", "ply", "glb", "gltf", "dae")
FARTHEST = 100.0
"""Maximum coordinate of a mesh after scaling [m]; instruments and robots are far smaller."""


def read_mesh(path: Path, scale: np.ndarray, named: str) -> list[tuple[trimesh.Trimesh, np.ndarray | None]]:
    """Read the triangle meshes of a file with their colours; COLLADA meshes are scaled by their unit.

    The up axis of COLLADA files is not applied, as in RViz, since the <origin> of a URDF refers to the stored
    coordinates.

    Raises:
        RobotError: the file is missing or cannot be read, it has no triangles or too many, or coordinates are not
            finite or too large.
    """
    allowed = f"Allowed: {', '.join(FORMATS).upper()} files."
    if not is_regular(path):
        raise RobotError(f"mesh {path} is missing; {named}. Add the file, or correct the path in the URDF.")
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise RobotError(f"mesh {path} has an unknown format, {shown(path.suffix)}. {allowed}")
    limits = Limits.of(path.parent if kind == "gltf" else path)  # glTF stores arrays in a separate file.
    try:
        parts = called(mesh_parts, path, kind, limits=limits)
    except RobotError:
        raise
    except (OSError, ValueError) as error:
        raise RobotError(f"mesh {path} cannot be read ({error}). {allowed}") from error
    scale = scale * collada_asset(path)[0]
    if not parts:
        raise RobotError(f"mesh {path} has no triangles. Export it again as a triangle mesh.")
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
    """Check the coordinates and indices of a mesh.

    Args:
        farthest: maximum allowed coordinate.

    Raises:
        RobotError: a coordinate is not finite or too large, or a triangle refers to a missing vertex.
    """
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise RobotError(f"{name} is not a 3D triangle mesh. Export it again.")
    if not np.isfinite(vertices).all() or np.abs(vertices).max(initial=0.0) > farthest:
        raise RobotError(
            f"{name} has coordinates that are not finite or exceed {FARTHEST:g} m. Give it in metres, or scale it in "
            "the URDF."
        )
    if faces.min(initial=0) < 0 or faces.max(initial=0) >= len(vertices):
        raise RobotError(f"{name} has triangles with invalid vertex indices. Export it again.")


SHARP_EDGE = np.deg2rad(38.0)
"""Maximum angle between faces that share a smooth normal [rad]."""

_DEFAULT_COLOR = np.array([0.6, 0.6, 0.6])
_AT_ONCE = 4
"""Maximum number of meshes that are decimated concurrently; each may take much memory."""
_CLUSTERED = CLUSTERING_RATIO / 2
"""Maximum ratio of triangles to the requested number after clustering [1]."""
_FIRST_CELL = 0.25
"""Cell size of the first clustering, relative to the tolerance [1]."""


def is_closed(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> bool:
    """Whether each part of a mesh encloses a volume, with outward normals.

    Copies of a vertex at sharp edges count as one vertex.
    """
    joined = trimesh.Trimesh(vertices, faces, process=False)
    joined.merge_vertices(merge_norm=True, digits_vertex=7)
    if not (joined.is_watertight and joined.is_winding_consistent):
        return False
    parts = trimesh.graph.connected_component_labels(joined.face_adjacency, node_count=len(joined.faces))
    a, b, c = joined.triangles.swapaxes(0, 1)
    volumes = np.bincount(parts, weights=np.einsum("fi,fi->f", a, np.cross(b, c)))
    return bool((volumes > 0).all())


def load_visual(visual: yourdfpy.Visual, folder: Path, materials: dict) -> list[tuple[trimesh.Trimesh, np.ndarray]]:
    """Load the meshes of a URDF visual in the frame of its link, with their colours.

    Translucent visuals are markers (such as a ball at the remote centre) and are omitted.

    Raises:
        RobotError: a mesh file is missing or cannot be read.
    """
    color, opacity = _urdf_color(visual, materials)
    if opacity < OPAQUE or visual.geometry is None:
        return []
    parts: list[tuple[trimesh.Trimesh, np.ndarray]] = []
    for mesh, own in _geometry(visual.geometry, folder):
        if visual.origin is not None:
            mesh.apply_transform(visual.origin)
            check_mesh(mesh, "a mesh at its <origin>")
        chosen = next((each for each in (color, own) if each is not None), _DEFAULT_COLOR)
        parts.append((mesh, chosen))
    return parts


def _urdf_color(visual: yourdfpy.Visual, materials: dict) -> tuple[np.ndarray | None, float]:
    material = visual.material
    if material is not None and material.color is None and material.name in materials:
        material = materials[material.name]
    if material is None or material.color is None:
        return None, 1.0
    rgba = np.asarray(material.color.rgba, dtype=float)
    return rgba[:3], float(rgba[3])


def _geometry(geometry: yourdfpy.Geometry, folder: Path) -> list[tuple[trimesh.Trimesh, np.ndarray | None]]:
    """Meshes of a URDF geometry, with their colours."""
    shape = None
    if geometry.box is not None:
        shape = trimesh.creation.box(extents=geometry.box.size)
    elif geometry.cylinder is not None:
        shape = trimesh.creation.cylinder(radius=geometry.cylinder.radius, height=geometry.cylinder.length)
    elif geometry.sphere is not None:
        shape = trimesh.creation.icosphere(radius=geometry.sphere.radius)
    if shape is not None:
        return [(shape, mesh_color(shape))]
    if geometry.mesh is None:
        return []
    scale = np.ones(3) if geometry.mesh.scale is None else np.ones(3) * np.asarray(geometry.mesh.scale)
    named = f"the URDF in {folder} refers to it as {shown(geometry.mesh.filename)}"
    return read_mesh(mesh_path(folder, geometry.mesh.filename), scale, named)


def simplify(
    mesh: trimesh.Trimesh, tolerance: float | None
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"], float]:
    """Vertices, vertex normals and faces of a mesh, decimated if a tolerance is given, and maximum surface deviation
    [m].

    Args:
        mesh: mesh in metres.
        tolerance: maximum deviation of its surface [m]; None for no decimation.

    Raises:
        DecimationError: the mesh is degenerate, or so irregular that decimation takes too long.
    """
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    mesh.merge_vertices(digits_vertex=7)
    mesh.update_faces(mesh.nondegenerate_faces())
    deviation = 0.0
    if tolerance is not None and len(mesh.faces):
        vertices, faces, deviation = decimated(np.array(mesh.vertices), np.array(mesh.faces), tolerance)
        mesh = trimesh.Trimesh(vertices, faces)
        mesh.update_faces(mesh.nondegenerate_faces())
    if not len(mesh.faces):
        raise DecimationError("all its triangles have zero area")
    smooth = trimesh.graph.smooth_shade(mesh, angle=SHARP_EDGE)
    normals = np.array(smooth.vertex_normals)
    if not np.isfinite(normals).all():
        raise DecimationError("its normals are not finite")
    return np.array(smooth.vertices), normals, np.array(smooth.faces), deviation


def build_link_meshes(
    parts: Sequence[tuple[int, trimesh.Trimesh, np.ndarray]],
    max_faces: int,
    tolerance: float,
    progress: Callable[[str], None],
) -> tuple[tuple[LinkMesh, ...], Decimation]:
    """Build the meshes of links, decimated to a tolerance if they have more than `max_faces` triangles in total.

    Args:
        parts: index of a link, a mesh of it [m], and its colour.
        max_faces: total number of triangles up to which meshes are not decimated.
        tolerance: maximum deviation of a surface [m].

    Raises:
        RobotError: there are too many triangles in total, or a mesh is degenerate or so irregular that decimation takes
            too long.
    """
    before = sum(len(mesh.faces) for _, mesh, _ in parts)
    if before > MAX_FACES:
        raise RobotError(f"the meshes have more than {MAX_FACES:,} triangles in total. Export simpler meshes.")
    bound = tolerance if before > max_faces else None
    moved = [0.0] * len(parts)
    if before > CLUSTERING_RATIO * max_faces:
        progress(f"{before} triangles in {len(parts)} meshes: clustering their vertices first")
        parts, moved = _clustered_parts(parts, int(_CLUSTERED * max_faces), tolerance)
    result, deviations = [], [0.0]
    # Since each mesh is decimated in its own process, threads suffice to use several cores.
    pool = ThreadPoolExecutor(min(os.cpu_count() or 1, _AT_ONCE), "decimation")
    try:
        bounds = [bound if bound is None else max(bound - each, bound / 2) for each in moved]
        simplified = [pool.submit(simplify, mesh, each) for (_, mesh, _), each in zip(parts, bounds, strict=True)]
        for number, ((link, mesh, color), found) in enumerate(zip(parts, simplified, strict=True), start=1):
            try:
                vertices, normals, faces, deviation = found.result()
            except DecimationError as error:
                raise RobotError(
                    f"mesh {number} of {len(parts)}, with {len(mesh.faces)} triangles, cannot be used: {error}. "
                    "Export it again as a clean triangle mesh."
                ) from error
            progress(f"mesh {number}/{len(parts)}: {len(mesh.faces)} -> {len(faces)} triangles")
            deviations.append(deviation + moved[number - 1])
            vertices, normals, faces = vertices.astype(np.float32), normals.astype(np.float32), faces.astype(np.int32)
            result.append(LinkMesh(link, vertices, normals, faces, color, is_closed(vertices, faces)))
    finally:
        pool.shutdown(cancel_futures=True)
    after = sum(len(mesh.faces) for mesh in result)
    return tuple(result), Decimation(before, after, max(deviations))


Parts = Sequence[tuple[int, trimesh.Trimesh, np.ndarray]]


def _clustered_parts(parts: Parts, most: int, tolerance: float) -> tuple[Parts, list[float]]:
    """Cluster meshes to a total number of triangles; also returns the maximum vertex displacement of each mesh [m].

    Cells grow until the number of triangles is small enough, so displacements may exceed the tolerance.
    """
    cell = _FIRST_CELL * tolerance
    while True:
        made = [clustered(np.asarray(mesh.vertices), np.asarray(mesh.faces), cell) for _, mesh, _ in parts]
        if sum(len(faces) for _, faces, _ in made) <= most:
            break
        cell *= 1.5
    meshes = [trimesh.Trimesh(vertices, faces, process=False) for vertices, faces, _ in made]
    kept = [(link, mesh, color) for (link, _, color), mesh in zip(parts, meshes, strict=True)]
    return kept, [moved for _, _, moved in made]


def clustered(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], cell: float
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"], float]:
    """Merge the vertices in each cell of a grid into their mean; also returns the maximum displacement [m].

    The method works for any triangles and takes time proportional to their number (Rossignac and Borrel,
    Multi-resolution 3D approximations for rendering complex scenes, 1993).

    Args:
        vertices: mesh vertices [m].
        cell: side of the cells [m].
    """
    places = np.floor(vertices / cell).astype(np.int64)
    _, owners = np.unique(places, axis=0, return_inverse=True)
    owners = owners.reshape(-1)
    counts = np.bincount(owners)
    means = np.stack([np.bincount(owners, weights=column) / counts for column in vertices.T], axis=1)
    moved = float(np.linalg.norm(means[owners] - vertices, axis=1).max(initial=0.0))
    kept = owners[faces]
    kept = kept[(kept[:, 0] != kept[:, 1]) & (kept[:, 1] != kept[:, 2]) & (kept[:, 0] != kept[:, 2])]
    _, first = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
    return means, kept[np.sort(first)], moved
