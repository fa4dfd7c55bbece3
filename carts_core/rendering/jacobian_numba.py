"""How surface maps change with the unknowns: the compiled kernel for the CPU."""

import numba
import numpy as np

_HALF = np.float32(0.5)


@numba.njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _move(pixel, begin, end, dT, dK, K, point, position, normal, left, top, width, height, velocity, turning):
    """Fill velocity [2, rows, columns] and turning [3, rows, columns] of one view where one link is seen."""
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


@numba.njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def _carry(maps, near, speed, down, right, out):
    """Add to `out` what the neighbours that many pixels down and right bring at that speed; see `motion.py`."""
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


@numba.njit(cache=True, nogil=True, fastmath=False, error_model="numpy")
def fill_jacobian(unknowns, runs, pixel, point, position, normal, dTs, dKs, Ks, maps, near, left, top, first, out):
    """Fill the derivative of a block of surface maps by some unknowns; see `jacobian.map_jacobian`.

    Args:
        unknowns [g]: which of the tangents' they are.
        runs [r, 4]: view, link, first point and one past the last one, of each link that is seen in a view.
        pixel [K], point, position, normal [3, K]: of visible points: index into the maps, where it is in its link's
            frame and in the camera's [m], and the normal in its link's frame, towards the camera.
        dTs [unknowns, views, links, 4, 4], dKs [unknowns, views, 4]: tangents.
        Ks [views, 4]: intrinsics [px].
        maps [views, channels, height, width], near [views, height, width]: surface maps and inverse depth [1/m].
        left, top: of the block [px].
        first: channel of the normal.
        out [g, views, channels, rows, columns]: zeros.
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
