"""Which point of which link does this pixel see? The compiled kernel for the CPU."""

import numba
import numpy as np
from jaxtyping import Float, Int


@numba.njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _affine(coefficients, point):
    """A barycentric coordinate of a point, in [0, 1]."""
    value = coefficients[0] * point[0] + coefficients[1] * point[1] + coefficients[2] * point[2] + coefficients[3]
    return min(max(value, 0.0), 1.0)


@numba.njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
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
