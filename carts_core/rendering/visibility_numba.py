"""Which triangle does this pixel see? The compiled kernel for the CPU."""

from collections.abc import Sequence

import numba
import numpy as np
from jaxtyping import Float, Int

BACKGROUND = -1
"""Face index of a pixel that sees no triangle."""

NEAR = 1e-3
"""Depth of the near plane [m]; triangles that cross it are clipped, not dropped."""


@numba.njit(cache=True, nogil=True, fastmath=False)
def _fill_triangle(face, u, v, inverse_z, a, b, c, face_ids, inverse_depth):
    """Z-buffer one projected triangle (corners a, b, c of the polygon u, v with 1/z)."""
    height, width = face_ids.shape
    area = (u[b] - u[a]) * (v[c] - v[a]) - (u[c] - u[a]) * (v[b] - v[a])
    if area == 0.0:
        return
    # Only pixel centres (x + 0.5, y + 0.5) inside the bounding box can be covered.
    first_x = max(int(np.ceil(max(min(u[a], u[b], u[c]) - 0.5, 0.0))), 0)
    last_x = min(int(np.floor(min(max(u[a], u[b], u[c]) - 0.5, width - 1.0))), width - 1)
    first_y = max(int(np.ceil(max(min(v[a], v[b], v[c]) - 0.5, 0.0))), 0)
    last_y = min(int(np.floor(min(max(v[a], v[b], v[c]) - 0.5, height - 1.0))), height - 1)
    if first_x > last_x or first_y > last_y:
        return
    scale = 1.0 / area
    # Barycentric coordinates and 1/z are affine in the image, so they are walked by differences.
    w_b_dx = (v[c] - v[a]) * scale
    w_b_dy = -(u[c] - u[a]) * scale
    w_c_dx = -(v[b] - v[a]) * scale
    w_c_dy = (u[b] - u[a]) * scale
    z_dx = w_b_dx * (inverse_z[b] - inverse_z[a]) + w_c_dx * (inverse_z[c] - inverse_z[a])
    x0 = first_x + 0.5 - u[a]
    for y in range(first_y, last_y + 1):
        dy = y + 0.5 - v[a]
        w_b = w_b_dx * x0 + w_b_dy * dy
        w_c = w_c_dx * x0 + w_c_dy * dy
        z = inverse_z[a] + w_b * (inverse_z[b] - inverse_z[a]) + w_c * (inverse_z[c] - inverse_z[a])
        for x in range(first_x, last_x + 1):
            if w_b >= 0.0 and w_c >= 0.0 and w_b + w_c <= 1.0 and z > inverse_depth[y, x]:
                inverse_depth[y, x] = z
                face_ids[y, x] = face
            w_b += w_b_dx
            w_c += w_c_dx
            z += z_dx


@numba.njit(cache=True, nogil=True, fastmath=False)
def _rasterize(vertices, faces, fx, fy, cx, cy, face_ids, inverse_depth):
    u, v, inverse_z = np.empty(4), np.empty(4), np.empty(4)
    for face in range(faces.shape[0]):
        behind = 0
        for k in range(3):
            if vertices[faces[face, k], 2] < NEAR:
                behind += 1
        if behind == 3:
            continue
        corners = 0
        for k in range(3):
            p = vertices[faces[face, k]]
            if p[2] >= NEAR:
                inverse_z[corners] = 1.0 / p[2]
                u[corners] = fx * p[0] * inverse_z[corners] + cx
                v[corners] = fy * p[1] * inverse_z[corners] + cy
                corners += 1
            if behind > 0:
                # An edge that crosses the near plane adds the crossing as a corner (Sutherland-Hodgman).
                q = vertices[faces[face, (k + 1) % 3]]
                if (p[2] >= NEAR) != (q[2] >= NEAR):
                    t = (NEAR - p[2]) / (q[2] - p[2])
                    inverse_z[corners] = 1.0 / NEAR
                    u[corners] = fx * (p[0] + t * (q[0] - p[0])) / NEAR + cx
                    v[corners] = fy * (p[1] + t * (q[1] - p[1])) / NEAR + cy
                    corners += 1
        _fill_triangle(face, u, v, inverse_z, 0, 1, 2, face_ids, inverse_depth)
        if corners == 4:
            _fill_triangle(face, u, v, inverse_z, 0, 2, 3, face_ids, inverse_depth)


def rasterize(
    vertices_camera: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    intrinsics: Sequence[float],
    width: int,
    height: int,
) -> tuple[Int[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """The nearest triangle at every pixel centre, and the inverse of its depth.

    Args:
        vertices_camera: in the camera's frame [m].
        faces: vertex indices.
        intrinsics: fx, fy, cx, cy [px].
        width, height: size of the image [px].

    Returns:
        `face_ids` (int32, `BACKGROUND` where nothing is seen) and `inverse_depth` (float32, [1/m], 0 there).
    """
    face_ids = np.full((height, width), BACKGROUND, np.int32)
    inverse_depth = np.zeros((height, width), np.float32)
    vertices = np.ascontiguousarray(vertices_camera, np.float64)
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    _rasterize(vertices, np.ascontiguousarray(faces, np.int32), fx, fy, cx, cy, face_ids, inverse_depth)
    return face_ids, inverse_depth


def visibility_numba(
    vertices_camera: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    intrinsics: Sequence[float],
    width: int,
    height: int,
) -> tuple[Int[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """The nearest triangle at every pixel centre, and its depth [m], 0 where nothing is seen; see `rasterize`."""
    face_ids, inverse_depth = rasterize(vertices_camera, faces, intrinsics, width, height)
    depth = np.zeros_like(inverse_depth)
    np.divide(1.0, inverse_depth, out=depth, where=face_ids >= 0)
    return face_ids, depth
