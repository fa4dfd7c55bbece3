"""Joint positions from manually placed keypoints, by bounded least squares."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from torch import Tensor

from ..errors import SettingsError
from ..model.keypoints import Keypoint, project_keypoints
from ..model.scene import Scene, SceneState
from ..settings import FreeParameters, SurfaceSolver
from ..settings.ranges import Count, Positive, Ranged
from .variables import Variables

_ROOM = 1e-12
"""Minimum distance of the start from a joint limit [rad]."""


@dataclass(frozen=True)
class Pin:
    """A keypoint with its manually set position in an image."""

    keypoint: Keypoint
    camera: str
    pixel: tuple[float, float]
    """Column and row in the camera's full-size image, pixel centres at 0.5 [px]."""


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
    residuals: tuple[float, ...]
    """Distance of each pin from its keypoint [px]."""
    iterations: int


def fit_keypoints(
    scene: Scene, start: SceneState, pins: Sequence[Pin], settings: KeypointSettings | None = None
) -> KeypointFit:
    """Estimate the joint positions of pinned arms so that their keypoints coincide with the pins, within joint limits.

    Minimizes the squared distances in the image and the squared joint motion, each over its expected error
    (`scipy.optimize.least_squares`). Directions not determined by pins stay near the start.

    Args:
        pins: one or more pins, in one or several cameras.

    Raises:
        SettingsError: there is no pin, or a keypoint starts behind its camera.
        RobotError: a pin names an arm or a camera that does not exist.
    """
    if not pins:
        raise SettingsError("no keypoint is placed. Place at least one keypoint in the image.")
    settings = settings or KeypointSettings()
    arms = tuple(dict.fromkeys(pin.keypoint.arm for pin in pins))
    variables = Variables(scene, start.map(torch.Tensor.double), FreeParameters(arms=arms), settings.length_scale)
    # Only joints are free, and the unknowns are in radian-like units.
    weight = 1.0 / math.radians(settings.prior_deg)
    by_camera: dict[str, list[int]] = {}
    for row, pin in enumerate(pins):
        by_camera.setdefault(pin.camera, []).append(row)

    def distances(offsets: Float[Tensor, " n"]) -> Float[Tensor, "pins 2"]:
        state, found = variables.state(offsets), offsets.new_zeros(len(pins), 2)
        for camera, rows in by_camera.items():
            points = [pins[row].keypoint for row in rows]
            wanted = offsets.new_tensor([pins[row].pixel for row in rows])
            found = found.index_put((torch.tensor(rows),), project_keypoints(scene, state, points, camera) - wanted)
        return found

    def residuals(offsets: Float[Tensor, " n"]) -> Float[Tensor, " m"]:
        return torch.cat([distances(offsets).flatten() / settings.pixel_error, weight * offsets])

    def jacobian(offsets: np.ndarray) -> np.ndarray:
        found = torch.autograd.functional.jacobian(residuals, torch.from_numpy(offsets), vectorize=True)
        assert isinstance(found, Tensor)
        return found.numpy()

    origin = torch.zeros(len(variables), dtype=torch.float64)
    if not residuals(origin).isfinite().all():
        raise SettingsError(
            "a keypoint is behind its camera. First move the arm in front of the camera with its sliders."
        )
    fit = least_squares(
        lambda offsets: residuals(torch.from_numpy(offsets)).numpy(),
        origin.numpy(),
        jac=jacobian,  # pyright: ignore[reportArgumentType]
        # The method requires a start strictly inside the joint limits.
        bounds=(
            np.minimum(variables.lower.double().numpy(), -_ROOM),
            np.maximum(variables.upper.double().numpy(), _ROOM),
        ),
        x_scale="jac",
        max_nfev=settings.iterations,
    )
    offsets = torch.from_numpy(fit.x)
    errors = distances(offsets).norm(dim=-1)
    return KeypointFit(variables.state(offsets).map(torch.Tensor.float), tuple(errors.tolist()), int(fit.nfev))
