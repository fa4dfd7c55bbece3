"""What each pixel sees of the arms: the input of the deferred shader."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ...rendering import visibility
from .geometry import Body, Intrinsics, PosedRobot


@dataclass(frozen=True)
class GBuffer:
    """Surface points of the pixels that see an arm; n is their number."""

    size: tuple[int, int]
    """Width and height of the image [px]."""
    rows: Int[np.ndarray, " n"]
    columns: Int[np.ndarray, " n"]
    arm: Int[np.ndarray, " n"]
    part: Int[np.ndarray, " n"]
    """Index into `Robot.meshes`."""
    points: Float[np.ndarray, "n 3"]
    """In the camera's frame [m]."""
    normals: Float[np.ndarray, "n 3"]
    """Unit, towards the camera."""
    points_link: Float[np.ndarray, "n 3"]
    """In the frame of the link, for textures that move with it [m]."""

    def image(self, values: np.ndarray, empty: float = 0.0) -> np.ndarray:
        """Scatter per-pixel values [n, ...] into an image [height, width, ...]."""
        width, height = self.size
        image = np.full((height, width, *values.shape[1:]), empty, values.dtype)
        image[self.rows, self.columns] = values
        return image


def render_gbuffer(
    geometries: Sequence[Body],
    posed: Sequence[PosedRobot],
    intrinsics: Intrinsics,
    width: int,
    height: int,
) -> GBuffer:
    """Rasterise the arms with the same visibility kernel as the renderer; nothing else is shared with it."""
    vertices = np.concatenate([arm.vertices for arm in posed])
    normals = np.concatenate([arm.normals for arm in posed])
    link_points = np.concatenate([geometry.vertices for geometry in geometries])
    offsets = np.cumsum([0, *[len(geometry.vertices) for geometry in geometries[:-1]]])
    faces = np.concatenate([g.faces + offset for g, offset in zip(geometries, offsets, strict=True)]).astype(np.int32)
    face_part = np.concatenate([geometry.face_part for geometry in geometries])
    face_arm = np.repeat(np.arange(len(geometries)), [len(geometry.faces) for geometry in geometries])
    face_ids, depth = visibility(vertices, faces, intrinsics, width, height)
    rows, columns = np.nonzero(face_ids >= 0)
    face = face_ids[rows, columns]
    z = depth[rows, columns].astype(np.float32)
    fx, fy, cx, cy = intrinsics
    points = np.stack([(columns + 0.5 - cx) / fx * z, (rows + 0.5 - cy) / fy * z, z], axis=1).astype(np.float32)
    weights = _barycentric(points, vertices[faces[face]])
    corner = faces[face]
    normal = np.einsum("nk,nkc->nc", weights, normals[corner])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    away = _dot(normal, points) > 0
    normal[away] *= -1
    return GBuffer(
        (width, height), rows, columns, face_arm[face], face_part[face], points, normal.astype(np.float32),
        np.einsum("nk,nkc->nc", weights, link_points[corner]).astype(np.float32),
    )  # fmt: skip


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nc,nc->n", a, b)


def _barycentric(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Weights [n, 3] of points [n, 3] in the planes of triangles [n, 3, 3]."""
    a = triangles[:, 0]
    u, v, w = triangles[:, 1] - a, triangles[:, 2] - a, points - a
    uu, vv, uv = _dot(u, u), _dot(v, v), _dot(u, v)
    wu, wv = _dot(w, u), _dot(w, v)
    scale = 1.0 / np.maximum(uu * vv - uv * uv, 1e-24)
    s, t = (vv * wu - uv * wv) * scale, (uu * wv - uv * wu) * scale
    # Round-off on slivers must not extrapolate a normal.
    s, t = np.clip(s, 0, 1), np.clip(t, 0, 1)
    return np.stack([np.clip(1 - s - t, 0, 1), s, t], axis=1).astype(np.float32)
