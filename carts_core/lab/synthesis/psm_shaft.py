"""Shaft of the procedural instrument: carbon tube, metal clevis with pulleys, cables. Roll link's frame, millimetres.

z points to the tip and the wrist's pitch axis is y (through the origin).
"""

import numpy as np
from manifold3d import Manifold

from .psm_shapes import arc, cable, cylinder, half_turn, loft, prism, pulley, turned, union

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
CABLE_RADIUS = 0.23


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


def cables() -> Manifold:
    """Six cables: two loops over the wrist's disc, four around the pulleys."""
    loop = [(2.62, -0.25, -4.0), (2.78, -0.3, -2.0)]
    loop += [(x, -0.3, z) for x, z in arc((0.0, 0.1), 2.82, 0, 92, 9)]
    ropes = [cable(loop, CABLE_RADIUS)]
    for x, y, groove in ((1.9, -1.14, -1.58), (1.6, -2.13, -2.44)):
        run = [(x, y, -4.0), (x, y, -3.0)]
        run += [(u, groove, w) for u, w in arc((0.0, PULLEY_HEIGHT), 1.52, -8, 100, 4)]
        ropes.append(cable(run, CABLE_RADIUS))
    half = union(*ropes)
    return half + half_turn(half, "z")
