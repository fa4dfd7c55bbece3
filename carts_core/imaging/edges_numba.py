"""Where the edge beside each pixel of an outline is: the compiled kernel for the CPU."""

import numpy as np
from jaxtyping import Float, Int

from ..compiled import compiled


@compiled
def _nearest(gradient, camera, position, normal, samples, expected, sampling, distance, found):
    height, width, channels = gradient.shape[1:]
    half, last = channels // 2, len(samples) - 1
    strength = np.empty(len(samples), np.float32)
    for k in range(len(camera)):
        image = gradient[camera[k]]
        nx, ny = normal[0, k], normal[1, k]
        best = 0
        for s in range(len(samples)):
            x, y = position[0, k] + nx * samples[s], position[1, k] + ny * samples[s]
            # Beyond the image there is no change of colour.
            if not (x >= 0.0 and y >= 0.0 and x <= width - 1.0 and y <= height - 1.0):
                strength[s] = 0.0
            else:
                column, row = min(int(x), width - 2), min(int(y), height - 2)
                u, v = x - np.float32(column), y - np.float32(row)
                upper, lower = image[row], image[row + 1]
                squared = np.float32(0.0)
                for c in range(half):
                    right_above = upper[column, c] + u * (upper[column + 1, c] - upper[column, c])
                    right_below = lower[column, c] + u * (lower[column + 1, c] - lower[column, c])
                    d = half + c
                    down_above = upper[column, d] + u * (upper[column + 1, d] - upper[column, d])
                    down_below = lower[column, d] + u * (lower[column + 1, d] - lower[column, d])
                    along = nx * (right_above + v * (right_below - right_above))
                    along += ny * (down_above + v * (down_below - down_above))
                    squared += along * along
                strength[s] = squared * expected[s]
            if strength[s] > strength[best]:
                best = s
        middle = min(max(best, 1), last - 1)
        before, peak, after = strength[middle - 1], strength[middle], strength[middle + 1]
        finer = np.float32(0.5) * (after - before) / max(np.float32(2.0) * peak - before - after, np.float32(1e-12))
        distance[k] = samples[middle] + sampling * min(max(finer, np.float32(-0.5)), np.float32(0.5))
        # The strongest one at either end is the flank of an edge further away.
        found[k] = 1.0 if 0 < best < last else 0.0


def nearest_edges(
    gradient: Float[np.ndarray, "cameras height width 6"],
    camera: Int[np.ndarray, " K"],
    position: Float[np.ndarray, "2 K"],
    normal: Float[np.ndarray, "2 K"],
    samples: Float[np.ndarray, " samples"],
    expected: Float[np.ndarray, " samples"],
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
    """Distance to the strongest edge along the outward normal [px], and 1 where there is one, 0 elsewhere.

    Args:
        gradient: of the images' three colours, to the right and then down [1/px].
        camera: of each pixel of the outline.
        position: where the outline is [px].
        normal: unit vectors, outwards.
        samples: distances at which edges are looked for, evenly spaced, at least three [px].
        expected: what each of them counts [1].
    """
    distance, found = (np.empty(len(camera), np.float32) for _ in range(2))
    sampling = samples[1] - samples[0]
    _nearest(gradient, camera, position, normal, samples, expected, sampling, distance, found)
    return distance, found
