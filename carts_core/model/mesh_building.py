"""How link meshes are made from a URDF's visuals: read, decimated, shaded; done once, then they come from the cache."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int

from ..errors import RobotError
from ..wording import shown
from .decimation import DecimationError, decimated
from .kinematics import Kinematics
from .mesh_files import MOST_FACES, check_mesh, read_mesh
from .mesh_paths import mesh_path
from .meshes import SLENDER, Decimation, LinkMesh
from .urdf import Box, Cylinder, Sphere, Urdf, Visual

INSTRUMENT_TOLERANCE = 2e-4
"""How far decimation may move surfaces of an instrument [m]."""
REACH_TOLERANCE = 1e-3
"""The same for other robots, a part of their reach [1]."""
SHARP_EDGE = np.deg2rad(38.0)
"""Faces that meet at a larger angle [rad] do not share a smooth normal."""

_DEFAULT_COLOR = np.array([0.6, 0.6, 0.6])
_OPAQUE = 0.99
_AT_ONCE = 4
"""Meshes that are decimated at the same time at most: each may take much memory."""
_MOST_KEPT = 10
"""Times as many triangles as asked for are too many."""


def is_closed(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> bool:
    """Whether each part of a mesh encloses a volume, with its normals outwards.

    Copies of a vertex at sharp edges count as one.
    """
    joined = trimesh.Trimesh(vertices, faces, process=False)
    joined.merge_vertices(merge_norm=True, digits_vertex=7)
    if not (joined.is_watertight and joined.is_winding_consistent):
        return False
    parts = trimesh.graph.connected_component_labels(joined.face_adjacency, node_count=len(joined.faces))
    a, b, c = joined.triangles.swapaxes(0, 1)
    volumes = np.bincount(parts, weights=np.einsum("fi,fi->f", a, np.cross(b, c)))
    return bool((volumes > 0).all())


def load_visual(visual: Visual, folder: Path) -> list[tuple[trimesh.Trimesh, np.ndarray]]:
    """Meshes of one URDF visual in its link's frame, each with its colour.

    Translucent visuals are markers for people (a ball at the remote centre, say) and are left out.

    Raises:
        RobotError: a mesh file is missing or cannot be read.
    """
    if visual.rgba is not None and visual.rgba[3] < _OPAQUE:
        return []
    parts: list[tuple[trimesh.Trimesh, np.ndarray]] = []
    for mesh in _shape(visual, folder):
        if visual.T_link_shape is not None:
            mesh.apply_transform(visual.T_link_shape)
            check_mesh(mesh, "a mesh at its <origin>")
        parts.append((mesh, _mesh_color(mesh) if visual.rgba is None else visual.rgba[:3]))
    return parts


def _shape(visual: Visual, folder: Path) -> list[trimesh.Trimesh]:
    match visual.shape:
        case Box(size):
            return [trimesh.creation.box(extents=size)]
        case Cylinder(radius, length):
            return [trimesh.creation.cylinder(radius=radius, height=length)]
        case Sphere(radius):
            return [trimesh.creation.icosphere(radius=radius)]
        case file:
            named = f"the URDF in {folder} names it as {shown(file.name)}"
            return read_mesh(mesh_path(folder, file.name), file.scale, named)


def _mesh_color(mesh: trimesh.Trimesh) -> np.ndarray:
    visual = mesh.visual
    material = getattr(visual, "material", None)
    rgba = getattr(material, "main_color", None) if material is not None else getattr(visual, "main_color", None)
    return _DEFAULT_COLOR if rgba is None else np.asarray(rgba, dtype=float)[:3] / 255.0


def simplify(
    mesh: trimesh.Trimesh, tolerance: float | None
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"], float]:
    """Vertices, vertex normals and faces of a mesh, decimated if a tolerance is given, and what it deviates by [m].

    Args:
        mesh: [m]
        tolerance: how far its surface may move [m]; None leaves it as it is.

    Raises:
        DecimationError: the mesh is degenerate, or so irregular that it takes too long.
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
        raise DecimationError("all its triangles are without area")
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
    """The meshes of links, decimated to a tolerance where they have more than `max_faces` triangles together.

    Args:
        parts: index of a link, a mesh of it [m], and its colour.
        max_faces: so many triangles in all are left as they are.
        tolerance: how far surfaces may move [m].
        progress: called with a line for people for every mesh.

    Raises:
        RobotError: a mesh is degenerate, or so irregular that it takes too long or keeps too many triangles.
    """
    before = sum(len(mesh.faces) for _, mesh, _ in parts)
    if before > MOST_FACES:
        raise RobotError(f"the meshes have more than {MOST_FACES:,} triangles together. Export simpler ones.")
    bound = tolerance if before > max_faces else None
    result, deviations = [], [0.0]
    # Each mesh is decimated in a process of its own, so that threads are enough to use several cores.
    pool = ThreadPoolExecutor(min(os.cpu_count() or 1, _AT_ONCE), "decimation")
    try:
        simplified = [pool.submit(simplify, mesh, bound) for _, mesh, _ in parts]
        for number, ((link, mesh, color), found) in enumerate(zip(parts, simplified, strict=True), start=1):
            try:
                vertices, normals, faces, deviation = found.result()
            except DecimationError as error:
                raise RobotError(
                    f"mesh {number} of {len(parts)}, with {len(mesh.faces)} triangles, is not usable: {error}. "
                    "Export it again as a clean triangle mesh."
                ) from error
            progress(f"mesh {number}/{len(parts)}: {len(mesh.faces)} -> {len(faces)} triangles")
            deviations.append(deviation)
            vertices, normals, faces = vertices.astype(np.float32), normals.astype(np.float32), faces.astype(np.int32)
            result.append(LinkMesh(link, vertices, normals, faces, color, is_closed(vertices, faces)))
    finally:
        pool.shutdown(cancel_futures=True)
    after = sum(len(mesh.faces) for mesh in result)
    if after > _MOST_KEPT * max_faces:
        raise RobotError(
            f"the meshes have {after} triangles when simplified to {tolerance * 1e3:.2g} mm; allowed are "
            f"{_MOST_KEPT * max_faces}. Export them as clean triangle meshes."
        )
    return tuple(result), Decimation(before, after, max(deviations))


def prepared_meshes(
    model: Urdf,
    kinematics: Kinematics,
    folder: Path,
    link_names: tuple[str, ...],
    limits: tuple[int, float | None],
    report: Callable[[str], None],
) -> tuple[tuple[LinkMesh, ...], Decimation]:
    """The meshes of a robot's links from its files, decimated.

    Args:
        model: the robot.
        kinematics: of it.
        folder: of the URDF.
        link_names: the links, in the order of `LinkMesh.link`.
        limits: `max_faces` and `tolerance` of `Robot.load`.
        report: called with a line for people, now and then.

    Raises:
        RobotError: a mesh is missing or not usable.
    """
    report(f"{model.name}: preparing meshes (once)")
    links = {link.name: link for link in model.links}
    parts = [
        (index, mesh, color)
        for index, name in enumerate(link_names)
        for visual in links[name].visuals
        for mesh, color in load_visual(visual, folder)
    ]
    max_faces, tolerance = limits
    if tolerance is None:
        tolerance = _tolerance(kinematics, link_names, parts)
    meshes, decimation = build_link_meshes(parts, max_faces, tolerance, report)
    if decimation.deviation:
        report(f"{model.name}: {decimation}")
    return meshes, decimation


def _tolerance(
    kinematics: Kinematics, link_names: tuple[str, ...], parts: list[tuple[int, trimesh.Trimesh, np.ndarray]]
) -> float:
    """How far surfaces may move [m]: what an endoscope's image cannot show, or little of a robot's reach."""
    if not parts:
        return INSTRUMENT_TOLERANCE
    longest = max((np.sort(mesh.extents) for _, mesh, _ in parts), key=lambda extents: extents[-1])
    if longest[-2] < SLENDER * longest[-1]:
        return INSTRUMENT_TOLERANCE
    rest = torch.zeros(len(kinematics.joint_names), dtype=torch.float64)
    Ts = kinematics(rest, link_names).numpy()
    reach = max(
        np.linalg.norm(mesh.bounding_box.vertices @ Ts[link, :3, :3].T + Ts[link, :3, 3], axis=1).max()
        for link, mesh, _ in parts
    )
    return max(float(reach) * REACH_TOLERANCE, 1e-6)
