"""Base frames, further cameras and focal lengths from points that a person has found in a few images."""

from collections.abc import Mapping, Sequence

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
    perspective-n-point. Joint positions are taken as measured. The first camera with points keeps its pose in the
    world; base frames move, and the cameras in `free_cameras`.

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
        fit = least_squares(
            problem.residuals,
            problem.origin,
            jac="3-point",
            loss="cauchy",
            f_scale=2.0,
            x_scale="jac",
            ftol=_TOLERANCE,
            xtol=_TOLERANCE,
            gtol=_TOLERANCE,
            max_nfev=_STEPS,
        )
        if best is None or fit.cost < best[0]:
            best = (fit.cost, problem, fit)
    assert best is not None
    return result_of(best[1], best[2], len(points))
