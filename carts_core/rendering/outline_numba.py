"""Outlines: the compiled kernels for the CPU; see `outline.py` for what they compute."""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
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
