"""Occluding contours at subpixel precision, and their motion with the state.

Where a smooth surface turns away from the camera, its contour moves with the surface along the contour's normal, so the
motion of the visible surface point there is sufficient.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from ..compiled import compiled
from ..threads import one_thread
from .jacobian import Tangents
from .points import VisiblePoints


@compiled
def keep_outline(face_ids, inverse_depth, nearness, border):
    """`face_ids` of the pixels that have something much further away beside, above or below them; -1 elsewhere.

    Args:
        face_ids, inverse_depth [cameras, height, width]: what is seen, and 1 / depth [1/m].
        nearness: share of its inverse depth below which a neighbour is much further away [1].
        border: width of the rim of the image that is left out [px].
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
        kernels [3, side, side]: a Gaussian and its derivatives, right and down.
        nearness: share of the pixel's inverse depth from which another one counts as no further away [1].
        position, normal [2, K]: where the outline is [px], and unit vectors away from what is nearer.
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
    """Fill how fast points move along a direction in the image [px per unit of each unknown].

    Args:
        runs [r, 4]: view, link, first point and one past the last one, of each link that is seen in a view.
        point [3, K]: in its link's frame [m].
        normal [2, K]: the direction.
        Ts [views, links, 4, 4], Ks [views, 4]: where links are [m], and intrinsics [px].
        dTs [unknowns, views, links, 4, 4], dKs [unknowns, views, 4]: their derivatives.
        out [unknowns, K]: what is filled.
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


_BEHIND = 0.01
"""How much further away what is beside an outline is at least, as a share [1]. With less, folds of a surface count."""

_BLUR = 1.5
"""Deviation of the blur that gives outlines their normals [px]."""

BORDER = 6
"""Outlines nearer than this to the border of the image are left out; their normals are not known there [px]."""


@dataclass(frozen=True)
class Outline:
    """Pixels along the outlines of arms and of their parts, in all cameras."""

    camera: Int[Tensor, " K"]
    position: Float[Tensor, "2 K"]
    """Where the outline is, x and y; the centre of the first pixel is (0, 0) [px]."""
    normal: Float[Tensor, "2 K"]
    """Unit vectors, outwards."""
    parts: Int[Tensor, " K"]
    """Index into `carts_core.model.parts.PARTS`."""
    motion: Float[Tensor, "unknowns K"]
    """Along the normal [px per unit of each unknown]."""

    def at(self, step: Float[Tensor, " unknowns"]) -> "Outline":
        """Where the outlines are after a small step of the unknowns."""
        return replace(self, position=self.position + self.normal * (step @ self.motion))

    def moved_by(self, step: Float[Tensor, " unknowns"]) -> float:
        """How far a step of the unknowns moves what moves most along its normal [px]; 0 where there are none."""
        motion = step @ self.motion
        return float(motion.abs().max()) if len(motion) else 0.0


def outline_pixels(inverse_depth: Float[Tensor, "cameras height width"]) -> Bool[Tensor, "cameras height width"]:
    """Pixels with something much further away beside, above or below them, but for those at the border.

    Args:
        inverse_depth: 1 / depth [1/m], 0 for background.
    """
    least = (1.0 - _BEHIND) * inverse_depth[:, 1:-1, 1:-1]
    around = (
        inverse_depth[:, :-2, 1:-1],
        inverse_depth[:, 2:, 1:-1],
        inverse_depth[:, 1:-1, :-2],
        inverse_depth[:, 1:-1, 2:],
    )
    rim = torch.zeros_like(least, dtype=torch.bool)
    for neighbour in around:
        rim |= neighbour < least
    rim = functional.pad(rim, (1, 1, 1, 1))
    rim[:, :BORDER] = rim[:, -BORDER:] = False
    rim[:, :, :BORDER] = rim[:, :, -BORDER:] = False
    return rim


def outline_faces(
    face_ids: Int[Tensor, "cameras height width"], inverse_depth: Float[Tensor, "cameras height width"]
) -> Int[Tensor, "cameras height width"]:
    """The faces that `outline_pixels` see, -1 elsewhere."""
    if face_ids.device.type != "cpu":
        return torch.where(outline_pixels(inverse_depth), face_ids, -1)
    return torch.from_numpy(keep_outline(face_ids.numpy(), inverse_depth.numpy(), 1.0 - _BEHIND, BORDER))


def outline_position(
    inverse_depth: Float[Tensor, "cameras height width"], pixel: Int[Tensor, " K"]
) -> tuple[Float[Tensor, "2 K"], Float[Tensor, "2 K"]]:
    """Where the outline is at its pixels, and its normal, away from what is nearer.

    Args:
        inverse_depth: 1 / depth [1/m], 0 for background.
        pixel: of the outlines, as indices into the flattened images.
    """
    if pixel.device.type != "cpu":
        return outline_position_torch(inverse_depth, pixel)
    radius, kernels = _kernels(pixel.device)
    position, normal = np.empty((2, len(pixel)), np.float32), np.empty((2, len(pixel)), np.float32)
    side = 2 * radius + 1
    planes = kernels.view(3, side, side).numpy()
    place_outline(inverse_depth.numpy(), pixel.numpy(), planes, 1.0 - _BEHIND, position, normal)
    return torch.from_numpy(position), torch.from_numpy(normal)


def outline_position_torch(
    inverse_depth: Float[Tensor, "cameras height width"], pixel: Int[Tensor, " K"]
) -> tuple[Float[Tensor, "2 K"], Float[Tensor, "2 K"]]:
    """The same without the compiled kernel, for any device."""
    height, width = inverse_depth.shape[1:]
    radius, kernels = _kernels(inverse_depth.device)
    reach = torch.arange(-radius, radius + 1, device=pixel.device)
    around = (reach[:, None] * width + reach).flatten()
    near = inverse_depth.flatten()
    nearer = (near[pixel + around[:, None]] >= (1.0 - _BEHIND) * near[pixel]).float()
    with one_thread():
        soft, right, down = kernels @ nearer
    slope = torch.stack([-right, -down])
    steepness = torch.linalg.vector_norm(slope, dim=0).clamp(min=1e-6)
    normal = slope / steepness
    # The outline is where the blurred silhouette is one half; near a thin tip that is nowhere.
    centre = torch.stack([pixel % width, pixel // width % height])
    return centre + ((soft - 0.5) / steepness).clamp(-1.0, 1.0) * normal, normal


def normal_motion(
    points: VisiblePoints,
    normal: Float[Tensor, "2 K"],
    Ts_camera_link: Float[Tensor, "cameras links 4 4"],
    intrinsics: Float[Tensor, "cameras 4"],
    tangents: Tangents,
) -> Float[Tensor, "unknowns K"]:
    """How fast points move along a direction in the image [px per unit of each unknown].

    Args:
        points: what is seen there.
        normal: the direction.
        Ts_camera_link, intrinsics: where links are, and the cameras [m, px].
        tangents: derivatives of both by the unknowns.
    """
    if normal.device.type != "cpu":
        return normal_motion_torch(points, normal, Ts_camera_link, intrinsics, tangents)
    runs = [(view, link, here.start, here.stop) for view, link, here in points.runs()]
    motion = np.empty((len(tangents.intrinsics), normal.shape[1]), np.float32)
    move_along_normal(
        np.array(runs, np.int64).reshape(-1, 4),
        points.point_link.contiguous().numpy(),
        normal.contiguous().numpy(),
        Ts_camera_link.contiguous().numpy(),
        intrinsics.contiguous().numpy(),
        tangents.Ts_camera_link.contiguous().numpy(),
        tangents.intrinsics.contiguous().numpy(),
        motion,
    )
    return torch.from_numpy(motion)


def normal_motion_torch(
    points: VisiblePoints,
    normal: Float[Tensor, "2 K"],
    Ts_camera_link: Float[Tensor, "cameras links 4 4"],
    intrinsics: Float[Tensor, "cameras 4"],
    tangents: Tangents,
) -> Float[Tensor, "unknowns K"]:
    """The same without the compiled kernel, for any device."""
    view, link = points.owners()
    T, K = Ts_camera_link[view, link], intrinsics[view].T
    point = points.point_link
    X, Y, Z = (T[:, :3, :3] @ point.T[..., None])[..., 0].T + T[:, :3, 3].T
    ray = torch.stack([X / Z, Y / Z])
    # By the position in the camera's frame, and from it by the link's pose, row by row.
    slope = normal * K[:2] / Z
    slope = torch.cat([slope, -(slope * ray).sum(0, keepdim=True)])
    by_pose = slope[:, None] * torch.cat([point, torch.ones_like(point[:1])])
    by_intrinsics = torch.cat([normal * ray, normal])
    pose = tangents.Ts_camera_link[:, view, link, :3].flatten(2)
    return (pose * by_pose.flatten(0, 1).T).sum(-1) + (tangents.intrinsics[:, view] * by_intrinsics.T).sum(-1)


@lru_cache(maxsize=4)
def _kernels(device: torch.device) -> tuple[int, Float[Tensor, "3 n"]]:
    """Radius and weights of a Gaussian and of its derivatives, right and down."""
    radius = BORDER - 1
    steps = torch.arange(-radius, radius + 1, device=device, dtype=torch.float32)
    bell = torch.exp(-0.5 * (steps / _BLUR).square())
    bell = bell / bell.sum()
    tilt = bell * steps / _BLUR**2
    planes = (torch.outer(bell, bell), torch.outer(bell, tilt), torch.outer(tilt, bell))
    return radius, torch.stack([plane.flatten() for plane in planes])
