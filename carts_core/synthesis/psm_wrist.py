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
_OUTLINE = np.array(
    [
        (-0.3, 1.08),
        (0.0, 1.23),
        (0.5, 1.52),
        (1.0, 1.79),
        (1.5, 2.06),
        (2.0, 2.31),
        (2.5, 2.53),
        (3.0, 2.7),
        (4.0, 2.93),
    ]
    + [(5.0, 3.04), (5.5, 3.05), (6.0, 3.02), (7.0, 2.85), (8.0, 2.54), (8.5, 2.33), (9.0, 2.08), (9.5, 1.77)]
    + [(10.0, 1.36), (10.3, 0.96), (10.5, 0.5), (10.56, 0.0)]
)


def _shell() -> Manifold:
    """The convex outside: the outline's walls, and a dome over them on either side."""
    outline = np.concatenate([_OUTLINE, _OUTLINE[-2::-1] * (1.0, -1.0)])
    center = np.array([5.2, 0.0])
    points = []
    for scale in (1.0, 0.93, 0.8, 0.6, 0.32):
        height = 2.37 + 0.82 * (1 - scale**2)
        inset = (outline - center) * scale + center
        # The dome reaches back over the disc, beyond the outline's straight flank.
        inset[:, 0] -= 0.5 * (1 - scale) * np.clip((3.0 - inset[:, 0]) / 3.0, 0.0, 1.0)
        for side in (-1.0, 1.0):
            points += [(x, side * height, z) for x, z in inset]
    return Manifold.hull_points(np.array(points))


def _disc() -> Manifold:
    """The disc around the pitch axis, with the two cable grooves on its rim."""
    rim = [(0.0, -_DISC), (2.52, -_DISC), (2.72, -0.95), (3.04, -0.62)]
    disc = turned([*rim, *((r, -z) for r, z in rim[::-1])], "z", 40)
    groove = turned(arc((3.02, 0.33), 0.27, 20, 340, 6), "z", 40) ^ prism(
        [(-4, -4), (2, -4), (2, 0), (-4, 0)], -1, 1, "z"
    )
    return disc - groove - half_turn(groove, "x")


def _relief() -> Manifold:
    """What is cut away above the disc (z > 0): room for the fork's pulleys and for the wrist's own pair."""
    bay = [(2.05, 0.0), (2.3, 0.0), (2.7, 0.28), (3.2, 0.5), (3.8, 0.68), (4.5, 0.84), (5.2, 0.9), (6.3, 0.92)]
    bay += [(6.3, -0.88), (5.55, -0.86), *arc((3.45, -1.47), 2.2, 12, -44, 5), (5.0, -4.0), (-4.0, -4.0), (-4.0, 0.0)]
    return prism(bay, _DISC, 4.0, "z") + cylinder(2.05, _DISC, 4.0, "z", 36)


def body() -> Manifold:
    """The metal body with its pulleys and pins."""
    corner = arc((7.35, 0.75), 1.25, 180, 90, 8)
    slot = [*corner, (11.0, _CHEEK), (11.0, -_CHEEK), *((x, -y) for x, y in corner[::-1])]
    solid = (_shell() - _relief() - half_turn(_relief(), "x")) + _disc()
    solid -= prism(slot, -4.0, 4.0, "z")
    hole = cylinder(0.43, 1.6, 4.0, "y", 14, (2.5, 0.0, 0.3))
    recess = cylinder(0.7, 2.5, 4.0, "y", 20, (YAW_AXIS - 0.15, 0.0, 0.0))
    solid -= union(hole, half_turn(hole, "x"), recess, half_turn(recess, "x"))
    pin = cylinder(0.58, -2.72, 2.72, "y", 20, (YAW_AXIS - 0.15, 0.0, 0.0))
    center = (3.45, -1.4, 0.0)
    pair = union(
        pulley(1.73, 1.42, 1.14, 2.05, "z", 18, center),
        pulley(1.73, 1.42, 2.09, 3.0, "z", 18, center),
        cylinder(0.55, 1.0, 3.13, "z", 14, center),
    )
    return union(solid, pin, with_half_turn(pair, "x"))


def cables() -> Manifold:
    """The two cables that drive the jaws, each around one jaw's groove."""
    path = [(2.5, -0.5, 2.3), (4.0, 0.0, 2.4), (6.5, 0.42, 2.42)]
    path += [(x, 0.62, z) for x, z in arc((YAW_AXIS, 0.0), 2.17, 96, -96, 13)]
    path += [(6.5, 0.42, -2.42), (4.0, 0.1, -2.4), (2.5, 0.5, -2.3)]
    return with_half_turn(cable(path, CABLE_RADIUS), "x")
