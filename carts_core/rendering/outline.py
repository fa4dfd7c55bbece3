"""Occluding contours at subpixel precision, and their motion with the state.

The occluding contour of a smooth surface moves along its normal as the surface does, so the motion of the visible
surface point there is sufficient.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..compiled import compiled
from .jacobian import Tangents
from .points import VisiblePoints, as_array


@compiled
def keep_outline(face_ids, inverse_depth, nearness, border):
    """Keep `face_ids` of pixels with a much farther surface beside, above or below them; set the others to -1.

    Args:
        face_ids, inverse_depth [cameras, height, width]: visible triangle, and 1 / depth [1/m].
        nearness: share of a pixel's inverse depth below which a neighbour is much farther away [1].
        border: width of the image border that is omitted [px].
    """
    cameras, height, width = face_ids.shape
    kept = np.full(face_ids.shape, -1, face_ids.dtype)
    for camera in range(cameras):
        near = inverse_depth[camera]
        for row in range(border, height - border):
            for column in range(border, width - border):
                least = nearness * near[row, column]
                if (
                    near[row - 1, column] < least
                    or near[row + 1, column] < least
                    or near[row, column - 1] < least
                    or near[row, column + 1] < least
                ):
                    kept[camera, row, column] = face_ids[camera, row, column]
    return kept


@compiled
def place_outline(inverse_depth, pixel, kernels, nearness, position, normal):
    """Fill position and normal [2, K] of outline pixels.

    Args:
        inverse_depth [cameras, height, width]: 1 / depth [1/m].
        pixel [K]: indices into the flattened images, farther from their border than the kernels reach.
        kernels [3, side, side]: a Gaussian and its derivatives in x and y.
        nearness: share of the pixel's inverse depth from which another pixel counts as equally near [1].
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
"""Least relative depth difference at an outline [1]; with less, folds of a surface count."""

_BLUR = 1.5
"""Standard deviation of the blur from which normals of outlines are computed [px]."""

BORDER = 6
"""Distance to the image border below which outlines are omitted, since their normals are unknown there [px]."""


@dataclass(frozen=True)
class Outline:
    """Pixels along the outlines of arms and of their parts, in all cameras."""

    camera: Int[Tensor, " K"]
    position: Float[Tensor, "2 K"]
    """Position (x, y) [px]; the centre of the first pixel is (0, 0)."""
    normal: Float[Tensor, "2 K"]
    """Unit normals, outwards."""
    parts: Int[Tensor, " K"]
    """Index into `carts_core.model.parts.PARTS`."""
    motion: Float[Tensor, "unknowns K"]
    """Motion along the normal [px per unit of each unknown]."""

    def at(self, step: Float[Tensor, " unknowns"]) -> "Outline":
        """Outlines after a small step of the unknowns."""
        return replace(self, position=self.position + self.normal * (step @ self.motion))

    def moved_by(self, step: Float[Tensor, " unknowns"]) -> float:
        """Largest motion along the normal for a step of the unknowns [px]; 0 without outlines."""
        motion = step @ self.motion
        return float(motion.abs().max()) if len(motion) else 0.0


def outline_faces(
    face_ids: Int[Tensor, "cameras height width"], inverse_depth: Float[Tensor, "cameras height width"]
) -> Int[Tensor, "cameras height width"]:
    """Visible faces at pixels with a much farther surface beside, above or below them; -1 elsewhere.

    Pixels nearer than `BORDER` to the border of the image do not count.

    Args:
        inverse_depth: 1 / depth [1/m], 0 for background.
    """
    kept = keep_outline(as_array(face_ids), as_array(inverse_depth), 1.0 - BEHIND, BORDER)
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
