"""Base frames, further cameras and focal lengths from points that a person has found in a few images."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import product

import numpy as np
from jaxtyping import Float
from scipy.optimize import OptimizeResult, least_squares

from ...model.scene import Scene
from .points import ImagePoint, views_of
from .problem import HandEyeProblem
from .result import HandEyeResult, result_of
from .settings import HandEyeSettings

_FOCAL_FACTORS = (1.0, 0.55, 0.75, 1.35, 1.8)
"""Of the given focal length: where a search for it begins."""
_COMBINED = 4
"""Most views with edges of which every combination of sides is tried."""
_STEPS = 60
"""Most steps from each beginning."""
_TOLERANCE = 1e-12
"""Relative change at which the search ends."""


def solve_hand_eye(
    scene: Scene,
    measured: Mapping[str, Float[np.ndarray, "frames dofs"]],
    points: Sequence[ImagePoint],
    settings: HandEyeSettings | None = None,
) -> HandEyeResult:
    """Find where the arms are before the cameras, from points in a few frames; no initial pose is needed.

    Minimizes Cauchy's loss of the distances in the image, each over `pixel_error`, from several beginnings by
    perspective-n-point. Which side of a shaft its edges are on is not given, so both are tried. Joint positions are
    taken as measured. Base frames move, and the cameras in `free_cameras`; where all cameras with points are among
    these, the one with most points keeps its pose.

    Args:
        scene: arms and cameras; its base frames are not used, those of arms without points stay.
        measured: arm -> joint positions of all frames [rad, m], as `Sequence.measured`.
        points: 3 to 6 frames with three or more points each are good; an arm needs 4 points in one camera.
        settings: what is free.

    Raises:
        SettingsError: no arm has enough points, all lie on each other, or a point names what is not there.
        RobotError: a point or `free_cameras` names an arm or a camera that does not exist.
    """
    settings = settings or HandEyeSettings()
    free = {scene.cameras.index(scene.camera(name)) for name in settings.free_cameras}
    views = views_of(scene, measured, points)
    best: tuple[float, HandEyeProblem, OptimizeResult] | None = None
    for factor in _FOCAL_FACTORS if settings.focal_length else (1.0,):
        problem = HandEyeProblem(scene, views, free, settings, factor)
        fit = _minimum(problem, problem.origin)
        if best is None or fit.cost < best[0]:
            best = (fit.cost, problem, fit)
    assert best is not None
    _, problem, fit = best
    for sides in _sides(problem):
        other = _minimum(problem, _minimum(problem, fit.x, sides).x)
        fit = min(fit, other, key=lambda found: found.cost)
    return result_of(problem, fit, len(points))


def _minimum(problem: HandEyeProblem, start: np.ndarray, sides: Sequence[int] | None = None) -> OptimizeResult:
    """A minimum near a start; `sides` as in `HandEyeProblem.distances`."""
    return least_squares(
        problem.residuals,
        start,
        jac="3-point",
        loss="cauchy",
        f_scale=2.0,
        x_scale="jac",
        ftol=_TOLERANCE,
        xtol=_TOLERANCE,
        gtol=_TOLERANCE,
        max_nfev=_STEPS,
        args=(sides,),
    )


def _sides(problem: HandEyeProblem) -> Iterator[tuple[int, ...]]:
    """Sides of the shafts in all views: each combination of few views, and the same side in all of many."""
    choices = [(1, -1) if view.has_edges else (0,) for view in problem.views]
    if sum(len(choice) > 1 for choice in choices) <= _COMBINED:
        yield from (sides for sides in product(*choices) if any(sides))
        return
    for place in (0, -1):
        yield tuple(choice[place] for choice in choices)
