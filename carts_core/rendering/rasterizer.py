"""Visibility: the nearest triangle at each pixel, computed by a compiled kernel."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from ..compiled import compiled

BACKGROUND = -1
"""Face index of a pixel without a triangle."""

NEAR = 1e-3
"""Depth of the near plane [m]; triangles that cross it are clipped, not dropped."""


_WIDE = 8
"""Width of a bounding box [px] from which the entry and exit of each row are computed."""


@compiled
def _first_and_last(value, slope, first, last):
    """First and last step from 0 to `last` at which `value + slope * step` may be positive, with a margin of one."""
    if slope > 0.0:
        first = max(first, int(min(-value / slope, last + 1.0)) - 1)
    elif slope < 0.0:
        last = min(last, int(max(-value / slope, -2.0)) + 1)
    elif value < 0.0:
        last = -1
    return first, last


@compiled
def _fill_triangle(face, u, v, inverse_z, a, b, c, two_sided, face_ids, inverse_depth):
    """Z-buffer one projected triangle (corners a, b, c of the points u, v with 1/z); its back only if two-sided."""
    area = (u[b] - u[a]) * (v[c] - v[a]) - (u[c] - u[a]) * (v[b] - v[a])
    # The image's y axis points down, so counterclockwise corners span a negative area.
    if area == 0.0 or (area > 0.0 and not two_sided):
        return
    height, width = face_ids.shape
    # Only pixel centres (x + 0.5, y + 0.5) inside the bounding box can be covered.
    first_x = max(int(np.ceil(max(min(u[a], u[b], u[c]) - 0.5, 0.0))), 0)
    last_x = min(int(np.floor(min(max(u[a], u[b], u[c]) - 0.5, width - 1.0))), width - 1)
    first_y = max(int(np.ceil(max(min(v[a], v[b], v[c]) - 0.5, 0.0))), 0)
    last_y = min(int(np.floor(min(max(v[a], v[b], v[c]) - 0.5, height - 1.0))), height - 1)
    if first_x > last_x or first_y > last_y:
        return
    scale = 1.0 / area
    # Barycentric coordinates and 1/z are affine in the image.
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
        first, last = 0, last_x - first_x
        if last >= _WIDE:
            first, last = _first_and_last(w_b, w_b_dx, first, last)
            first, last = _first_and_last(w_c, w_c_dx, first, last)
            first, last = _first_and_last(1.0 - w_b - w_c, -w_b_dx - w_c_dx, first, last)
        for step in range(first, last + 1):
            w_b_here, w_c_here, z_here = w_b + step * w_b_dx, w_c + step * w_c_dx, z + step * z_dx
            x = first_x + step
            if w_b_here >= 0.0 and w_c_here >= 0.0 and w_b_here + w_c_here <= 1.0 and z_here > inverse_depth[y, x]:
                inverse_depth[y, x] = z_here
                face_ids[y, x] = face


@compiled
def _clip(corners, inverse_z, vertices, fx, fy, cx, cy, clipped_u, clipped_v, clipped_inverse_z):
    """Clip a triangle at the near plane (Sutherland-Hodgman); returns the number of remaining corners, 0, 3 or 4."""
    count = 0
    for k in range(3):
        here, there = corners[k], corners[(k + 1) % 3]
        p, q = vertices[here], vertices[there]
        if inverse_z[here] > 0.0:
            clipped_inverse_z[count] = inverse_z[here]
            clipped_u[count] = fx * p[0] * inverse_z[here] + cx
            clipped_v[count] = fy * p[1] * inverse_z[here] + cy
            count += 1
        if (inverse_z[here] > 0.0) != (inverse_z[there] > 0.0):
            t = (NEAR - p[2]) / (q[2] - p[2])
            clipped_inverse_z[count] = 1.0 / NEAR
            clipped_u[count] = fx * (p[0] + t * (q[0] - p[0])) / NEAR + cx
            clipped_v[count] = fy * (p[1] + t * (q[1] - p[1])) / NEAR + cy
            count += 1
    return count


@compiled
def _opened(vertices, faces, surfaces, closed, inverse_z, fx, fy, cx, cy, width, height):
    """Whether the near plane may cut each closed surface open within the image, from the bounds of the cut."""
    u, v, inverse_near = np.empty(4), np.empty(4), np.empty(4)
    low, high = np.full((closed, 2), np.inf), np.full((closed, 2), -np.inf)
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        surface = surfaces[face]
        in_front = int(inverse_z[a] > 0.0) + int(inverse_z[b] > 0.0) + int(inverse_z[c] > 0.0)
        if surface < 0 or not 0 < in_front < 3:
            continue
        corners = _clip(faces[face], inverse_z, vertices, fx, fy, cx, cy, u, v, inverse_near)
        for k in range(corners):
            if inverse_near[k] == 1.0 / NEAR:
                low[surface, 0], high[surface, 0] = min(low[surface, 0], u[k]), max(high[surface, 0], u[k])
                low[surface, 1], high[surface, 1] = min(low[surface, 1], v[k]), max(high[surface, 1], v[k])
    return (low[:, 0] <= width) & (high[:, 0] >= 0.0) & (low[:, 1] <= height) & (high[:, 1] >= 0.0)


@compiled
def _rasterize(vertices, faces, surfaces, closed, fx, fy, cx, cy, face_ids, inverse_depth):
    count = vertices.shape[0]
    u, v, inverse_z = np.zeros(count), np.zeros(count), np.zeros(count)
    for index in range(count):
        z = vertices[index, 2]
        if z >= NEAR:  # nearer vertices keep an inverse depth of 0
            inverse_z[index] = 1.0 / z
            u[index] = fx * vertices[index, 0] * inverse_z[index] + cx
            v[index] = fy * vertices[index, 1] * inverse_z[index] + cy
    height, width = face_ids.shape
    opened = _opened(vertices, faces, surfaces, closed, inverse_z, fx, fy, cx, cy, width, height)
    clipped_u, clipped_v, clipped_inverse_z = np.empty(4), np.empty(4), np.empty(4)
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        two_sided = surfaces[face] < 0 or opened[surfaces[face]]
        if inverse_z[a] > 0.0 and inverse_z[b] > 0.0 and inverse_z[c] > 0.0:
            _fill_triangle(face, u, v, inverse_z, a, b, c, two_sided, face_ids, inverse_depth)
            continue
        if inverse_z[a] <= 0.0 and inverse_z[b] <= 0.0 and inverse_z[c] <= 0.0:
            continue
        corners = _clip(faces[face], inverse_z, vertices, fx, fy, cx, cy, clipped_u, clipped_v, clipped_inverse_z)
        for last in range(2, corners):
            _fill_triangle(
                face, clipped_u, clipped_v, clipped_inverse_z, 0, last - 1, last, two_sided, face_ids, inverse_depth
            )


def rasterize(
    vertices_camera: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    intrinsics: Sequence[float],
    width: int,
    height: int,
    surfaces: Int[np.ndarray, " F"] | None = None,
) -> tuple[Int[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """The nearest triangle at every pixel centre, and the inverse of its depth.

    Args:
        vertices_camera: vertices in the camera's frame [m].
        intrinsics: fx, fy, cx, cy [px].
        width, height: size of the image [px].
        surfaces: index of the closed surface of each triangle, -1 for none (the default). Its corners are
            counterclockwise seen from outside. Unless the near plane cuts a surface open within the image, its front
            hides its back, and the back is skipped, which saves time and does not change the result.

    Returns:
        `face_ids` (int32, `BACKGROUND` without a triangle) and `inverse_depth` (float32, [1/m], 0 there).
    """
    face_ids = np.full((height, width), BACKGROUND, np.int32)
    inverse_depth = np.zeros((height, width), np.float32)
    vertices = np.ascontiguousarray(vertices_camera, np.float64)
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    if surfaces is None:
        surfaces = np.full(len(faces), -1)
    closed = int(surfaces.max(initial=-1)) + 1
    _rasterize(
        vertices, np.ascontiguousarray(faces, np.int32), surfaces, closed, fx, fy, cx, cy, face_ids, inverse_depth
    )
    return face_ids, inverse_depth


def visibility(
    vertices_camera: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    intrinsics: Sequence[float],
    width: int,
    height: int,
) -> tuple[Int[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """The nearest triangle at every pixel centre, and its depth [m], 0 without a triangle; see `rasterize`."""
    face_ids, inverse_depth = rasterize(vertices_camera, faces, intrinsics, width, height)
    depth = np.zeros_like(inverse_depth)
    np.divide(1.0, inverse_depth, out=depth, where=face_ids >= 0)
    return face_ids, depth
