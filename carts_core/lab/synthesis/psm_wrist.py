"""Wrist of the procedural instrument. Wrist pitch link's frame, millimetres.

x points to the tip, the pitch axis is z (through the origin), the yaw axis is parallel to y at x = `YAW_AXIS`. Body,
pulleys and cables are unchanged by half a turn around x.
"""

import numpy as np
from manifold3d import Manifold

from .psm_shapes import arc, cable, cylinder, half_turn, prism, pulley, turned, union, with_half_turn

YAW_AXIS = 9.1
CABLE_RADIUS = 0.23
_CHEEK = 2.0
"""Half the opening between the cheeks that hold the jaws."""
_DISC = 1.08
"""Half the thickness of the disc between the shaft's fork arms."""

# Upper half of the body's outline seen along y: (x, z).
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


def body() -> Manifold:
    """The metal body with its pulleys and pins."""
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


def cables() -> Manifold:
    """The two cables that drive the jaws, each around one jaw's groove."""
    path = [(2.6, -0.1, 2.4), (4.5, 0.3, 2.46), (6.5, 0.5, 2.45)]
    path += [(x, 0.62, z) for x, z in arc((YAW_AXIS, 0.0), 2.17, 96, -98, 13)]
    path += [(6.5, 0.35, -1.9), (5.2, 0.12, -1.66), (3.0, 0.1, -1.6)]
    return with_half_turn(cable(path, CABLE_RADIUS), "x")
