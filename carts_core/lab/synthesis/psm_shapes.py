"""Solids that the procedural instrument is made of: prisms, turned parts, lofts, cables. All lengths in millimetres."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from manifold3d import CrossSection, Manifold, Mesh

Point2 = tuple[float, float]


def prism(outline: Sequence[Point2] | Float[np.ndarray, "n 2"], low: float, high: float, axis: str) -> Manifold:
    """Extrude a simple polygon from `low` to `high` [mm] along an axis.

    Args:
        outline: corners [mm] in either sense: (x, y) for axis "z", (y, z) for axis "x", (x, z) for axis "y".
        low, high: ends of the prism along the axis.
        axis: "x", "y" or "z".
    """
    section = CrossSection([_counter_clockwise(outline)])
    if axis == "y":
        # (x, z) drawn as (x, y) and stood up turns the extrusion towards -y.
        return Manifold.extrude(section, high - low).translate((0.0, 0.0, -high)).rotate((90.0, 0.0, 0.0))
    solid = Manifold.extrude(section, high - low).translate((0.0, 0.0, low))
    return _z_to(solid, axis)


def turned(
    profile: Sequence[Point2] | Float[np.ndarray, "n 2"],
    axis: str,
    segments: int,
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Manifold:
    """Turn a closed profile of (radius, height) [mm] around an axis through `center`.

    A profile that touches the axis needs corners there: (0, bottom) and (0, top).
    """
    solid = Manifold.revolve(CrossSection([_counter_clockwise(profile)]), segments)
    return _z_to(solid, axis).translate(center)


def cylinder(
    radius: float, low: float, high: float, axis: str, segments: int, center: tuple[float, float, float] = (0, 0, 0)
) -> Manifold:
    """A cylinder from `low` to `high` [mm] along an axis, displaced by `center`."""
    return turned([(0.0, low), (radius, low), (radius, high), (0.0, high)], axis, segments, center)


def loft(rings: Float[np.ndarray, "rings n 3"]) -> Manifold:
    """The solid through a stack of star-shaped rings of equally many points [mm], closed by flat ends."""
    rings = np.asarray(rings, dtype=float)
    count, n, _ = rings.shape
    vertices = np.concatenate([rings.reshape(-1, 3), rings[0].mean(0)[None], rings[-1].mean(0)[None]])
    first, last = count * n, count * n + 1
    i, j = np.arange(n), (np.arange(n) + 1) % n
    faces = [np.stack([np.full(n, first), j, i], 1)]
    for k in range(count - 1):
        a, b = k * n, (k + 1) * n
        faces += [np.stack([a + i, a + j, b + j], 1), np.stack([a + i, b + j, b + i], 1)]
    faces.append(np.stack([np.full(n, last), (count - 1) * n + i, (count - 1) * n + j], 1))
    triangles = np.concatenate(faces)
    if _signed_volume(vertices, triangles) < 0:
        triangles = triangles[:, ::-1]
    return Manifold(Mesh(vertices.astype(np.float32), np.ascontiguousarray(triangles, np.uint32)))


def cable(path: Sequence[Sequence[float]] | Float[np.ndarray, "n 3"], radius: float, sides: int = 6) -> Manifold:
    """A round rope along a polyline [mm]; its cross-section is carried along without twist."""
    points = np.asarray(path, dtype=float)
    steps = np.diff(points, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    tangents = np.concatenate([steps[:1], steps[:-1] + steps[1:], steps[-1:]])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normal = np.cross(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])
    angles = np.arange(sides) * (2 * np.pi / sides)
    rings = []
    for point, tangent in zip(points, tangents, strict=True):
        normal = normal - (normal @ tangent) * tangent
        normal /= np.linalg.norm(normal)
        binormal = np.cross(tangent, normal)
        rings.append(point + radius * (np.outer(np.cos(angles), normal) + np.outer(np.sin(angles), binormal)))
    return loft(np.array(rings))


def pulley(
    radius: float, groove: float, low: float, high: float, axis: str, segments: int, center: tuple[float, float, float]
) -> Manifold:
    """A cable pulley: rims of `radius`, a round groove down to the radius `groove` between them [mm]."""
    width, middle = high - low, (high + low) / 2
    rim = 0.16 * width
    half = width / 2 - rim
    round_groove = [
        (groove + (radius - 0.05 - groove) * (1 - np.cos(angle)), middle + half * np.sin(angle))
        for angle in np.linspace(-np.pi / 2, np.pi / 2, 3)
    ]
    profile = [
        (0.0, low),
        (radius - 0.06, low),
        (radius, low + 0.5 * rim),
        *round_groove,
        (radius, high - 0.5 * rim),
        (radius - 0.06, high),
        (0.0, high),
    ]
    return turned(profile, axis, segments, center)


def rounded_rectangle(
    u: tuple[float, float], v: tuple[float, float], radii: Sequence[tuple[float, float]], steps: int = 4
) -> Float[np.ndarray, "n 2"]:
    """Corners of a rectangle with elliptical corners, counter-clockwise from the lower right.

    Args:
        u, v: low and high limits [mm].
        radii: semi-axes along u and v of the four corners: lower right, upper right, upper left, lower left.
        steps: points per corner.
    """
    points = []
    corners = [(u[1], v[0], -1, 1), (u[1], v[1], -1, -1), (u[0], v[1], 1, -1), (u[0], v[0], 1, 1)]
    for number, ((cu, cv, su, sv), (ru, rv)) in enumerate(zip(corners, radii, strict=True)):
        for angle in np.linspace(-np.pi / 2, 0.0, steps) + number * np.pi / 2:
            points.append((cu + su * ru + ru * np.cos(angle), cv + sv * rv + rv * np.sin(angle)))
    return np.array(points)


def arc(center: Point2, radius: float, start_deg: float, stop_deg: float, steps: int) -> list[Point2]:
    """Points of a circular arc [mm] from one angle to another [deg]."""
    angles = np.deg2rad(np.linspace(start_deg, stop_deg, steps))
    return [(center[0] + radius * float(np.cos(a)), center[1] + radius * float(np.sin(a))) for a in angles]


def union(*parts: Manifold) -> Manifold:
    """All parts as one solid."""
    return sum(parts[1:], parts[0])


def with_half_turn(solid: Manifold, axis: str) -> Manifold:
    """The solid together with its copy turned by 180 degrees around an axis through the origin."""
    return solid + half_turn(solid, axis)


def half_turn(solid: Manifold, axis: str) -> Manifold:
    """The solid turned by 180 degrees around an axis through the origin, without round-off."""
    signs = {"x": (1, -1, -1), "y": (-1, 1, -1), "z": (-1, -1, 1)}[axis]
    return solid.transform(np.hstack([np.diag(np.array(signs, dtype=float)), np.zeros((3, 1))]))


def _z_to(solid: Manifold, axis: str) -> Manifold:
    # Cyclic permutations of the axes: (x, y, z) becomes (y, z, x) for "x" and (z, x, y) for "y".
    order = {"x": [[0, 0, 1], [1, 0, 0], [0, 1, 0]], "y": [[0, 1, 0], [0, 0, 1], [1, 0, 0]], "z": np.eye(3)}[axis]
    return solid.transform(np.hstack([np.array(order, dtype=float), np.zeros((3, 1))]))


def _counter_clockwise(outline: Sequence[Point2] | Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    points = np.asarray(outline, dtype=float)
    x, y = points.T
    area = np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    return points if area > 0 else points[::-1]


def _signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)
