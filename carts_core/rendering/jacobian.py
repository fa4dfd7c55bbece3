"""Derivatives of surface maps and outlines with respect to the unknowns, without autograd."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..compiled import compiled
from ..model.parts import NORMALS
from .points import VisiblePoints, as_array

_HALF = np.float32(0.5)


@compiled
def _move(pixel, begin, end, dT, dK, K, point, position, normal, left, top, width, height, velocity, turning):
    """Fill velocity [2, rows, columns] and rotation of normals [3, rows, columns] of one view where one link is
    visible."""
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
    """Add to `out` the change by neighbours at offset (`down`, `right`) [px] that move at `speed`; see
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


@dataclass(frozen=True)
class JacobianBlock:
    """Derivatives with respect to unknowns that move common links, in a window around these; zero elsewhere."""

    unknowns: Int[Tensor, " g"]
    """Indices of the unknowns."""
    left: int
    top: int
    """Upper left corner of the window in the maps [px]."""
    values: Float[Tensor, "g cameras 6 rows columns"]

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
    """Groups of unknowns that move common links, with all visible links that they move."""
    moves = tangents.Ts_camera_link.abs().amax((-2, -1)) > 0
    moves |= (tangents.intrinsics.abs().amax(-1) > 0)[..., None]
    runs = points.runs()
    families: list[tuple[list[int], set[int]]] = []
    for unknown, moved in enumerate(moves.cpu().numpy()):
        mine = {index for index, (view, link, _) in enumerate(runs) if moved[view, link]}
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
