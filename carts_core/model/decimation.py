"""Mesh decimation with a bound on the surface distance.

Decimation runs in a child process with limited CPU time, since the library ignores signals and takes more than ten
minutes for some meshes, such as 300,000 random triangles.
"""

import numpy as np
from jaxtyping import Float, Int

from ..files.decoding import DecodingLimitError, Limits, called
from ..files.reading import GIB

LIBRARIES = {"fewest_triangles": ("fast_simplification", "scipy.spatial")}
"""Function -> modules to import before the memory limit applies."""
_SECONDS = 12.0
"""Constant part of the CPU time limit [s]."""
_SECONDS_PER_FACE = 1e-4
"""CPU time limit per triangle [s], about five times the time for instrument meshes."""
_MEMORY = 2 * GIB
_FEWER = 0.6
"""Number of triangles of a trial, relative to the previous trial [1]."""
_FEWEST = 8
_CARE = 2
"""Aggressiveness of the library, 0 to 10; with the default of 7, surfaces deviate ten times as much."""
_SAMPLES = 20_000
"""Number of points on a surface at which the distance to the other surface is measured."""
_NEIGHBOURS = (6, 60)
"""Number of nearest samples of the other surface whose triangles are tested, for each point and for the worst
points."""
_WORST, _AT_ONCE = 2_000, 16
_SEED = 1


class DecimationError(Exception):
    """Decimation of a mesh failed, or exceeded its time or memory limit."""


def decimated(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], tolerance: float
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"], float]:
    """Decimate a mesh as far as a tolerance allows; returns vertices, faces and the maximum deviation [m].

    Args:
        vertices: mesh vertices [m].
        tolerance: maximum distance of points of either surface from the other [m].

    Raises:
        DecimationError: decimation takes too long or too much memory, or fails.
    """
    limits = Limits(_SECONDS + _SECONDS_PER_FACE * len(faces), _MEMORY)
    try:
        return called(fewest_triangles, vertices, faces, tolerance, limits=limits)
    except DecodingLimitError as error:
        raise DecimationError(f"it was not simplified within {limits.seconds:.0f} s: {error}") from error
    except (OSError, ValueError) as error:
        raise DecimationError("it cannot be simplified") from error


def deviation(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    other_vertices: Float[np.ndarray, "W 3"],
    other_faces: Int[np.ndarray, "G 3"],
    tolerance: float | None = None,
) -> float:
    """Symmetric Hausdorff distance of two surfaces [m], measured at samples.

    With a tolerance, the computation is faster: a result within the tolerance is an upper bound, and a larger result is
    a lower bound.
    """
    first, second = vertices[faces], other_vertices[other_faces]
    moved = _farthest(first, second, tolerance)
    if tolerance is not None and moved > tolerance:
        return moved
    return max(moved, _farthest(second, first, tolerance))


def _farthest(
    triangles: Float[np.ndarray, "F 3 3"], others: Float[np.ndarray, "G 3 3"], tolerance: float | None
) -> float:
    """Maximum distance of samples on `triangles` from the surface of `others` [m].

    The triangles of the nearest samples give upper bounds; for points with the largest bounds, all triangles are
    tested.
    """
    from scipy.spatial import KDTree  # noqa: PLC0415 - only the process that decimates needs it

    points, _ = _samples(triangles)
    near, owners = _samples(others)
    tree = KDTree(near)
    bounds = np.full(len(points), np.inf)
    chosen = np.arange(len(points))
    for count in _NEIGHBOURS:
        _, found = tree.query(points[chosen], k=min(count, len(near)), workers=1)
        for column in owners[found.reshape(len(chosen), -1)].T:
            bounds[chosen] = np.minimum(bounds[chosen], _distances(points[chosen], others[column]))
        chosen = np.argsort(bounds)[-_WORST:]
    farthest = 0.0
    for group in np.array_split(np.argsort(bounds)[::-1], max(1, len(points) // _AT_ONCE)):
        bound = float(bounds[group[0]])
        if bound <= farthest:
            break
        if tolerance is not None and bound <= tolerance:
            return bound
        if tolerance is not None and farthest > tolerance:
            break
        every = np.broadcast_to(others[None], (len(group), *others.shape)).reshape(-1, 3, 3)
        exact = _distances(np.repeat(points[group], len(others), axis=0), every).reshape(len(group), -1).min(1)
        farthest = max(farthest, float(exact.max()))
    return farthest


def _samples(triangles: Float[np.ndarray, "F 3 3"]) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Sample triangles at corners, centres, and further points by area; returns the points and the triangle of each."""
    count = len(triangles)
    a, b, c = triangles.swapaxes(0, 1)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    rng = np.random.default_rng(_SEED)
    every = np.arange(count)
    shares = areas / max(areas.sum(), 1e-30)
    drawn = rng.choice(count, _SAMPLES, p=shares / shares.sum()) if areas.sum() > 0 else every[:0]
    weights = rng.dirichlet((1.0, 1.0, 1.0), len(drawn))
    further = np.einsum("nk,nkd->nd", weights, triangles[drawn])
    points = np.concatenate([triangles.reshape(-1, 3), triangles.mean(1), further])
    return points, np.concatenate([np.repeat(every, 3), every, drawn])


def _distances(points: Float[np.ndarray, "n 3"], triangles: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """Distance of each point from its triangle (Ericson, Real-Time Collision Detection, 5.1.5)."""
    a, b, c = triangles.swapaxes(0, 1)
    best = np.minimum(_to_segments(points, a, b), np.minimum(_to_segments(points, b, c), _to_segments(points, c, a)))
    u, v, w = b - a, c - a, points - a
    normal = np.cross(u, v)
    square = np.einsum("nd,nd->n", normal, normal)
    proper = square > 0
    scale = np.where(proper, square, 1.0)
    s = np.einsum("nd,nd->n", np.cross(w, v), normal) / scale
    t = np.einsum("nd,nd->n", np.cross(u, w), normal) / scale
    inside = proper & (s >= 0) & (t >= 0) & (s + t <= 1)
    height = np.abs(np.einsum("nd,nd->n", w, normal)) / np.sqrt(scale)
    return np.where(inside, np.minimum(height, best), best)


def _to_segments(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> Float[np.ndarray, " n"]:
    along = b - a
    square = np.einsum("nd,nd->n", along, along)
    share = np.clip(np.einsum("nd,nd->n", points - a, along) / np.where(square > 0, square, 1.0), 0.0, 1.0)
    return np.linalg.norm(points - a - share[:, None] * along, axis=1)


def fewest_triangles(vertices: np.ndarray, faces: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Find the mesh with the fewest triangles within a tolerance [m]; returns vertices, triangles and deviation [m].

    The number of triangles is reduced step by step; the last mesh within the tolerance is returned.
    """
    import fast_simplification  # noqa: PLC0415 - only the process that decimates needs it

    kept = vertices, faces, 0.0
    count = len(faces) * _FEWER
    while count >= _FEWEST:
        points, triangles, *_ = fast_simplification.simplify(
            points=vertices, triangles=faces, target_count=int(count), agg=_CARE
        )
        if not len(triangles) or len(triangles) >= len(kept[1]):
            break
        moved = deviation(vertices, faces, points, triangles, tolerance)
        if not moved <= tolerance:
            break
        kept = points, triangles, moved
        count = min(count, len(triangles)) * _FEWER
    return kept
