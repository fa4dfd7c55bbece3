"""Visible surface points in the frame of their link, and their shading.

Points are constant in the frame of their link; the state moves the link. Vectors are columns (`3 K`), ordered by
link, so that all points of a link move by one product. The gradient of shading is that of the link's rotation against
light and camera.
"""

from dataclasses import dataclass
from itertools import accumulate

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..compiled import compiled
from ..model.scene import Light
from .geometry import SceneGeometry


def unit(vectors: Float[Tensor, "3 K"]) -> Float[Tensor, "3 K"]:
    """Columns scaled to length 1."""
    return vectors * vectors.square().sum(0).clamp(min=1e-24).rsqrt()


def phong(
    color: Float[Tensor, "3 K"], points: Float[Tensor, "3 K"], normals: Float[Tensor, "3 K"], light: Light
) -> Float[Tensor, "3 K"]:
    """Phong shading with one point light, two-sided.

    Args:
        color: of the surface, linear RGB.
        points: in the camera's frame [m].
        normals: unit vectors in the camera's frame.
        light: its position is in the camera's frame.

    Returns:
        Linear RGB in [0, 1].
    """
    to_light = unit(points.new_tensor(light.position)[:, None] - points)
    to_camera = -unit(points)
    towards_camera = (normals * to_camera).sum(0)
    # A surface that is seen from behind is lit from behind.
    side = torch.where(towards_camera.detach() < 0, -1.0, 1.0)
    cosine = (normals * to_light).sum(0) * side
    # The mirrored direction of the light is 2 (n . l) n - l; only its cosine to the camera is needed.
    mirrored = 2.0 * cosine * towards_camera * side - (to_light * to_camera).sum(0)
    highlight = light.specular * mirrored.clamp(min=1e-4) ** light.shininess * (cosine > 0)
    lit = light.ambient + light.diffuse * cosine.clamp(min=0.0)
    return (color * lit + highlight).clamp(max=1.0)


@compiled
def _gather(
    face_ids, inverse_depth, Ts_camera_link, intrinsics, face_links, barycentric, normals, starts, pixels, faces, out
):
    """Fill pixels, faces and `out` (points above normals), each run of a view and a link from its start on."""
    views, height, width = face_ids.shape
    links = Ts_camera_link.shape[1]
    for view in range(views):
        fx, fy, cx, cy = intrinsics[view]
        for row in range(height):
            for column in range(width):
                face = face_ids[view, row, column]
                if face < 0:
                    continue
                link = face_links[face]
                k = starts[view * links + link]
                starts[view * links + link] += 1
                pixels[k] = (view * height + row) * width + column
                faces[k] = face
                T = Ts_camera_link[view, link]
                depth = 1.0 / inverse_depth[view, row, column]
                x = (column + 0.5 - cx) / fx * depth - T[0, 3]
                y = (row + 0.5 - cy) / fy * depth - T[1, 3]
                z = depth - T[2, 3]
                for axis in range(3):
                    out[axis, k] = T[0, axis] * x + T[1, axis] * y + T[2, axis] * z
                # A pixel at the rim of its triangle may leave it by a rounding error.
                b = _affine(barycentric[:4, face], out[:3, k])
                c = _affine(barycentric[4:, face], out[:3, k])
                n = normals[:, face]
                squared = 0.0
                for axis in range(3):
                    value = n[axis] + b * (n[3 + axis] - n[axis]) + c * (n[6 + axis] - n[axis])
                    out[3 + axis, k] = value
                    squared += value * value
                for axis in range(3, 6):
                    out[axis, k] /= np.sqrt(max(squared, 1e-24))


@compiled
def _affine(coefficients, point):
    """A barycentric coordinate of a point, in [0, 1]."""
    value = coefficients[0] * point[0] + coefficients[1] * point[1] + coefficients[2] * point[2] + coefficients[3]
    return min(max(value, 0.0), 1.0)


@compiled
def _count(face_ids, face_links, links, counts):
    views, height, width = face_ids.shape
    for view in range(views):
        for row in range(height):
            for column in range(width):
                face = face_ids[view, row, column]
                if face >= 0:
                    counts[view * links + face_links[face]] += 1


def gather_points(
    face_ids: Int[np.ndarray, "views height width"],
    inverse_depth: Float[np.ndarray, "views height width"],
    Ts_camera_link: Float[np.ndarray, "views links 4 4"],
    intrinsics: Float[np.ndarray, "views 4"],
    face_links: Int[np.ndarray, " F"],
    face_barycentric: Float[np.ndarray, "8 F"],
    face_normals: Float[np.ndarray, "9 F"],
) -> tuple[Int[np.ndarray, " K"], Int[np.ndarray, " K"], Float[np.ndarray, "3 K"], Float[np.ndarray, "3 K"], list[int]]:
    """What the visible pixels see, in the order of views, links and pixels; see `points.VisiblePoints`.

    Returns:
        `pixel`, `face`, `point_link`, `normal_link`, and the number of points of each link in each view.
    """
    links = Ts_camera_link.shape[1]
    counts = np.zeros(len(face_ids) * links, np.int64)
    _count(face_ids, face_links, links, counts)
    starts, total = np.cumsum(counts) - counts, int(counts.sum())
    pixels, faces = np.empty(total, np.int64), np.empty(total, np.int64)
    out = np.empty((6, total), np.float32)
    _gather(
        face_ids,
        inverse_depth,
        Ts_camera_link,
        intrinsics,
        face_links,
        face_barycentric,
        face_normals,
        starts,
        pixels,
        faces,
        out,
    )
    return pixels, faces, out[:3], out[3:], counts.tolist()


@dataclass(frozen=True)
class VisiblePoints:
    """What the visible pixels see. `K` counts visible pixels through all views. Nothing here carries a gradient."""

    pixel: Int[Tensor, " K"]
    """Index into the flattened `views x height x width`."""
    face: Int[Tensor, " K"]
    groups: tuple[tuple[int, int, int], ...]
    """View, link and number of points of each run of points on the same link in the same view."""
    point_link: Float[Tensor, "3 K"]
    """The surface point, in the frame of its link [m]."""
    normal_link: Float[Tensor, "3 K"]
    """Interpolated normal there, in the frame of its link."""

    def runs(self) -> list[tuple[int, int, slice]]:
        """View, link, and where the points are, of each run of points on the same link in the same view."""
        ends = list(accumulate(count for _, _, count in self.groups))
        return [
            (view, link, slice(end - count, end)) for (view, link, count), end in zip(self.groups, ends, strict=True)
        ]

    def transformed(self, Ts_camera_link: Float[Tensor, "views links 4 4"]) -> tuple[Tensor, Tensor]:
        """Points and normals in the frames of their cameras, each [3, K], differentiable in the transforms."""
        if self.point_link.device.type != "cpu":
            return self.transformed_at_once(Ts_camera_link)
        counts = [count for _, _, count in self.groups]
        points, normals = self.point_link.split(counts, 1), self.normal_link.split(counts, 1)
        moved, turned = [], []
        for (view, link, _), point, normal in zip(self.groups, points, normals, strict=True):
            T = Ts_camera_link[view, link]
            moved.append(T[:3, :3] @ point + T[:3, 3:])
            turned.append(T[:3, :3] @ normal)
        if not moved:
            return self.point_link, self.normal_link
        return torch.cat(moved, 1), torch.cat(turned, 1)

    def transformed_at_once(self, Ts_camera_link: Float[Tensor, "views links 4 4"]) -> tuple[Tensor, Tensor]:
        """The same in few large operations, as a GPU likes it."""
        view, link = self.owners()
        R, t = Ts_camera_link[view, link, :3, :3], Ts_camera_link[view, link, :3, 3]
        points, normals = torch.stack([self.point_link, self.normal_link]).mT.unsqueeze(-1)
        return ((R @ points)[..., 0] + t).T, (R @ normals)[..., 0].T

    def owners(self) -> tuple[Int[Tensor, " K"], Int[Tensor, " K"]]:
        """View and link of each point."""
        groups = torch.tensor(self.groups, dtype=torch.long, device=self.pixel.device).reshape(-1, 3)
        view, link = groups[:, :2].repeat_interleave(groups[:, 2], dim=0).T
        return view, link

    def intrinsics(self, intrinsics: Float[Tensor, "views 4"]) -> Float[Tensor, "4 K"]:
        """fx, fy, cx, cy of each point's view."""
        if len(intrinsics) == 1:
            return intrinsics[0][:, None]
        views = [intrinsics[view][:, None].expand(-1, count) for view, _, count in self.groups]
        return torch.cat(views, 1) if views else intrinsics.new_zeros(4, 0)


@torch.no_grad()
def visible_points(
    geometry: SceneGeometry,
    face_ids: Int[Tensor, "views height width"],
    inverse_depth: Float[Tensor, "views height width"],
    Ts_camera_link: Float[Tensor, "views links 4 4"],
    intrinsics: Float[Tensor, "views 4"],
) -> VisiblePoints:
    """The surface point and the normal that each visible pixel sees."""
    if face_ids.device.type != "cpu":
        return visible_points_torch(geometry, face_ids, inverse_depth, Ts_camera_link, intrinsics)
    pixel, face, point, normal, counts = gather_points(
        face_ids.numpy(),
        inverse_depth.numpy(),
        Ts_camera_link.contiguous().numpy(),
        intrinsics.contiguous().numpy(),
        geometry.face_links.numpy(),
        geometry.face_barycentric.numpy(),
        geometry.face_normals.numpy(),
    )
    groups = _groups(counts, Ts_camera_link.shape[1])
    return VisiblePoints(
        torch.from_numpy(pixel), torch.from_numpy(face), groups, torch.from_numpy(point), torch.from_numpy(normal)
    )


def _groups(counts: list[int], links: int) -> tuple[tuple[int, int, int], ...]:
    return tuple((index // links, index % links, count) for index, count in enumerate(counts) if count)


@torch.no_grad()
def visible_points_torch(
    geometry: SceneGeometry,
    face_ids: Int[Tensor, "views height width"],
    inverse_depth: Float[Tensor, "views height width"],
    Ts_camera_link: Float[Tensor, "views links 4 4"],
    intrinsics: Float[Tensor, "views 4"],
) -> VisiblePoints:
    """The same without the compiled kernel, for any device."""
    views, height, width = face_ids.shape
    links = Ts_camera_link.shape[1]
    pixel = (face_ids.flatten() >= 0).nonzero()[:, 0]
    face = face_ids.flatten()[pixel].long()
    view = pixel // (height * width)
    key, order = (view * links + geometry.face_links[face]).int().sort(stable=True)
    pixel, face = pixel[order], face[order]
    view, link = key.long() // links, key.long() % links
    groups = _groups(torch.bincount(key, minlength=views * links).tolist(), links)
    fx, fy, cx, cy = intrinsics[view].T
    inside = pixel % (height * width)
    depth = 1.0 / inverse_depth.flatten()[pixel]
    x, y = ((inside % width) + 0.5 - cx) / fx, ((inside // width) + 0.5 - cy) / fy
    from_link = torch.stack([x * depth, y * depth, depth], 1) - Ts_camera_link[view, link, :3, 3]
    point_link = (Ts_camera_link[view, link, :3, :3].mT @ from_link[..., None])[..., 0].T
    maps = geometry.face_barycentric.index_select(1, face).view(2, 4, -1)
    # A pixel at the rim of its triangle may leave it by a rounding error.
    weight = ((maps[:, :3] * point_link).sum(1) + maps[:, 3]).clamp(0.0, 1.0)
    a, b, c = geometry.face_normals.index_select(1, face).view(3, 3, -1)
    normal = a + weight[0] * (b - a) + weight[1] * (c - a)
    return VisiblePoints(pixel, face, groups, point_link, unit(normal))
