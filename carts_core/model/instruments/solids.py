"""Closed triangle meshes from cross-sections, in millimetres.

Parts of an instrument may overlap: a renderer sees the outside of their union.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

_AXES = {"x": [[0, 0, 1], [1, 0, 0], [0, 1, 0]], "y": [[0, 1, 0], [0, 0, 1], [1, 0, 0]], "z": np.eye(3)}


@dataclass(frozen=True)
class Solid:
    """A closed surface, or several of them."""

    vertices: Float[np.ndarray, "V 3"]
    """[mm]"""
    faces: Int[np.ndarray, "F 3"]
    """Counter-clockwise seen from outside."""

    def mirrored(self, axis: int) -> "Solid":
        """The solid with the sign of one coordinate changed."""
        vertices = self.vertices.copy()
        vertices[:, axis] *= -1
        return Solid(vertices, self.faces[:, ::-1])

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> "Solid":
        """The solid, displaced [mm]."""
        return Solid(self.vertices + np.array([x, y, z]), self.faces)


def together(parts: Iterable[Solid]) -> Solid:
    """Several solids as one mesh."""
    vertices, faces, count = [], [], 0
    for part in parts:
        vertices.append(part.vertices)
        faces.append(part.faces + count)
        count += len(part.vertices)
    return Solid(np.concatenate(vertices), np.concatenate(faces))


def loft(rings: Float[np.ndarray, "rings n 3"]) -> Solid:
    """The solid through a stack of star-shaped rings of equally many points [mm], closed by flat ends."""
    rings = np.asarray(rings, dtype=float)
    count, n, _ = rings.shape
    vertices = np.concatenate([rings.reshape(-1, 3), rings[0].mean(0)[None], rings[-1].mean(0)[None]])
    i, j = np.arange(n), (np.arange(n) + 1) % n
    faces = [np.stack([np.full(n, count * n), j, i], 1)]
    for a in range(0, (count - 1) * n, n):
        b = a + n
        faces += [np.stack([a + i, a + j, b + j], 1), np.stack([a + i, b + j, b + i], 1)]
    last = (count - 1) * n
    faces.append(np.stack([np.full(n, count * n + 1), last + i, last + j], 1))
    triangles = np.concatenate(faces)
    p, q, r = (vertices[triangles[:, k]] for k in range(3))
    if np.einsum("ij,ij->", p, np.cross(q, r)) < 0:
        triangles = triangles[:, ::-1]
    return Solid(vertices, triangles)


def turned(profile: Sequence[tuple[float, float]], axis: str, segments: int = 28) -> Solid:
    """A profile of (radius, height) [mm] turned about an axis; heights rise, radii are above 0."""
    angles = np.arange(segments) * (2 * np.pi / segments)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(segments)], axis=1)
    rings = [circle * (radius, radius, 0.0) + (0.0, 0.0, height) for radius, height in profile]
    return loft(np.array(rings) @ np.asarray(_AXES[axis], dtype=float).T)


def cylinder(radius: float, low: float, high: float, axis: str, segments: int = 28) -> Solid:
    """A cylinder from `low` to `high` [mm] along an axis, with a small bevel."""
    bevel = min(0.12, 0.2 * radius, 0.2 * (high - low))
    profile = [(radius - bevel, low), (radius, low + bevel), (radius, high - bevel), (radius - bevel, high)]
    return turned(profile, axis, segments)


def plate(outline: Sequence[tuple[float, float]], low: float, high: float, axis: str) -> Solid:
    """A star-shaped outline with a small bevel, from `low` to `high` [mm] along an axis.

    Args:
        outline: corners [mm], (y, z) for axis "x", (z, x) for axis "y", (x, y) for axis "z".
        low, high: ends along the axis.
        axis: "x", "y" or "z".
    """
    corners = np.asarray(outline, dtype=float)
    centre = corners.mean(0)
    bevel = min(0.15, 0.2 * (high - low))
    reach = np.linalg.norm(corners - centre, axis=1, keepdims=True)
    inner = centre + (corners - centre) * (1 - bevel / np.maximum(reach, 4 * bevel))
    rings = [
        np.column_stack([flat, np.full(len(flat), height)])
        for flat, height in ((inner, low), (corners, low + bevel), (corners, high - bevel), (inner, high))
    ]
    return loft(np.array(rings) @ np.asarray(_AXES[axis], dtype=float).T)


def wire(path: Float[np.ndarray, "n 3"], radii: float | Sequence[float], sides: int = 12) -> Solid:
    """A round wire along a polyline [mm]; its cross-section is carried along without twist."""
    points = np.asarray(path, dtype=float)
    steps = np.diff(points, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    tangents = np.concatenate([steps[:1], steps[:-1] + steps[1:], steps[-1:]])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normal = np.cross(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])
    angles = np.arange(sides) * (2 * np.pi / sides)
    rings = []
    for point, tangent, radius in zip(points, tangents, np.broadcast_to(radii, len(points)), strict=True):
        normal = normal - (normal @ tangent) * tangent
        normal /= np.linalg.norm(normal)
        across = np.cross(tangent, normal)
        rings.append(point + radius * (np.outer(np.cos(angles), normal) + np.outer(np.sin(angles), across)))
    return loft(np.array(rings))


def bar(stations: Float[np.ndarray, "n 5"], roundness: float = 0.35) -> Solid:
    """A bar along y with a rounded rectangle as its cross-section.

    Args:
        stations: y, lower and upper x, lower and upper z [mm] of each cross-section, y rising.
        roundness: radius of the corners, a part of the smaller side's half.
    """
    quarter = np.linspace(-np.pi / 2, 0.0, 3)
    rings = []
    for y, x_low, x_high, z_low, z_high in np.asarray(stations, dtype=float):
        half = np.array([x_high - x_low, z_high - z_low]) / 2
        radius = roundness * half.min()
        centre = np.array([x_low + x_high, z_low + z_high]) / 2
        corners = []
        for number, (sx, sz) in enumerate(((1, -1), (1, 1), (-1, 1), (-1, -1))):
            angles = quarter + number * np.pi / 2
            middle = centre + (half - radius) * (sx, sz)
            corners.append(middle + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1))
        outline = np.concatenate(corners)
        rings.append(np.stack([outline[:, 0], np.full(len(outline), y), outline[:, 1]], axis=1))
    return loft(np.array(rings))
