"""Derivatives of surface maps and of occluding contours with respect to the unknowns, without autograd.

The motion of an occluding contour of a smooth surface along its normal equals that of the surface, so the motion of the
visible surface point on the contour is sufficient.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..arrays import as_array
from ..compiled import compiled
from ..model.parts import NORMALS
from ..reprs import short_repr
from .rasterizer import VisiblePoints

_HALF = np.float32(0.5)


@compiled
def _move(pixel, begin, end, dT, dK, K, point, position, normal, left, top, width, height, velocity, turning):
    """Fill velocity [2, rows, columns] and rotation of normals [3, rows, columns] in the pixels of a link in a view."""
    for k in range(begin, end):
        x, y, z = point[0, k], point[1, k], point[2, k]
        dx = dT[0, 0] * x + dT[0, 1] * y + dT[0, 2] * z + dT[0, 3]
        dy = dT[1, 0] * x + dT[1, 1] * y + dT[1, 2] * z + dT[1, 3]
        dz = dT[2, 0] * x + dT[2, 1] * y + dT[2, 2] * z + dT[2, 3]
        inverse = np.float32(1.0) / position[2, k]
        ray_x, ray_y = position[0, k] * inverse, position[1, k] * inverse
        column, row = pixel[k] % width - left, pixel[k] // width % height - top
        velocity[0, row, column] = K[0] * (dx - ray_x * dz) * inverse + dK[0] * ray_x + dK[2]
        velocity[1, row, column] = K[1] * (dy - ray_y * dz) * inverse + dK[1] * ray_y + dK[3]
        n = normal[:, k]
        for axis in range(3):
            turning[axis, row, column] = dT[axis, 0] * n[0] + dT[axis, 1] * n[1] + dT[axis, 2] * n[2]


@compiled
def _carry(maps, near, speed, down, right, out):
    """Add to `out` the change caused by neighbours at an offset (`down`, `right`) [px] that move at `speed`; see
    `carry_motion`."""
    channels, rows, columns = maps.shape
    for row in range(rows - down):
        for column in range(columns - right):
            below, beside = row + down, column + right
            if near[row, column] >= near[below, beside]:
                half = _HALF * speed[row, column]
            else:
                half = _HALF * speed[below, beside]
            if half == 0.0:
                continue
            for channel in range(channels):
                moved = half * (maps[channel, row, column] - maps[channel, below, beside])
                out[channel, row, column] += moved
                out[channel, below, beside] += moved


@compiled
def fill_jacobian(unknowns, runs, pixel, point, position, normal, dTs, dKs, Ks, maps, near, left, top, first, out):
    """Fill the derivative of a block of surface maps with respect to some unknowns; see `jacobian.map_jacobian`.

    Args:
        unknowns [g]: indices into the tangents.
        runs [r, 4]: view, link, first point and last point + 1 of each visible link in a view.
        pixel [K], point, position, normal [3, K]: of visible points: index into the maps, position in the link's frame
            and in the camera's [m], and normal in the link's frame, towards the camera.
        dTs [unknowns, views, links, 4, 4], dKs [unknowns, views, 4]: tangents.
        Ks [views, 4]: intrinsics [px].
        maps [views, channels, height, width], near [views, height, width]: surface maps and inverse depth [1/m].
        left, top: upper left corner of the block [px].
        out [g, views, channels, rows, columns]: output, initially zero.
    """
    views, _, rows, columns = out.shape[1:]
    height, width = near.shape[1:]
    velocity = np.empty((views, 2, rows, columns), np.float32)
    for index in range(len(unknowns)):
        velocity[:] = 0.0
        dT, dK = dTs[unknowns[index]], dKs[unknowns[index]]
        for view, link, begin, end in runs:
            turning = out[index, view, first:]
            _move(
                pixel,
                begin,
                end,
                dT[view, link],
                dK[view],
                Ks[view],
                point,
                position,
                normal,
                left,
                top,
                width,
                height,
                velocity[view],
                turning,
            )
        for view in range(views):
            block = maps[view, :, top : top + rows, left : left + columns]
            near_block = near[view, top : top + rows, left : left + columns]
            _carry(block, near_block, velocity[view, 0], 0, 1, out[index, view])
            _carry(block, near_block, velocity[view, 1], 1, 0, out[index, view])


@dataclass(frozen=True)
class Tangents:
    """Derivatives of link transforms and intrinsics, one per unknown."""

    Ts_camera_link: Float[Tensor, "unknowns cameras links 4 4"]
    intrinsics: Float[Tensor, "unknowns cameras 4"]
    """Derivatives of the intrinsics at the rendered size [px]."""

    __repr__ = short_repr


@dataclass(frozen=True)
class JacobianBlock:
    """Derivatives with respect to unknowns that move common links, in a window around these links; zero elsewhere."""

    unknowns: Int[Tensor, " g"]
    """Indices of the unknowns."""
    left: int
    top: int
    """Row of the upper left corner of the window in the maps [px]; `left` is its column."""
    values: Float[Tensor, "g cameras 6 rows columns"]

    __repr__ = short_repr

    def dense(self, unknowns: int, like: Float[Tensor, "cameras 6 height width"]) -> Tensor:
        """Derivative of whole maps with respect to all unknowns, [unknowns, cameras, 6, height, width]."""
        whole = like.new_zeros(unknowns, *like.shape)
        rows, columns = self.values.shape[-2:]
        whole[self.unknowns, :, :, self.top : self.top + rows, self.left : self.left + columns] = self.values
        return whole


def map_jacobian(
    points: VisiblePoints,
    position: Float[Tensor, "3 K"],
    facing: Float[Tensor, "3 K"],
    maps: Float[Tensor, "cameras 6 height width"],
    inverse_depth: Float[Tensor, "cameras height width"],
    intrinsics: Float[Tensor, "cameras 4"],
    tangents: Tangents,
    margin: int,
) -> tuple[JacobianBlock, ...]:
    """Derivatives of surface maps with respect to the unknowns.

    Args:
        position: positions of the points in the camera's frame [m].
        facing: normals in the links' frames, towards the camera.
        inverse_depth: 1 / depth [1/m], 0 for background.
        intrinsics: intrinsics of the cameras [px].
        margin: margin of blocks around the moved pixels [px].
    """
    seen = (points, position, facing, maps, inverse_depth, intrinsics, tangents)
    blocks = []
    for unknowns, runs in _families(points, tangents):
        box = _Box.around([points.pixel[run] for _, _, run in runs], inverse_depth, margin)
        values = jacobian_of_box(*seen, unknowns, runs, box)
        blocks.append(JacobianBlock(torch.tensor(unknowns, device=maps.device), box.left, box.top, values))
    return tuple(blocks)


_Run = tuple[int, int, slice]
"""View, link, and range of the link's points."""


def _families(points: VisiblePoints, tangents: Tangents) -> list[tuple[list[int], list[_Run]]]:
    """Groups of unknowns that move common links, with all visible links of a group."""
    moves = tangents.Ts_camera_link.abs().amax((-2, -1)) > 0
    moves |= (tangents.intrinsics.abs().amax(-1) > 0)[..., None]
    runs = points.runs()
    views, links = [view for view, _, _ in runs], [link for _, link, _ in runs]
    families: list[tuple[list[int], set[int]]] = []
    for unknown, moved in enumerate(moves.cpu().numpy()[:, views, links]):
        mine = set(np.flatnonzero(moved).tolist())
        if not mine:
            continue
        related = [family for family in families if family[1] & mine]
        families = [family for family in families if not family[1] & mine]
        unknowns = sorted([unknown, *(other for family in related for other in family[0])])
        families.append((unknowns, mine.union(*(family[1] for family in related))))
    return [(unknowns, [runs[index] for index in sorted(indices)]) for unknowns, indices in families]


@dataclass(frozen=True)
class _Box:
    """Rectangle in the maps of all cameras [px]."""

    left: int
    top: int
    columns: int
    rows: int

    @staticmethod
    def around(pixels: list[Tensor], inverse_depth: Float[Tensor, "cameras height width"], margin: int) -> "_Box":
        """Bounding box of pixels of the flattened maps, with a margin."""
        height, width = inverse_depth.shape[1:]
        pixel = torch.cat(pixels)
        place = torch.stack([pixel % width, pixel // width % height])
        (left, top), (right, bottom) = torch.stack(place.aminmax(dim=1)).tolist()
        left, top = max(left - margin, 0), max(top - margin, 0)
        right, bottom = min(right + margin + 1, width), min(bottom + margin + 1, height)
        return _Box(left, top, right - left, bottom - top)

    def of(self, maps: Tensor) -> Tensor:
        """Crop of maps [..., height, width]."""
        return maps[..., self.top : self.top + self.rows, self.left : self.left + self.columns]


def jacobian_of_box(
    points: VisiblePoints,
    position: Float[Tensor, "3 K"],
    facing: Float[Tensor, "3 K"],
    maps: Float[Tensor, "cameras 6 height width"],
    inverse_depth: Float[Tensor, "cameras height width"],
    intrinsics: Float[Tensor, "cameras 4"],
    tangents: Tangents,
    unknowns: list[int],
    runs: list[_Run],
    box: _Box,
) -> Float[Tensor, "g cameras 6 rows columns"]:
    """Derivative of a box of surface maps with respect to some unknowns."""
    values = np.zeros((len(unknowns), *maps.shape[:2], box.rows, box.columns), np.float32)
    spans = np.array([(view, link, here.start, here.stop) for view, link, here in runs])
    seen = points.pixel, points.point_link, position, facing
    moved = tangents.Ts_camera_link, tangents.intrinsics, intrinsics, maps, inverse_depth
    arrays = map(as_array, (*seen, *moved))
    fill_jacobian(np.array(unknowns), spans, *arrays, box.left, box.top, NORMALS.start, values)
    return torch.from_numpy(values).to(maps.device)


@compiled
def keep_outline(face_ids, inverse_depth, nearness, border, share):
    """Keep `face_ids` of pixels with a much farther surface to their left, right, above or below; set all others to -1.

    Args:
        face_ids, inverse_depth [cameras, height, width]: visible triangle, and 1 / depth [1/m].
        nearness: share of a pixel's inverse depth below which a neighbour counts as much farther away [1].
        border: width of the image border that is omitted [px].
        share: share of these pixels to keep, selected by a hash of their position [1].
    """
    limit = np.uint32(min(share * 65536.0, 65536.0))
    cameras, height, width = face_ids.shape
    kept = np.full(face_ids.shape, -1, face_ids.dtype)
    for camera in range(cameras):
        near = inverse_depth[camera]
        for row in range(border, height - border):
            above, here, below = near[row - 1], near[row], near[row + 1]
            for column in range(border, width - border):
                if here[column] == 0.0:
                    continue
                least = nearness * here[column]
                if (
                    above[column] < least
                    or below[column] < least
                    or here[column - 1] < least
                    or here[column + 1] < least
                ):
                    mixed = np.uint32(np.uint32(row) * np.uint32(2654435761)) ^ np.uint32(
                        np.uint32(column) * np.uint32(2246822519)
                    )
                    if np.uint32(np.uint32(mixed * np.uint32(3266489917)) >> np.uint32(16)) >= limit:
                        continue
                    kept[camera, row, column] = face_ids[camera, row, column]
    return kept


@compiled
def place_outline(inverse_depth, pixel, kernels, nearness, position, normal):
    """Fill position and normal [2, K] of outline pixels.

    Args:
        inverse_depth [cameras, height, width]: 1 / depth [1/m].
        pixel [K]: indices into the flattened images, farther from their border than the kernels reach.
        kernels [3, side, side]: a Gaussian and its derivatives in x and y.
        nearness: minimum share of the pixel's inverse depth for another pixel to count as equally near [1].
        position, normal [2, K]: output: position of the outline [px], and unit vectors away from the nearer surface.
    """
    height, width = inverse_depth.shape[1:]
    side = kernels.shape[1]
    radius = side // 2
    for k in range(len(pixel)):
        near = inverse_depth[pixel[k] // (height * width)]
        row, column = pixel[k] // width % height, pixel[k] % width
        least = nearness * near[row, column]
        soft, right, down = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for i in range(side):
            for j in range(side):
                if near[row - radius + i, column - radius + j] >= least:
                    soft += kernels[0, i, j]
                    right += kernels[1, i, j]
                    down += kernels[2, i, j]
        steepness = max(np.sqrt(right * right + down * down), np.float32(1e-6))
        normal[0, k], normal[1, k] = -right / steepness, -down / steepness
        shift = min(max((soft - np.float32(0.5)) / steepness, np.float32(-1.0)), np.float32(1.0))
        position[0, k] = column + shift * normal[0, k]
        position[1, k] = row + shift * normal[1, k]


@compiled
def move_along_normal(runs, point, normal, Ts, Ks, dTs, dKs, out):
    """Fill the speed of points along a direction in the image [px per unit of each unknown].

    Args:
        runs [r, 4]: view, link, first point and last point + 1 of each visible link in a view.
        point [3, K]: position in the link's frame [m].
        normal [2, K]: direction of each point.
        Ts [views, links, 4, 4], Ks [views, 4]: poses of links [m], and intrinsics [px].
        dTs [unknowns, views, links, 4, 4], dKs [unknowns, views, 4]: their derivatives.
        out [unknowns, K]: output.
    """
    for run in range(len(runs)):
        view, link = runs[run, 0], runs[run, 1]
        T, K = Ts[view, link], Ks[view]
        for k in range(runs[run, 2], runs[run, 3]):
            x, y, z = point[0, k], point[1, k], point[2, k]
            X = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            Y = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            inverse = np.float32(1.0) / (T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3])
            ray_x, ray_y = X * inverse, Y * inverse
            nx, ny = normal[0, k], normal[1, k]
            along_x, along_y = nx * K[0] * inverse, ny * K[1] * inverse
            along_z = -(along_x * ray_x + along_y * ray_y)
            for unknown in range(len(dTs)):
                d, dK = dTs[unknown, view, link], dKs[unknown, view]
                moved = along_x * (d[0, 0] * x + d[0, 1] * y + d[0, 2] * z + d[0, 3])
                moved += along_y * (d[1, 0] * x + d[1, 1] * y + d[1, 2] * z + d[1, 3])
                moved += along_z * (d[2, 0] * x + d[2, 1] * y + d[2, 2] * z + d[2, 3])
                moved += nx * (dK[0] * ray_x + dK[2]) + ny * (dK[1] * ray_y + dK[3])
                out[unknown, k] = moved


BEHIND = 0.01
"""Minimum relative depth difference at an outline [1]; smaller values would include folds of a surface."""

_BLUR = 1.5
"""Standard deviation of the blur for the computation of outline normals [px]."""

BORDER = 6
"""Distance to the image border below which outlines are omitted, since their normals are unknown there [px]."""


@dataclass(frozen=True)
class Outline:
    """Pixels along the outlines of arms and of their parts, in all cameras."""

    camera: Int[Tensor, " K"]
    position: Float[Tensor, "2 K"]
    """Position (x, y) [px]; the centre of the first pixel is (0, 0)."""
    normal: Float[Tensor, "2 K"]
    """Outward unit normals."""
    parts: Int[Tensor, " K"]
    """Index into `carts_core.model.parts.PARTS`."""
    arms: Int[Tensor, " K"]
    """Index of the arm."""
    motion: Float[Tensor, "unknowns K"]
    """Motion along the normal [px per unit of each unknown]."""

    __repr__ = short_repr

    def at(self, step: Float[Tensor, " unknowns"]) -> "Outline":
        """Outlines moved by a small step of the unknowns."""
        return replace(self, position=self.position + self.normal * (step @ self.motion))

    def moved_by(self, step: Float[Tensor, " unknowns"]) -> float:
        """Maximum motion along the normal for a step of the unknowns [px]; 0 without outlines."""
        motion = step @ self.motion
        return float(motion.abs().max()) if len(motion) else 0.0


def outline_faces(
    face_ids: Int[Tensor, "cameras height width"],
    inverse_depth: Float[Tensor, "cameras height width"],
    share: float = 1.0,
) -> Int[Tensor, "cameras height width"]:
    """Visible faces at pixels with a much farther surface to their left, right, above or below; -1 elsewhere.

    Pixels within `BORDER` of the image border are excluded.

    Args:
        inverse_depth: 1 / depth [1/m], 0 for background.
        share: share of these pixels to keep, scattered evenly [1].
    """
    kept = keep_outline(as_array(face_ids), as_array(inverse_depth), 1.0 - BEHIND, BORDER, share)
    return torch.from_numpy(kept).to(face_ids.device)


def outline_position(
    inverse_depth: Float[Tensor, "cameras height width"], pixel: Int[Tensor, " K"]
) -> tuple[Float[Tensor, "2 K"], Float[Tensor, "2 K"]]:
    """Positions of outline pixels, and normals away from the nearer surface.

    Args:
        inverse_depth: 1 / depth [1/m], 0 for background.
        pixel: outline pixels, as indices into the flattened images.
    """
    position, normal = np.empty((2, len(pixel)), np.float32), np.empty((2, len(pixel)), np.float32)
    place_outline(as_array(inverse_depth), as_array(pixel), gaussian_kernels(), 1.0 - BEHIND, position, normal)
    return torch.from_numpy(position).to(pixel.device), torch.from_numpy(normal).to(pixel.device)


def normal_motion(
    points: VisiblePoints,
    normal: Float[Tensor, "2 K"],
    Ts_camera_link: Float[Tensor, "cameras links 4 4"],
    intrinsics: Float[Tensor, "cameras 4"],
    tangents: Tangents,
) -> Float[Tensor, "unknowns K"]:
    """Speed of points along a direction in the image [px per unit of each unknown].

    Args:
        Ts_camera_link, intrinsics: poses of the links [m], and intrinsics of the cameras [px].
    """
    runs = [(view, link, here.start, here.stop) for view, link, here in points.runs()]
    motion = np.empty((len(tangents.intrinsics), normal.shape[1]), np.float32)
    seen = points.point_link, normal, Ts_camera_link, intrinsics, tangents.Ts_camera_link, tangents.intrinsics
    move_along_normal(np.array(runs, np.int64).reshape(-1, 4), *map(as_array, seen), motion)
    return torch.from_numpy(motion).to(normal.device)


@cache
def gaussian_kernels() -> Float[np.ndarray, "3 side side"]:
    """Gaussian kernel and its derivatives in x and y."""
    radius = BORDER - 1
    steps = torch.arange(-radius, radius + 1, dtype=torch.float32)
    bell = torch.exp(-0.5 * (steps / _BLUR).square())
    bell = bell / bell.sum()
    tilt = bell * steps / _BLUR**2
    return torch.stack([torch.outer(bell, bell), torch.outer(bell, tilt), torch.outer(tilt, bell)]).numpy()
