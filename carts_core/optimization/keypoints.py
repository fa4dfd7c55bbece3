"""Joint positions from points that a person has found in the image, by damped least squares."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import SettingsError
from ..keypoints import Keypoint, project_keypoints
from ..scene import Scene, SceneState
from ..settings import FreeParameters, OptimizerSettings
from .parameters import ParameterVector

_DAMPINGS = (1e-6, 1e8)
_ENOUGH = 1e-9
"""Smaller steps change nothing [rad]."""


@dataclass(frozen=True)
class Pin:
    """A keypoint, and where a person says that it is."""

    keypoint: Keypoint
    camera: str
    pixel: tuple[float, float]
    """Column and row in the camera's full-size image, pixel centres at 0.5 [px]."""


@dataclass(frozen=True)
class KeypointSettings:
    """How pins are weighed against where the joints were."""

    prior_deg: float = 10.0
    """Expected error of a joint at the start [deg]; a prismatic joint's is `lever` times as many metres."""
    pixel_error: float = 0.5
    """Expected error of a pin [px]."""
    lever: float = OptimizerSettings.lever
    """Metres of translation that count as one radian [m]."""
    iterations: int = 60
    """Largest number of steps [1]."""

    def __post_init__(self) -> None:
        for name in ("prior_deg", "pixel_error", "lever", "iterations"):
            if not getattr(self, name) > 0:
                raise SettingsError(f"{name} is {getattr(self, name)!r}; allowed is anything above 0.")


@dataclass(frozen=True, eq=False)
class KeypointFit:
    """Where the arms are according to the pins."""

    state: SceneState
    residuals: tuple[float, ...]
    """Distance of each pin from its keypoint [px]."""
    iterations: int


def fit_keypoints(
    scene: Scene, start: SceneState, pins: Sequence[Pin], settings: KeypointSettings | None = None
) -> KeypointFit:
    """Move the joints of the pinned arms so that their keypoints come to lie on the pins; joint limits hold.

    Minimizes the squared distances in the image and the squared joint motion, each over its expected error
    (Levenberg-Marquardt). So pins alone decide what they determine, and the rest stays near the start.

    Args:
        scene: arms and cameras.
        start: where the joints are expected to be.
        pins: one or more, also in several cameras.
        settings: weights and number of steps.

    Raises:
        SettingsError: there is no pin, or a keypoint starts behind its camera.
        RobotError: a pin names an arm or a camera that does not exist.
    """
    if not pins:
        raise SettingsError("there is no pin. Say of at least one keypoint where it is in the image.")
    settings = settings or KeypointSettings()
    arms = tuple(dict.fromkeys(pin.keypoint.arm for pin in pins))
    parameters = ParameterVector(scene, start.map(torch.Tensor.double), FreeParameters(arms=arms), settings.lever)
    # Only joints are free, and the unknowns are in radian-like units.
    weights = torch.full((len(parameters),), 1.0 / math.radians(settings.prior_deg), dtype=torch.float64)

    def distances(offsets: Float[Tensor, " n"]) -> Float[Tensor, "pins 2"]:
        return _distances(scene, parameters.state(offsets), pins)

    def residuals(offsets: Float[Tensor, " n"]) -> Float[Tensor, " m"]:
        return torch.cat([distances(offsets).flatten() / settings.pixel_error, offsets * weights])

    offsets = torch.zeros(len(parameters), dtype=torch.float64)
    value = residuals(offsets)
    if not value.isfinite().all():
        raise SettingsError("a keypoint is behind its camera. Move the arm before the camera by its sliders first.")
    damping, taken = 1e-3, 0
    while taken < settings.iterations:
        taken += 1
        jacobian = torch.autograd.functional.jacobian(residuals, offsets, vectorize=True)
        assert isinstance(jacobian, Tensor)
        moved, damping = _descend(residuals, parameters, offsets, value, jacobian, damping)
        if moved is None:
            break
        step, offsets = (moved - offsets).abs().max(), moved
        value = residuals(offsets)
        if step < _ENOUGH:
            break
    errors = distances(offsets).norm(dim=-1)
    return KeypointFit(parameters.state(offsets).map(torch.Tensor.float), tuple(errors.tolist()), taken)


def _distances(scene: Scene, state: SceneState, pins: Sequence[Pin]) -> Float[Tensor, "pins 2"]:
    by_camera: dict[str, list[int]] = {}
    for row, pin in enumerate(pins):
        by_camera.setdefault(pin.camera, []).append(row)
    found = state.intrinsics.new_zeros(len(pins), 2)
    for camera, rows in by_camera.items():
        points = [pins[row].keypoint for row in rows]
        wanted = state.intrinsics.new_tensor([pins[row].pixel for row in rows])
        found = found.index_put((torch.tensor(rows),), project_keypoints(scene, state, points, camera) - wanted)
    return found


def _descend(
    residuals, parameters: ParameterVector, offsets: Tensor, value: Tensor, jacobian: Tensor, damping: float
) -> tuple[Tensor | None, float]:
    """One step that makes the sum of squares smaller, None if there is none; and the damping to go on with."""
    gradient = jacobian.T @ value
    # A joint at its limit that the pins push further out is not free; the others must do without it.
    at_limit = ((offsets <= parameters.lower) & (gradient > 0)) | ((offsets >= parameters.upper) & (gradient < 0))
    free = ~at_limit
    if not free.any():
        return None, damping
    hessian = (jacobian.T @ jacobian)[free][:, free]
    while damping < _DAMPINGS[1]:
        step = torch.zeros_like(offsets)
        step[free] = torch.linalg.solve(hessian + damping * hessian.diagonal().diag(), -gradient[free])
        moved = parameters.clamp(offsets + step)
        if residuals(moved).square().sum() < value.square().sum():
            return moved, max(damping / 10, _DAMPINGS[0])
        damping *= 10
    return None, damping
