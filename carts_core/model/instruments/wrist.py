"""The wide wrist of instruments whose wrist axes are more than 9.1 mm apart. Wrist pitch link's frame, millimetres.

x points to the tip, the pitch axis is z (through the origin), the yaw axis is parallel to y, at x = the wrist's length.
"""

import numpy as np

from .solids import Solid, cylinder, loft, plate, together, turned, wire

CHEEK_OUTSIDE = 4.2
"""Half the wrist's width along the yaw axis."""
CHEEK_INSIDE = 2.95
_NECK = 1.2
"""Half the thickness of the part between the shaft's fork arms."""
_END = 4.1
"""How far the cheeks reach beyond the yaw axis."""


def wide_body(length: float) -> Solid:
    """Neck, block and the two cheeks that hold the tip, with pins and pulleys.

    Args:
        length: from the pitch axis to the yaw axis [mm].
    """
    neck = [(-2.4, 1.2), (-1.2, 2.4), (0.0, 2.85), (1.0, 3.3), (2.0, 3.8), (4.5, 4.0)]
    outline = [*((x, -y) for x, y in neck), *neck[::-1]]
    parts = [plate(outline, -_NECK, _NECK, "z"), _block(length)]
    for side in (1.0, -1.0):
        low, high = sorted((side * CHEEK_INSIDE, side * CHEEK_OUTSIDE))
        parts.append(_cheek(length, side))
        parts.append(cylinder(0.9, low - 0.05, high + 0.05, "y", 18).moved(x=length))
        pulleys = [turned([(1.9, a), (1.55, (a + b) / 2), (1.9, b)], "z", 20) for a, b in ((1.25, 2.08), (2.12, 2.95))]
        for pulley in pulleys:
            placed = pulley.moved(x=3.2, y=-2.2)
            parts.append(placed if side > 0 else Solid(placed.vertices * (1, -1, -1), placed.faces))
    return together(parts)


def _block(length: float) -> Solid:
    """The middle part that carries the cheeks: as wide as they are, and slimmer towards the jaws."""
    rings = []
    for x, y, z in ((2.9, 3.6, 2.9), (3.3, 4.0, 3.3), (length - 5.8, 4.0, 3.4), (length - 5.0, 3.4, 2.6)):
        half = np.array([(1, 0.55), (0.8, 1), (-0.8, 1), (-1, 0.55), (-1, -0.55), (-0.8, -1), (0.8, -1), (1, -0.55)])
        rings.append(np.column_stack([np.full(len(half), x), half * (y, z)]))
    return loft(np.array(rings))


def _cheek(length: float, side: float) -> Solid:
    """The plate beside the tip's hub: straight flanks, round about the yaw axis, domed outside."""
    angles = np.deg2rad(np.linspace(-75, 75, 11))
    nose = np.stack([length + _END * np.cos(angles), 3.95 * np.sin(angles)], axis=1)
    flank = np.array([(6.0, 3.45), (3.6, 3.3), (2.7, 2.6), (2.5, 1.2)])
    outline = np.concatenate([nose, flank, (flank * (1, -1))[::-1]])
    centre = np.array([length / 2 + 2.5, 0.0])
    rings = []
    for y, share in ((CHEEK_INSIDE, 0.97), (3.15, 1.0), (3.45, 1.0), (3.8, 0.95), (4.05, 0.84), (CHEEK_OUTSIDE, 0.62)):
        x, z = (centre + share * (outline - centre)).T
        rings.append(np.stack([x, np.full(len(x), side * y), z], axis=1))
    return loft(np.array(rings))


def wide_cables(length: float) -> Solid:
    """The two cables that run between the cheeks to the tip's hub."""
    run = np.array([(2.5, -0.3, 2.5), (5.0, 0.4, 3.3), (length - 1.5, 0.9, 3.5), (length + 0.5, 0.9, 3.45)])
    first = wire(run, 0.25, 6)
    return together([first, Solid(first.vertices * (1, -1, -1), first.faces)])
