"""Joint positions from manually placed keypoints, by bounded least squares."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ..errors import SettingsError
from ..model.keypoints import Pin, project_keypoints
from ..model.scene import Scene, SceneState
from ..settings import SurfaceSolver
from ..settings.ranges import Count, Positive, Ranged

_ROOM = 1e-12
"""Minimum distance of the start from a joint limit [rad]."""


@dataclass(frozen=True)
class KeypointSettings(Ranged):
    """Weights of pins and of the initial joint positions."""

    prior_deg: Positive = 10.0
    """Expected error of an initial joint position [deg]; `length_scale` converts it to metres."""
    pixel_error: Positive = 0.5
    """Expected error of a pin [px]."""
    length_scale: Positive = SurfaceSolver.length_scale
    """Translation equivalent to one radian [m]."""
    iterations: Count = 60
    """Maximum number of iterations [1]."""


@dataclass(frozen=True, eq=False)
class KeypointFit:
    """Result of fitting the arms to pins."""

    state: SceneState
    """State with NumPy arrays."""
    residuals: tuple[float, ...]
    """Distance of each pin from its keypoint [px]."""
    iterations: int


def fit_keypoints(
    scene: Scene, start: SceneState, pins: Sequence[Pin], settings: KeypointSettings | None = None
) -> KeypointFit:
    """Estimate the joint positions of pinned arms so that their keypoints coincide with the pins, within joint limits.

    Minimizes the sum of squares of the image distances and the joint motions, each divided by its expected error
    (`scipy.optimize.least_squares`). Directions not determined by pins stay near the start.

    Args:
        pins: one or more pins, in one or several cameras.

    Raises:
        SettingsError: there is no pin, or a keypoint starts behind its camera.
        RobotError: a pin names an arm or a camera that does not exist.
    """
    from scipy.optimize import least_squares  # noqa: PLC0415  takes 0.3 s

    if not pins:
        raise SettingsError("no keypoint is placed. Place at least one keypoint in the image.")
    settings = settings or KeypointSettings()
    names = [arm.name for arm in scene.arms]
    free = [names.index(scene.arm(name).name) for name in dict.fromkeys(pin.keypoint.arm for pin in pins)]
    start = start.numpy().map(lambda values: values.astype(np.float64))
    joints = np.concatenate([start.joint_positions[arm] for arm in free])
    robots = [scene.arms[arm].robot for arm in free]
    kinds = [kind for robot in robots for kind in robot.joint_types]
    # The unknowns are offsets in radian-like units.
    scales = np.where([kind == "prismatic" for kind in kinds], settings.length_scale, 1.0)
    limits = np.concatenate([robot.joint_limits for robot in robots])
    ends = np.cumsum([len(robot.joint_names) for robot in robots])[:-1]
    by_camera: dict[str, list[int]] = {}
    for row, pin in enumerate(pins):
        by_camera.setdefault(pin.camera, []).append(row)
    wanted = np.array([pin.pixel for pin in pins])

    def state(offsets: Float[np.ndarray, " n"]) -> SceneState:
        moved = dict(zip(free, np.split(joints + scales * offsets, ends), strict=True))
        return replace(start, joint_positions=tuple(moved.get(i, q) for i, q in enumerate(start.joint_positions)))

    def distances(offsets: Float[np.ndarray, " n"]) -> Float[np.ndarray, "pins 2"]:
        found, at = np.empty_like(wanted), state(offsets)
        for camera, rows in by_camera.items():
            found[rows] = project_keypoints(scene, at, [pins[row].keypoint for row in rows], camera)
        return found - wanted

    def residuals(offsets: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
        prior = offsets / math.radians(settings.prior_deg)
        return np.concatenate([distances(offsets).ravel() / settings.pixel_error, prior])

    origin = np.zeros(len(joints))
    if not np.isfinite(residuals(origin)).all():
        raise SettingsError(
            "a keypoint is behind its camera. First move the arm in front of the camera with its sliders."
        )
    lower, upper = (limits - joints[:, None]).T / scales
    fit = least_squares(
        residuals,
        origin,
        # The method requires a start strictly inside the joint limits.
        bounds=(np.minimum(lower, -_ROOM), np.maximum(upper, _ROOM)),
        x_scale="jac",
        max_nfev=settings.iterations,
    )
    errors = np.linalg.norm(distances(fit.x), axis=-1)
    return KeypointFit(state(fit.x).map(np.float32), tuple(errors.tolist()), int(fit.nfev))
