"""CAD model of the shipped robot, a classic da Vinci PSM with a Large Needle Driver, made from dimensions.

`python -m tools.shipped_robot [OUTPUT_DIR]` writes the URDF and its meshes.
Solids [mm] are in the frame of their link: the shaft with z to the tip and the pitch axis along y, the wrist with x to
the tip and the pitch axis along z, a jaw with y to the tip, rotating about z, its gripping face towards +x.
"""

import itertools
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from manifold3d import CrossSection, Manifold, Mesh
from trimesh.exchange.ply import export_ply

from carts_core.errors import RobotError
from carts_core.files import output_path, write_bytes, write_text
from carts_core.model.instruments import shapes
from carts_core.resources import shipped_robot

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
    return _manifold(shapes.loft(rings))


def cable(path: Sequence[Sequence[float]] | Float[np.ndarray, "n 3"], radius: float, sides: int = 6) -> Manifold:
    """A round rope along a polyline [mm]."""
    return _manifold(shapes.wire(np.asarray(path, dtype=float), radius, sides))


def _manifold(solid: shapes.Solid) -> Manifold:
    return Manifold(Mesh(solid.vertices.astype(np.float32), np.ascontiguousarray(solid.faces, np.uint32)))


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


TUBE_RADIUS = 4.2
"""Published: the instrument's shaft measures 8.4 mm across."""
CLEVIS_RADIUS = 4.2
TUBE_END = -8.82
TUBE_START = -556.6
FLOOR = -3.0
"""Bottom of the fork."""
EAR_INNER = 2.87
"""Half the fork's opening."""
PULLEY_HEIGHT = 0.06
SHAFT_CABLE_RADIUS = 0.23


def tube() -> Manifold:
    """The dark carbon tube. Its rings get shorter towards the tip, so that no triangle is long where a lens is near."""
    lengths = np.linspace(1.0, 8.0, 9)
    stations = (
        TUBE_END - 0.4 - np.concatenate([[0.0], np.cumsum(lengths) / lengths.sum()]) * (TUBE_END - 0.4 - TUBE_START)
    )
    profile = [(0.0, TUBE_START), *((TUBE_RADIUS, z) for z in stations[::-1])]
    profile += [(TUBE_RADIUS, -8.9), (TUBE_RADIUS - 0.11, TUBE_END), (0.0, TUBE_END)]
    # The triangulation of a solid drops collinear corners, so the rings are lofted and not turned.
    angles = np.arange(40) * (2 * np.pi / 40)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(40)], axis=1)
    rings = [circle * (radius, radius, 0.0) + (0.0, 0.0, z) for radius, z in profile[1:-1]]
    return loft(np.array(rings))


def _ear() -> Manifold:
    """One fork arm on the +y side: an arch whose edge is rounded towards the outside."""
    flank = [(2.76, -4.2), (2.75, -3.0), (2.72, -2.4), (2.64, -1.5), (2.45, -0.6), (2.19, 0.1), (1.8, 0.85)]
    arch = np.array([*flank, (1.36, 1.4), (0.9, 1.74), (0.45, 1.9), (0.0, 1.95)])
    inset_at = [(EAR_INNER, 0.07), (3.0, 0.0), (3.4, 0.01), (3.6, 0.07), (3.75, 0.2), (3.9, 0.37)]
    inset_at += [(4.0, 0.53), (4.1, 0.76), (4.2, 1.15)]
    rings = []
    for y, inset in inset_at:
        half = (arch - (0.0, FLOOR)) * (1 - 0.35 * inset / 2.75, 1 - inset / 4.95) + (0.0, FLOOR)
        half[0, 1] = arch[0, 1]
        outline = np.concatenate([half, half[-2::-1] * (-1.0, 1.0)])
        rings.append(np.stack([outline[:, 0], np.full(len(outline), y), outline[:, 1]], axis=1))
    # A fillet from the floor up to the fork's inner face.
    rise = [(2.95, -2.2), (2.85, -2.45), (2.6, -2.75), (2.2, -2.92), (1.7, -3.0), (1.7, -3.2), (2.95, -3.2)]
    fillet = prism(rise, -2.2, 2.2, "x")
    fillet ^= prism([(-2.1, 3.0), (-1.5, 2.62), (-0.55, 1.6), (0.55, 1.6), (1.5, 2.62), (2.1, 3.0)], -4.0, 0.0, "z")
    return loft(np.array(rings)) + fillet


def clevis() -> Manifold:
    """The metal end of the shaft: flattened base, fork, pin and the four pulleys on it."""
    # Above `shoulder` the metal gets thinner by at most 0.1 mm: the rings of vertices that this keeps stop the shading
    # of the fork's rounded edge from running down the cylinder.
    shoulder = -4.85
    profile = [(0, TUBE_END), (4.05, TUBE_END), (CLEVIS_RADIUS, -8.67), (CLEVIS_RADIUS, shoulder)]
    profile += [(CLEVIS_RADIUS - 0.002 * (z - shoulder) ** 2, z) for z in (-3.1, -1.5, 0.0, 2.2)]
    envelope = turned([*profile, (0, 2.2)], "z", 48)
    corners = []
    for z, middle in ((shoulder - 0.05, 2.15), (FLOOR, 2.53)):
        lens = [*arc((-middle, 0.0), 6.4, -41, 41, 9), *arc((middle, 0.0), 6.4, 139, 221, 9)]
        corners += [(x, y, z) for x, y in lens]
    flattened = Manifold.hull_points(np.array(corners)) + cylinder(5.0, TUBE_END - 1.0, shoulder, "z", 8)
    ears = _ear()
    body = envelope ^ union(flattened, ears, half_turn(ears, "z"))
    for x, y in ((1.95, 1.53), (-1.95, -1.53)):
        body -= cylinder(0.38, -4.5, -2.0, "z", 10, (x, y, 0.0))
    for low, high in ((3.7, 4.5), (-4.5, -3.7)):
        body -= cylinder(0.73, low, high, "y", 18, (0.0, 0.0, PULLEY_HEIGHT))
    pin = cylinder(0.64, -4.03, 4.03, "y", 18, (0.0, 0.0, PULLEY_HEIGHT))
    bands = ((1.16, 2.01), (2.04, 2.86), (-2.01, -1.16), (-2.86, -2.04))
    pulleys = [pulley(1.89, 1.6, low, high, "y", 16, (0.0, 0.0, PULLEY_HEIGHT)) for low, high in bands]
    return union(body, pin, *pulleys)


def shaft_cables() -> Manifold:
    """Six shaft_cables: two loops over the wrist's disc, four around the pulleys."""
    loop = [(2.62, -0.25, -4.0), (2.78, -0.3, -2.0)]
    loop += [(x, -0.3, z) for x, z in arc((0.0, 0.1), 2.82, 0, 92, 9)]
    ropes = [cable(loop, SHAFT_CABLE_RADIUS)]
    for x, y, groove in ((1.9, -1.14, -1.58), (1.6, -2.13, -2.44)):
        run = [(x, y, -4.0), (x, y, -3.0)]
        run += [(u, groove, w) for u, w in arc((0.0, PULLEY_HEIGHT), 1.52, -8, 100, 4)]
        ropes.append(cable(run, SHAFT_CABLE_RADIUS))
    half = union(*ropes)
    return half + half_turn(half, "z")


YAW_AXIS = 9.1
WRIST_CABLE_RADIUS = 0.23
_CHEEK = 2.0
"""Half the opening between the cheeks that hold the jaws."""
_DISC = 1.08
"""Half the thickness of the disc between the shaft's fork arms."""

# Upper half of the wrist_body's outline seen along y: (x, z).
_FLANK = [(-0.2, 1.0), (0.0, 1.23), (0.5, 1.52), (1.0, 1.79), (2.0, 2.31), (3.0, 2.71), (4.0, 2.94), (5.0, 3.05)]
_NOSE = [(6.0, 3.03), (7.0, 2.86), (8.0, 2.54), (9.0, 2.09), (9.5, 1.78), (10.0, 1.36), (10.3, 0.96), (10.5, 0.5)]
_OUTLINE = np.array([*_FLANK, *_NOSE, (10.56, 0.0)])


def _shell() -> Manifold:
    """The convex outside: the outline's walls, and a dome over them on either side."""
    outline = np.concatenate([_OUTLINE, _OUTLINE[-2::-1] * (1.0, -1.0)])
    center = np.array([5.2, 0.0])
    points = []
    for scale in (1.0, 0.92, 0.78, 0.55, 0.22):
        height = 2.37 + 0.82 * (1 - scale**2)
        inset = (outline - center) * scale + center
        # The dome reaches back over the disc, beyond the outline's straight flank.
        inset[:, 0] -= 0.5 * (1 - scale) * np.clip((3.0 - inset[:, 0]) / 3.0, 0.0, 1.0)
        for side in (-1.0, 1.0):
            points += [(x, side * height, z) for x, z in inset]
    return Manifold.hull_points(np.array(points))


def _disc() -> Manifold:
    """The disc around the pitch axis, with the two cable grooves on its rim."""
    # A hundredth lower than the relief's floor: two coplanar faces would leave slivers.
    rim = [(0.0, -_DISC + 0.01), (2.52, -_DISC + 0.01), (2.72, -0.95), (3.04, -0.62)]
    disc = turned([*rim, *((r, -z) for r, z in rim[::-1])], "z", 40)
    side = prism([(-4, -4), (2, -4), (2, 0), (-4, 0)], -1, 1, "z")
    groove = turned(arc((3.02, 0.33), 0.27, 20, 340, 6), "z", 40) ^ side
    # Its sides are flattened a little.
    return (disc - groove - half_turn(groove, "x")).scale((1.0, 0.92, 1.0))


def _relief() -> Manifold:
    """What is cut away above the disc (z > 0): room for the fork's pulleys and for the wrist's own pair."""
    bay = [(1.8, 0.02), (2.25, 0.04), (2.7, 0.33), (3.2, 0.57), (3.8, 0.72), (4.5, 0.84), (5.2, 0.9), (6.3, 0.92)]
    bay += [(6.3, -0.88), *arc((2.8, -1.47), 2.6, 13, -35, 5), (5.0, -4.0), (-4.0, -4.0), (-4.0, 0.0)]
    return prism(bay, _DISC, 4.0, "z") + cylinder(1.98, _DISC, 4.0, "z", 36).rotate((0.0, 0.0, 3.0))


def wrist_body() -> Manifold:
    """The metal wrist_body with its pulleys and pins."""
    corner = arc((7.2, 0.8), 1.2, 180, 90, 6)
    slot = [*corner, (11.0, _CHEEK), (11.0, -_CHEEK), *((x, -y) for x, y in corner[::-1])]
    solid = (_shell() - _relief() - half_turn(_relief(), "x")) + _disc()
    solid -= prism(slot, -4.0, 4.0, "z")
    hole = cylinder(0.43, 1.6, 4.0, "y", 14, (2.5, 0.0, 0.3))
    recess = cylinder(0.66, 2.5, 4.0, "y", 18, (YAW_AXIS - 0.22, 0.0, 0.0))
    solid -= union(hole, half_turn(hole, "x"), recess, half_turn(recess, "x"))
    pin = cylinder(0.54, -2.72, 2.72, "y", 18, (YAW_AXIS - 0.22, 0.0, 0.0))
    center = (3.45, -1.4, 0.0)
    pair = union(
        pulley(1.73, 1.42, 1.14, 2.05, "z", 16, center),
        pulley(1.73, 1.42, 2.09, 3.0, "z", 16, center),
        cylinder(0.55, 1.0, 3.13, "z", 12, center),
    )
    return union(solid, pin, with_half_turn(pair, "x"))


def wrist_cables() -> Manifold:
    """The two wrist_cables that drive the jaws, each around one jaw's groove."""
    path = [(2.6, -0.1, 2.4), (4.5, 0.3, 2.46), (6.5, 0.5, 2.45)]
    path += [(x, 0.62, z) for x, z in arc((YAW_AXIS, 0.0), 2.17, 96, -98, 13)]
    path += [(6.5, 0.35, -1.9), (5.2, 0.12, -1.66), (3.0, 0.1, -1.6)]
    return with_half_turn(cable(path, WRIST_CABLE_RADIUS), "x")


OTHER_JAW_SHIFT = -0.025
"""The other jaw's displacement along z, the play between the two hubs."""
INSERT_START = 4.52
INSERT_BACK = -0.64
TOOTH_TOP, TOOTH_ROOT = 0.05, -0.13
TOOTH_PITCH = 0.42

# Cross-sections along the jaw: y, outer and inner x, lower and upper z, then the semi-axes (x, z) of the outer
# upper and the outer lower corner, and the radius of the inner corners.
_ROOT = np.array(
    [
        (0.3, -1.65, -0.2, 0.02, 1.97, 0.45, 0.40, 0.10, 0.10, 0.05),
        (2.3, -1.65, -0.2, 0.02, 1.97, 0.45, 0.40, 0.12, 0.12, 0.05),
        (2.65, -1.65, -0.15, 0.02, 1.95, 0.50, 0.50, 0.28, 0.28, 0.15),
        (2.95, -1.65, -0.05, 0.02, 1.87, 0.60, 0.62, 0.42, 0.42, 0.30),
        (3.2, -1.65, -0.02, 0.00, 1.72, 0.68, 0.85, 0.45, 0.48, 0.30),
        (3.5, -1.63, -0.05, -0.17, 1.45, 0.66, 0.84, 0.50, 0.58, 0.25),
        (3.65, -1.61, -0.11, -0.42, 1.33, 0.63, 0.82, 0.45, 0.65, 0.25),
        (3.8, -1.60, -0.13, -0.84, 1.23, 0.62, 0.80, 0.42, 0.65, 0.22),
        (3.95, -1.58, -0.16, -0.97, 1.16, 0.61, 0.80, 0.50, 0.70, 0.20),
        (4.3, -1.55, -0.22, -1.03, 1.05, 0.60, 0.80, 0.60, 0.76, 0.15),
        (INSERT_START, -1.53, -0.25, -1.03, 1.01, 0.60, 0.80, 0.60, 0.80, 0.13),
    ]
)
_BLADE = np.array(
    [
        (INSERT_START, -1.53, INSERT_BACK, -1.03, 1.01, 0.60, 0.80, 0.60, 0.80, 0.01),
        (5.5, -1.44, INSERT_BACK, -0.97, 0.95, 0.56, 0.77, 0.56, 0.77, 0.01),
        (6.5, -1.34, INSERT_BACK, -0.92, 0.89, 0.51, 0.72, 0.51, 0.72, 0.01),
        (8.5, -1.15, INSERT_BACK, -0.80, 0.77, 0.45, 0.65, 0.45, 0.65, 0.01),
        (8.95, -1.10, INSERT_BACK, -0.77, 0.745, 0.42, 0.62, 0.42, 0.62, 0.01),
        (9.2, -1.05, INSERT_BACK, -0.71, 0.68, 0.38, 0.57, 0.38, 0.57, 0.01),
        (9.35, -0.99, INSERT_BACK, -0.62, 0.59, 0.33, 0.50, 0.33, 0.50, 0.01),
        (9.47, -0.91, INSERT_BACK, -0.51, 0.48, 0.25, 0.42, 0.25, 0.42, 0.01),
        (9.56, -0.83, INSERT_BACK, -0.37, 0.345, 0.17, 0.32, 0.17, 0.32, 0.01),
        (9.65, -0.67, INSERT_BACK, -0.07, 0.05, 0.02, 0.05, 0.02, 0.05, 0.01),
    ]
)


def _sections(table: np.ndarray) -> Manifold:
    rings = []
    for y, outer, inner, low, high, top_x, top_z, bottom_x, bottom_z, inner_radius in table:
        corner = (inner_radius, inner_radius)
        radii = [corner, corner, (top_x, top_z), (bottom_x, bottom_z)]
        outline = rounded_rectangle((outer, inner), (low, high), radii)
        rings.append(np.stack([outline[:, 0], np.full(len(outline), y), outline[:, 1]], axis=1))
    return loft(np.array(rings))


def _hub() -> Manifold:
    """The domed disc around the hinge, with the groove of the cable that drives the jaw."""
    profile = [(0.0, 0.0), (2.05, 0.0), (2.18, 0.07), (2.22, 0.2), (2.1, 0.45), (2.08, 0.6), (2.13, 0.8), (2.24, 0.93)]
    profile += [
        (2.41, 0.98),
        (2.41, 1.2),
        (2.2, 1.42),
        (1.9, 1.65),
        (1.55, 1.81),
        (1.2, 1.93),
        (1.05, 1.97),
        (0.0, 1.97),
    ]
    return turned(profile, "z", 36)


def _cable_block() -> Manifold:
    """The block beside the jaw's root in which the cable's crimp sits."""
    side = [(0.2, 0.02), (3.0, 0.02), (3.2, 0.12), (3.32, 0.35), (3.36, 0.6), (3.3, 0.9), (3.18, 1.15), (2.95, 1.45)]
    side += [(2.65, 1.72), (2.35, 1.87), (2.05, 1.95), (1.8, 1.97), (0.2, 1.97)]
    front = rounded_rectangle((-0.6, 1.05), (0.0, 1.97), [(0.12, 0.12), (0.15, 0.15), (0.01, 0.01), (0.01, 0.01)], 4)
    plan = [(-0.6, 0.0), (1.05, 0.0), (1.05, 3.3), (1.0, 3.36), (-0.6, 3.36)]
    return prism(side, -0.6, 1.1, "x") ^ prism(front, 0.0, 4.0, "y") ^ prism(plan, -0.5, 2.5, "z")


def jaw_body() -> Manifold:
    """The metal part: hub, cable block and half-round blade."""
    solid = union(_hub(), _cable_block(), _sections(_ROOT), _sections(_BLADE))
    solid -= cylinder(0.36, -2.0, 2.0, "x", 14, (0.0, 2.3, 0.62))
    return solid + cylinder(0.3, -0.74, 0.38, "x", 6, (0.0, 2.0, 0.6))


def insert() -> Manifold:
    """The carbide insert with its cross-hatched gripping face: square pyramids between diagonal V grooves."""
    y, low, high = _BLADE[:, 0], _BLADE[:, 3], _BLADE[:, 4]
    outline = [*zip(y, low, strict=True), *zip(y[::-1], high[::-1], strict=True)]
    block = prism(outline, INSERT_BACK - 0.02, TOOTH_TOP, "x")
    depth, half = TOOTH_TOP - TOOTH_ROOT, TOOTH_PITCH / 2
    # One V cutter along y, a little higher than the face so that neighbouring cutters meet below it.
    over = 0.01
    width = half * (depth + over) / depth
    cutter = prism([(TOOTH_ROOT, 0.0), (TOOTH_TOP + over, -width), (TOOTH_TOP + over, width)], -8.0, 8.0, "y")
    cutters = []
    for angle in (45.0, -45.0):
        for k in range(-10, 11):
            cutters.append(_about(cutter.translate((0.0, 0.0, k * TOOTH_PITCH)), angle))
    return block - union(*cutters)


def _about(cutter: Manifold, angle: float) -> Manifold:
    """Turn a cutter in the gripping face's plane, about the face's middle [deg]."""
    return cutter.rotate((angle, 0.0, 0.0)).translate((0.0, (INSERT_START + 9.65) / 2, 0.0))


ROBOT_NAME = "psm_lnd"
METAL = (0.60, 0.60, 0.60)
CARBIDE = (0.50, 0.50, 0.50)
TUBE = (0.20, 0.20, 0.20)
CABLE = (0.05, 0.05, 0.05)

# Lengths of the classic PSM with this instrument [m], as in the dVRK's published kinematic files.
L_RCC = 0.4318
L_TOOL = 0.4162
L_PITCH_TO_YAW = 0.0091
L_YAW_TO_TIP = 0.0102


@dataclass(frozen=True)
class Row:
    """One row of the modified Denavit-Hartenberg table: Rot_x(alpha) Trans_x(a) Trans_z(d) Rot_z(theta)."""

    joint: str
    """Name of the joint that `theta` or `d` moves; the last row moves with none."""
    kind: str
    """"revolute", "prismatic" or "fixed"."""
    alpha: float
    """[rad]"""
    a: float
    """[m]"""
    d: float
    """Constant part of d [m]."""
    theta: float
    """Constant part of theta [rad]."""
    limits: tuple[float, float] = (0.0, 0.0)
    """[rad] or [m], as in the publicly available URDFs of the dVRK's PSM."""


_RIGHT = np.pi / 2
DH_TABLE = (
    Row("yaw", "revolute", _RIGHT, 0.0, 0.0, _RIGHT, (-1.5707, 1.5707)),
    Row("pitch", "revolute", -_RIGHT, 0.0, 0.0, -_RIGHT, (-0.7854, 0.7854)),
    Row("insertion", "prismatic", _RIGHT, 0.0, -L_RCC, 0.0, (0.0, 0.240)),
    Row("roll", "revolute", 0.0, 0.0, L_TOOL, 0.0, (-4.53786, 4.53786)),
    Row("wrist_pitch", "revolute", -_RIGHT, 0.0, 0.0, -_RIGHT, (-1.39626, 1.39626)),
    Row("wrist_yaw", "revolute", -_RIGHT, L_PITCH_TO_YAW, 0.0, -_RIGHT, (-1.39626, 1.39626)),
    Row("tool_tip", "fixed", -_RIGHT, 0.0, L_YAW_TO_TIP, _RIGHT),
)
JAW_LIMITS = (-0.349066, 1.39626)
"""Opening between the two jaws [rad]; each of them turns by half of it."""


@dataclass(frozen=True)
class Part:
    """One mesh file: a part of a link in one colour."""

    name: str
    link: str
    color: tuple[float, float, float]
    build: Callable[[], Manifold]
    """Makes the solid in the link's frame, in millimetres."""
    keep_rings: bool = False
    """Keep flat neighbouring triangles apart; otherwise they are merged."""


def parts() -> tuple[Part, ...]:
    """Every mesh of the instrument; `jaw_2_link` shares those of `jaw_1_link`."""
    return (
        Part("shaft_tube", "roll_link", TUBE, tube, keep_rings=True),
        Part("shaft_clevis", "roll_link", METAL, clevis),
        Part("shaft_cables", "roll_link", CABLE, shaft_cables),
        Part("wrist_body", "wrist_pitch_link", METAL, wrist_body),
        Part("wrist_cables", "wrist_pitch_link", CABLE, wrist_cables),
        Part("yaw_pin", "wrist_yaw_link", METAL, lambda: cylinder(0.61, -2.84, 2.62, "z", 20)),
        Part("jaw_body", "jaw_1_link", METAL, jaw_body),
        Part("jaw_insert", "jaw_1_link", CARBIDE, insert),
    )


def to_mesh(part: Part) -> trimesh.Trimesh:
    """The part's surface in metres.

    Raises:
        RobotError: the part is empty or not closed, that is, a dimension makes no sense.
    """
    solid = part.build()
    raw = (solid if part.keep_rings else solid.simplify(4e-3)).to_mesh()
    vertices = np.asarray(raw.vert_properties, dtype=float)[:, :3] * 1e-3
    mesh = trimesh.Trimesh(vertices, np.asarray(raw.tri_verts, dtype=int), process=False)
    if not len(mesh.faces) or not mesh.is_watertight:
        raise RobotError(
            f"part {part.name} of the procedural PSM is not a closed solid. Undo the last change of its dimensions."
        )
    # Boolean operations leave slivers below a micrometre, whose normals mean nothing: weld them away.
    mesh.merge_vertices(digits_vertex=6)
    mesh.update_faces(mesh.nondegenerate_faces(height=1e-9))
    mesh.remove_unreferenced_vertices()
    return mesh


def write(folder: Path) -> list[Path]:
    """Write `psm_lnd.urdf` and `meshes/*.ply` into `folder`.

    Returns:
        The written files, the URDF first.

    Raises:
        RobotError: a part is not a closed solid.
    """
    urdf = output_path(folder, f"{ROBOT_NAME}.urdf")
    written = [urdf.path]
    for part in parts():
        path = output_path(folder, "meshes", f"{part.name}.ply")
        write_bytes(path, export_ply(to_mesh(part), encoding="binary", vertex_normal=False))
        written.append(path.path)
    write_text(urdf, urdf_text())
    return written


def urdf_text() -> str:
    """The URDF; every constant rotation is a multiple of 90 degrees, printed with all its digits."""
    lines = [
        '<?xml version="1.0"?>',
        "<!-- Classic da Vinci PSM with a Large Needle Driver, by `python -m carts_core.lab.synthesis.psm`. -->",
        f'<robot name="{ROBOT_NAME}">',
    ]
    lines += [
        f'  <material name="{name}"><color rgba="{_numbers((*color, 1.0))}"/></material>' for name, color in _MATERIALS
    ]
    lines.append('  <link name="base_link"/>')
    parent = "base_link"
    for row in DH_TABLE:
        child = f"{row.joint}_link"
        xyz, rpy = _origin(row)
        lines += _joint(row.joint, row.kind, parent, child, xyz, rpy, row.limits)
        lines += _link(child)
        if row.kind != "fixed":
            parent = child
    lines += _joint("jaw", "revolute", "wrist_yaw_link", "jaw_link", np.zeros(3), np.zeros(3), JAW_LIMITS)
    lines += _link("jaw_link")
    for number, share in ((1, 0.5), (2, -0.5)):
        bound = JAW_LIMITS[1] / 2
        lines += _joint(f"jaw_{number}", "revolute", "wrist_yaw_link", f"jaw_{number}_link", np.zeros(3), np.zeros(3),
                        (-bound, bound), f'<mimic joint="jaw" multiplier="{share}"/>')  # fmt: skip
        lines += _link(f"jaw_{number}_link")
    return "\n".join([*lines, "</robot>", ""])


_MATERIALS = (("metal", METAL), ("carbide", CARBIDE), ("tube", TUBE), ("cable", CABLE))


def _link(name: str) -> list[str]:
    mirrored = name == "jaw_2_link"
    own = [part for part in parts() if part.link == ("jaw_1_link" if mirrored else name)]
    if not own:
        return [f'  <link name="{name}"/>']
    origin = ""
    if mirrored:
        origin = f'<origin xyz="0 0 {OTHER_JAW_SHIFT * 1e-3:g}" rpy="{_numbers((0.0, np.pi, 0.0))}"/>'
    materials = {color: material for material, color in _MATERIALS}
    visuals = [
        f'    <visual>{origin}<geometry><mesh filename="meshes/{part.name}.ply"/></geometry>'
        f'<material name="{materials[part.color]}"/></visual>'
        for part in own
    ]
    return [f'  <link name="{name}">', *visuals, "  </link>"]


def _joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    xyz: Float[np.ndarray, "3"],
    rpy: Float[np.ndarray, "3"],
    limits: tuple[float, float],
    extra: str = "",
) -> list[str]:
    inner = [f'<parent link="{parent}"/>', f'<child link="{child}"/>',
             f'<origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/>']  # fmt: skip
    if kind != "fixed":
        inner.append('<axis xyz="0 0 1"/>')
        inner.append(f'<limit lower="{limits[0]!r}" upper="{limits[1]!r}" effort="1000" velocity="0.4"/>')
    if extra:
        inner.append(extra)
    return [f'  <joint name="{name}" type="{kind}">', *(f"    {line}" for line in inner), "  </joint>"]


def dh_transform(row: Row, position: float = 0.0) -> Float[np.ndarray, "4 4"]:
    """T_previous_row of one DH row at a joint position [rad] or [m], in double precision."""
    d = row.d + (position if row.kind == "prismatic" else 0.0)
    theta = row.theta + (position if row.kind == "revolute" else 0.0)
    T_previous_row = np.eye(4)
    T_previous_row[:3, :3] = _rotation(0, row.alpha) @ _rotation(2, theta)
    T_previous_row[:3, 3] = np.array([row.a, 0.0, 0.0]) + _rotation(0, row.alpha) @ np.array([0.0, 0.0, d])
    return T_previous_row


def _origin(row: Row) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """xyz [m] and rpy [rad] of a DH row at joint position zero; URDF has no Denavit-Hartenberg."""
    T_previous_row = dh_transform(row)
    quarter_turns = (0.0, _RIGHT, -_RIGHT, np.pi)
    for roll, pitch, yaw in itertools.product(quarter_turns, repeat=3):
        rotation = _rotation(2, yaw) @ _rotation(1, pitch) @ _rotation(0, roll)
        if np.allclose(rotation, T_previous_row[:3, :3], atol=1e-12):
            return np.round(T_previous_row[:3, 3], 9) + 0.0, np.array([roll, pitch, yaw])
    raise RobotError(f"DH row {row.joint} is not turned by multiples of 90 degrees. Correct the table in psm.py.")


def _rotation(axis: int, angle: float) -> Float[np.ndarray, "3 3"]:
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.eye(3)
    rotation[i, i] = rotation[j, j] = np.cos(angle)
    rotation[j, i] = np.sin(angle)
    rotation[i, j] = -rotation[j, i]
    return rotation


def _numbers(values: np.ndarray | tuple[float, ...]) -> str:
    # repr keeps every digit of pi / 2; whole numbers are printed short.
    return " ".join(f"{value:g}" if value == int(value) else repr(value) for value in map(float, values))


if __name__ == "__main__":
    for path in write(Path(sys.argv[1]) if len(sys.argv) > 1 else shipped_robot().parent):
        print(path)
