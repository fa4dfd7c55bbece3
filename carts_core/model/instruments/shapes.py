"""Shapes of the built-in instruments [mm]: closed meshes from cross-sections, the wide wrist, and the tips.

Meshes of an instrument may overlap, since the renderer shows the outside of their union. The wrist is in the frame of
the wrist pitch link: x points to the tip, the pitch axis is z, and the yaw axis is parallel to y at x = wrist length.
Tips are in the frame of the jaw link: y points to the tip, and the yaw axis is z. The side of a jaw is the sign of its
x coordinates, and its gripping face is near x = 0.
"""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

_AXES = {"x": [[0, 0, 1], [1, 0, 0], [0, 1, 0]], "y": [[0, 1, 0], [0, 0, 1], [1, 0, 0]], "z": np.eye(3)}


@dataclass(frozen=True)
class Solid:
    """Mesh of one or several closed surfaces."""

    vertices: Float[np.ndarray, "V 3"]
    """Vertex positions [mm]."""
    faces: Int[np.ndarray, "F 3"]
    """Vertex indices, counter-clockwise seen from outside."""

    def mirrored(self, axis: int) -> "Solid":
        """Copy mirrored along one axis."""
        vertices = self.vertices.copy()
        vertices[:, axis] *= -1
        return Solid(vertices, self.faces[:, ::-1])

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> "Solid":
        """Copy translated by (x, y, z) [mm]."""
        return Solid(self.vertices + np.array([x, y, z]), self.faces)


def merged(parts: Iterable[Solid]) -> Solid:
    """Combine several solids into one mesh."""
    vertices, faces, count = [], [], 0
    for part in parts:
        vertices.append(part.vertices)
        faces.append(part.faces + count)
        count += len(part.vertices)
    return Solid(np.concatenate(vertices), np.concatenate(faces))


def loft(rings: Float[np.ndarray, "rings n 3"]) -> Solid:
    """Loft a solid through star-shaped rings with equal numbers of points [mm], closed by flat ends."""
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
    """Create a solid of revolution from a profile of (radius, height) [mm]; heights increase, radii are positive."""
    angles = np.arange(segments) * (2 * np.pi / segments)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(segments)], axis=1)
    rings = [circle * (radius, radius, 0.0) + (0.0, 0.0, height) for radius, height in profile]
    return loft(np.array(rings) @ np.asarray(_AXES[axis], dtype=float).T)


def cylinder(radius: float, low: float, high: float, axis: str, segments: int = 28) -> Solid:
    """Create a cylinder from `low` to `high` [mm] along an axis, with a small bevel."""
    bevel = min(0.12, 0.2 * radius, 0.2 * (high - low))
    profile = [(radius - bevel, low), (radius, low + bevel), (radius, high - bevel), (radius - bevel, high)]
    return turned(profile, axis, segments)


def plate(outline: Sequence[tuple[float, float]], low: float, high: float, axis: str) -> Solid:
    """Extrude a star-shaped outline from `low` to `high` [mm] along an axis, with a small bevel.

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
    """Create a round wire along a polyline [mm], with a cross-section that does not twist."""
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
    """Create a bar along y with a rounded rectangle as cross-section.

    Args:
        stations: y, lower and upper x, lower and upper z [mm] of each cross-section, with increasing y.
        roundness: radius of the corners, relative to half the smaller side [1].
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


CHEEK_OUTSIDE = 4.2
"""Half the wrist's width along the yaw axis [mm]."""
CHEEK_INSIDE = 2.95
_NECK = 1.2
"""Half the thickness of the part between the shaft's fork arms [mm]."""
_END = 4.1
"""Extent of the cheeks beyond the yaw axis [mm]."""


def wide_body(length: float) -> Solid:
    """Body of the wide wrist: neck, block and the two cheeks that hold the tip, with pins and pulleys.

    Args:
        length: distance from the pitch axis to the yaw axis [mm].
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
    return merged(parts)


def _block(length: float) -> Solid:
    """Block that carries the cheeks, equally wide and tapered towards the jaws."""
    rings = []
    for x, y, z in ((2.9, 3.6, 2.9), (3.3, 4.0, 3.3), (length - 5.8, 4.0, 3.4), (length - 5.0, 3.4, 2.6)):
        half = np.array([(1, 0.55), (0.8, 1), (-0.8, 1), (-1, 0.55), (-1, -0.55), (-0.8, -1), (0.8, -1), (1, -0.55)])
        rings.append(np.column_stack([np.full(len(half), x), half * (y, z)]))
    return loft(np.array(rings))


def _cheek(length: float, side: float) -> Solid:
    """Cheek beside the tip's hub: a plate with straight flanks, rounded about the yaw axis and domed outside."""
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
    """Two cables that run between the cheeks to the tip's hub."""
    run = np.array([(2.5, -0.3, 2.5), (5.0, 0.4, 3.3), (length - 1.5, 0.9, 3.5), (length + 0.5, 0.9, 3.45)])
    first = wire(run, 0.25, 6)
    return merged([first, Solid(first.vertices * (1, -1, -1), first.faces)])


Table = tuple[tuple[float, float], ...]
"""Pairs of a position along the blade (0 at the root, 1 at the end) and a length [mm]."""

FIRST, SECOND = -1, 1
"""Sides of the jaws `jaw_1_link` and `jaw_2_link`."""


@dataclass(frozen=True)
class Hub:
    """Discs on the yaw axis about which the tip rotates."""

    radius: float = 3.4
    """Radius of the discs [mm]."""
    height: float = 2.6
    """Half the total height of both discs [mm]."""


@dataclass(frozen=True)
class Jaws:
    """Two blades that open like pliers."""

    length: float
    """Distance from the yaw axis to the end of the closed jaws [mm]."""
    widths: Table
    """Half width of a blade, across the opening plane."""
    thickness: Table
    """Thickness of a blade, from the gripping face outwards."""
    hub: Hub = Hub()
    root: float = 4.0
    """Distance from the yaw axis to the root of the blades [mm]."""
    arch: float = 0.0
    """Lateral bend of the blades' middle [mm]."""
    turn: float = 0.0
    """Lateral bend of the blades' ends [mm]."""
    windows: tuple[tuple[float, float], ...] = ()
    """Openings in a blade: start and end, as positions along the blade from 0 to 1."""
    rim: float = 0.75
    """Width of the rim beside a window [mm]."""
    insert: float = 0.0
    """Thickness of an insert of another material in the gripping face [mm]."""
    pivot: float = 0.0
    """Distance of the jaws' axis beyond the yaw axis [mm]."""

    def jaw(self, side: int) -> Solid:
        """Metal part of one jaw."""
        first = self.root - self.pivot
        parts = [_hub(self.hub, side, self.pivot), _neck(self, side)]
        edges = [0.0, *(edge for window in self.windows for edge in window), 1.0]
        for number, (start, stop) in enumerate(itertools.pairwise(edges)):
            # Neighbouring parts overlap slightly, so that no gap is visible.
            places = np.linspace(max(start - 0.005, 0.0), min(stop + 0.005, 1.0), 7)
            table = self._stations(side, places, first)
            if number % 2 == 0:
                parts.append(bar(table))
                continue
            low, high = table.copy(), table.copy()
            low[:, 4] = np.minimum(table[:, 3] + self.rim, table[:, 4])
            high[:, 3] = np.maximum(table[:, 4] - self.rim, table[:, 3])
            parts += [bar(low), bar(high)]
        return merged(parts)

    def base(self) -> Solid | None:
        """Bearing of the jaws beyond the yaw axis."""
        if not self.pivot:
            return None
        reach = self.pivot + 0.55 * self.hub.radius
        places = [(-0.6, 0.9), (2.5, 0.95), (0.6 * self.pivot, 0.8), (self.pivot, 0.6), (reach, 0.4)]
        bridge = bar(np.array([(y, -r * self.hub.radius, r * self.hub.radius, -1.25, 1.25) for y, r in places]))
        return merged([cylinder(self.hub.radius, -self.hub.height, self.hub.height, "z", 32), bridge])

    def inserted(self, side: int) -> Solid | None:
        """Insert of one jaw; None without an insert."""
        if not self.insert:
            return None
        table = self._stations(side, np.linspace(0.3, 0.985, 8), self.root - self.pivot)
        table[:, 1:3] = sorted((side * 0.03, side * (self.insert + 0.05)))
        table[:, 3] += 0.12
        table[:, 4] -= 0.12
        return bar(table, 0.1)

    def _stations(self, side: int, places: np.ndarray, first: float) -> Float[np.ndarray, "n 5"]:
        places = np.sort(np.concatenate([places, [0.96, 0.985]])) if places[-1] == 1.0 else places
        y = first + places * (self.length - self.pivot - first)
        width, thickness = _at(self.widths, places), _at(self.thickness, places)
        # The end is rounded.
        taper = np.interp(places, [0.9, 0.96, 0.985, 1.0], [1.0, 0.86, 0.66, 0.3])
        middle = self.turn * places**2 + 4 * self.arch * places * (1 - places)
        outer = side * thickness * np.minimum(1.0, taper + 0.25)
        inner = np.full_like(outer, side * max(0.06, self.insert))
        outer = side * np.maximum(np.abs(outer), np.abs(inner) + 0.15)
        x = np.sort(np.stack([inner, outer], axis=1), axis=1)
        return np.column_stack([y, x, middle - width * taper, middle + width * taper])


@dataclass(frozen=True)
class Scissors:
    """Two thin blades that pass each other."""

    length: float
    """Distance from the yaw axis to the end of the tip [mm]."""
    widths: Table
    """Half width of a blade in the opening plane."""
    blade: float = 0.95
    """Thickness of a blade [mm]."""
    hub: Hub = Hub(2.4, 2.0)
    turn: float = 0.0
    """Lateral bend of the ends [mm]."""
    root: float = 2.0
    """Distance from the yaw axis to the root of the blades [mm]."""
    pivot: float = 0.0
    """Always 0: blades rotate about the yaw axis."""

    def jaw(self, side: int) -> Solid:
        """One blade with its hub."""
        places = np.array([0.0, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.96, 1.0])
        width = _at(self.widths, places) * np.interp(places, [0.9, 0.96, 1.0], [1.0, 0.8, 0.35])
        middle = self.turn * places**2
        y = self.root + places * (self.length - self.root)
        # The cutting edge extends slightly beyond the middle.
        edge, back = -side * 0.25 * np.minimum(width, 1.0), side * (2 * width - 0.25 * np.minimum(width, 1.0))
        x = np.sort(np.stack([edge, back], axis=1), axis=1)
        z = (0.03, self.blade) if side == FIRST else (-self.blade, -0.03)
        table = np.column_stack([y, x, middle + z[0], middle + z[1]])
        return merged([_hub(self.hub, side, 0.0), bar(table, 0.15)])

    def inserted(self, side: int) -> Solid | None:
        """None, since a blade consists of one material."""
        return None


@dataclass(frozen=True)
class ClipApplier:
    """Two bowed arms with a groove for a clip at their ends."""

    length: float = 22.2
    """Distance from the yaw axis to the end of the tip [mm]."""
    bow: float = 3.7
    """Maximum distance of the outside of an arm from the middle [mm]."""
    height: float = 1.15
    """Half the width of an arm across the opening plane [mm]."""
    hub: Hub = Hub()
    pivot: float = 0.0
    """Always 0: the arms rotate about the yaw axis."""

    def jaw(self, side: int) -> Solid:
        """One arm with its base."""
        near, far = 11.0, self.length
        low, high = (1.35, self.hub.height) if side == FIRST else (-self.hub.height, -1.35)
        base = [(1.0, 0.9), (3.0, 1.0), (6.0, 0.6), (9.0, 1.0), (near, 0.2)]
        outline = [(side * -x, y) for y, x in base] + [(side * self.bow * 0.97, near), (side * self.bow, 2.0)]
        parts = [_hub(self.hub, side, 0.0), plate(outline, low, high, "z")]
        places = np.linspace(0.0, 1.0, 9)
        outer = side * np.interp(places, [0, 0.2, 0.9, 1.0], [self.bow, 0.97 * self.bow, 0.55 * self.bow, 1.5])
        inner = side * np.interp(places, [0, 0.2, 0.85, 1.0], [0.45, 1.7, 0.7, 0.7])
        x = np.sort(np.stack([inner, outer], axis=1), axis=1)
        y = near - 1.5 + places * (far - near + 1.5)
        # The foot of the arm is as high as the base, which is off-centre.
        foot = (places < 0.2).astype(float)
        below = -self.height + foot * min(0.0, low + self.height)
        above = self.height + foot * max(0.0, high - self.height)
        parts.append(bar(np.column_stack([y, x, below, above])))
        for start, stop in ((far - 2.4, far - 1.7), (far - 0.8, far)):
            lip = sorted((side * 0.12, side * 1.4))
            parts.append(bar(np.array([(y, *lip, -self.height, self.height) for y in (start, stop)])))
        return merged(parts)

    def inserted(self, side: int) -> Solid | None:
        """None, since an arm consists of one material."""
        return None


@dataclass(frozen=True)
class Electrode:
    """Tip without jaws: a bent wire, or a paddle, on an insulated collar."""

    path: tuple[tuple[float, float], ...]
    """Centre line of the wire from the collar on, (x, y) [mm]."""
    radius: float = 0.62
    """Radius of the wire [mm]."""
    collar: float = 6.4
    """End of the collar along y [mm]."""
    paddle: tuple[float, float, float] | None = None
    """Length, half width and half thickness of a paddle at the end of the wire [mm]."""
    hub: Hub = Hub(3.3, 2.5)
    height: float = 0.9
    """Offset of the wire from the middle, along the yaw axis [mm]."""

    def body(self) -> Solid:
        """Hub and collar."""
        collar = [cylinder(1.7, 2.0, self.collar, "y"), cylinder(1.1, self.collar - 0.2, self.collar + 0.9, "y")]
        hub = cylinder(self.hub.radius, -self.hub.height, self.hub.height, "z", 32)
        return merged([hub, *(part.moved(z=self.height) for part in collar)])

    def electrode(self) -> Solid:
        """Wire, with its paddle if any."""
        path = np.array([(x, y, self.height) for x, y in self.path])
        parts = [wire(path, [self.radius] * (len(path) - 1) + [0.7 * self.radius])]
        if self.paddle:
            length, width, thickness = self.paddle
            end = path[-1, 1]
            places = np.array([0.0, 0.15, 0.3, 0.8, 0.93, 1.0])
            half = width * np.array([0.5, 0.85, 1.0, 1.0, 0.8, 0.4])
            low, high = self.height - thickness, self.height + thickness
            rows = [(end - 0.4 + s * length, -w, w, low, high) for s, w in zip(places, half, strict=True)]
            parts.append(bar(np.array(rows)))
        return merged(parts)


Tip = Jaws | Scissors | ClipApplier | Electrode


def _at(table: Sequence[tuple[float, float]], places: np.ndarray) -> np.ndarray:
    keys, values = zip(*table, strict=True)
    return np.interp(places, keys, values)


def _hub(hub: Hub, side: int, pivot: float) -> Solid:
    """Half of the hub for one jaw, above or below the other half; a lug for a jaw with a pivot."""
    low, high = (0.03, hub.height) if side == FIRST else (-hub.height, -0.03)
    return cylinder(0.6 * hub.radius if pivot else hub.radius, low, high, "z", 32)


def _neck(tip: Jaws, side: int) -> Solid:
    """Transition from a jaw's off-centre half of the hub to its centred blade."""
    first = tip.root - tip.pivot
    width, thickness = tip.widths[0][1], tip.thickness[0][1]
    low, high = (0.05, tip.hub.height - 0.1) if side == FIRST else (0.1 - tip.hub.height, -0.05)
    radius = 0.55 * tip.hub.radius
    rows = []
    for y, share in ((0.0, 0.0), (0.45 * first, 0.0), (0.8 * first, 0.5), (first + 0.3, 1.0)):
        inner, outer = sorted((side * max(0.06, tip.insert) * share, side * (radius + share * (thickness - radius))))
        if share < 1.0:
            # Behind the blade, the neck is centred on the hub.
            inner, outer = (inner - 0.5, outer) if side == SECOND else (inner, outer + 0.5)
        rows.append((y, inner, outer, low + share * (-width - low), high + share * (width - high)))
    return bar(np.array(rows))
