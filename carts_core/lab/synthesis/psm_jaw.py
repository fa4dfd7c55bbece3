"""Jaw of the procedural Large Needle Driver. Jaw link's frame, millimetres.

y points to the tip, the jaw turns about z, and the gripping face looks towards +x. The other jaw is the same part
turned by half a turn around y.
"""

import numpy as np
from manifold3d import Manifold

from .psm_shapes import cylinder, loft, prism, rounded_rectangle, turned, union

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


def body() -> Manifold:
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
