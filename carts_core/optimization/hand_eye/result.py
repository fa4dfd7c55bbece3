"""Where arms are according to points, and how far that can be relied on."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import OptimizeResult
from scipy.spatial.transform import Rotation

from ...errors import SettingsError
from ...model.scene import Scene
from .points import View
from .problem import HandEyeProblem, place_of

_OUTLIER = 4.0
"""Points that are further off than this many expected errors are said to contradict the others."""
_SINGULAR = 1e-12
"""Relative to the largest, an eigenvalue of the curvature that says nothing."""
_TURN, _SIDEWAYS = slice(0, 3), slice(3, 5)
"""Of a turn and a shift in a camera's frame."""


@dataclass(frozen=True)
class PoseDeviation:
    """Standard deviations of an arm's pose before a camera, at the middle of its points."""

    rotation_deg: float
    """[deg], of the worst direction."""
    sideways_mm: float
    """Across the camera's view [mm], of the worst direction."""
    depth_mm: float
    """Along the camera's view [mm]."""

    @staticmethod
    def of(covariance: Float[np.ndarray, "6 6"]) -> "PoseDeviation":
        """The deviations of a turn and a shift in the camera's frame.

        Args:
            covariance: of both [rad, m].
        """
        turn, sideways = (max(np.linalg.eigvalsh(covariance[part, part])[-1], 0.0) for part in (_TURN, _SIDEWAYS))
        return PoseDeviation(
            rotation_deg=float(np.degrees(np.sqrt(turn))),
            sideways_mm=float(1e3 * np.sqrt(sideways)),
            depth_mm=float(1e3 * np.sqrt(max(covariance[5, 5], 0.0))),
        )


@dataclass(frozen=True, eq=False)
class HandEyeResult:
    """Where the arms are according to the points."""

    scene: Scene
    """As given, with the base frames, camera poses and focal lengths that were found."""
    distances: Float[np.ndarray, " points"]
    """From each given point to where the landmark is now seen [px]; NaN for points that were not used."""
    deviations: Mapping[tuple[str, str], PoseDeviation]
    """(arm, camera) -> how well the arm's pose before that camera is known."""
    base_covariances: Mapping[str, Float[np.ndarray, "6 6"]]
    """Arm -> covariance of the turn and shift of its base frame in its own axes [rad, m]."""
    focal_deviation: Mapping[str, float]
    """Camera -> standard deviation of its focal length as a share of it; empty unless it was solved for."""
    contradicting: tuple[int, ...]
    """Which of the given points do not agree with the others and hardly count."""
    noise: float
    """Standard deviation of a point in each direction [px]: as expected, or larger where the points differ by more."""
    missing: Mapping[tuple[str, str], int] = field(default_factory=dict)
    """(arm, camera) -> how many more points are needed for it, where it stays as it was."""

    @property
    def error(self) -> float:
        """Root mean square of the distances of points that agree [px]."""
        good = np.setdiff1d(np.flatnonzero(np.isfinite(self.distances)), self.contradicting)
        return float(np.sqrt((self.distances[good] ** 2).mean())) if len(good) else float("nan")


def result_of(problem: HandEyeProblem, fit: OptimizeResult, count: int) -> HandEyeResult:
    """What a minimum says.

    Raises:
        SettingsError: the points leave something open.
    """
    bases, cameras, intrinsics = problem.poses(fit.x)
    distances = np.full(count, np.nan)
    for view, found in zip(problem.views, problem.distances(fit.x), strict=True):
        distances[list(view.rows)] = np.linalg.norm(found, axis=-1)
    excess = _excess(problem, fit)
    covariance = excess * _inverse_curvature(fit)
    names = [camera.name for camera in problem.scene.cameras]
    arms = [arm.name for arm in problem.scene.arms]
    start = len(fit.x) - len(problem.focal)
    return HandEyeResult(
        scene=_filled(problem, bases, cameras, intrinsics),
        distances=distances,
        deviations={
            (arms[view.arm], names[view.camera]): _deviation(problem, view, fit.x, covariance) for view in problem.views
        },
        base_covariances={arms[arm]: _base_covariance(problem, arm, fit.x, covariance) for arm in bases},
        focal_deviation={
            names[camera]: float(np.sqrt(covariance[start + place, start + place]))
            for place, camera in enumerate(problem.focal)
        },
        contradicting=tuple(np.flatnonzero(distances > _OUTLIER * problem.settings.pixel_error).tolist()),
        noise=_noise(problem, fit, excess),
        missing={(arms[arm], names[camera]): more for (camera, arm), more in problem.missing.items()},
    )


def _excess(problem: HandEyeProblem, fit: OptimizeResult) -> float:
    """Variance of the points over the expected one [1], at least 1."""
    return max(2.0 * fit.cost / _spare(problem, fit), 1.0)


def _spare(problem: HandEyeProblem, fit: OptimizeResult) -> int:
    """Degrees of freedom of the residuals, at least 1."""
    return max(sum(2 if point else 1 for view in problem.views for point in view.is_point) - len(fit.x), 1)


def _noise(problem: HandEyeProblem, fit: OptimizeResult, excess: float) -> float:
    """Standard deviation of a point in each direction [px].

    Distances of points are Rayleigh distributed, whose median wrong points hardly change; Cauchy's loss alone
    underestimates noise that is larger than expected.
    """
    points = [
        np.linalg.norm(found[view.is_point], axis=-1)
        for view, found in zip(problem.views, problem.distances(fit.x), strict=True)
    ]
    spare = _spare(problem, fit)
    typical = float(np.median(np.concatenate(points))) / np.sqrt(2.0 * np.log(2.0))
    return float(max(problem.settings.pixel_error * np.sqrt(excess), typical * np.sqrt(1.0 + len(fit.x) / spare)))


def _inverse_curvature(fit: OptimizeResult) -> np.ndarray:
    """Covariance of the unknowns for points as exact as expected."""
    information = fit.jac.T @ fit.jac
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if values[0] < _SINGULAR:
        raise SettingsError("the points leave a direction open. Click others, in frames where the arm is elsewhere.")
    return (vectors / values) @ vectors.T / np.outer(scale, scale)


def _base_covariance(
    problem: HandEyeProblem, arm: int, values: np.ndarray, covariance: np.ndarray
) -> Float[np.ndarray, "6 6"]:
    """Covariance of an arm's base frame in its own axes [rad, m], from that of the unknowns."""
    T_base_world = np.linalg.inv(problem.poses(values)[0][arm])

    def step(at: np.ndarray) -> np.ndarray:
        T = T_base_world @ problem.poses(at)[0][arm]
        return np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]])

    J = _differences(step, values)
    return J @ covariance @ J.T


def _deviation(problem: HandEyeProblem, view: View, values: np.ndarray, covariance: np.ndarray) -> PoseDeviation:
    """How uncertain turn and place of an arm are as this camera sees it."""

    def seen(step: np.ndarray) -> np.ndarray:
        bases, cameras, _ = problem.poses(step)
        T = cameras[view.camera] @ bases[view.arm]
        turn = Rotation.from_matrix(T[:3, :3] @ T_now[:3, :3].T).as_rotvec()
        return np.concatenate([turn, place_of(T, problem.middles[view.arm])])

    bases, cameras, _ = problem.poses(values)
    T_now = cameras[view.camera] @ bases[view.arm]
    J = _differences(seen, values)
    return PoseDeviation.of(J @ covariance @ J.T)


def _filled(
    problem: HandEyeProblem, bases: dict[int, np.ndarray], cameras: dict[int, np.ndarray], intrinsics: np.ndarray
) -> Scene:
    scene = problem.scene
    return replace(
        scene,
        arms=tuple(
            replace(arm, T_world_base=bases[index]) if index in bases else arm for index, arm in enumerate(scene.arms)
        ),
        cameras=tuple(
            replace(
                camera,
                T_camera_world=cameras[index],
                intrinsics=tuple(intrinsics[index].tolist()) if index in problem.focal else camera.intrinsics,
            )
            for index, camera in enumerate(scene.cameras)
        ),
    )


def _differences(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """The Jacobian by central differences."""
    columns = [(function(at + step * unit) - function(at - step * unit)) / (2 * step) for unit in np.eye(len(at))]
    return np.stack(columns, axis=1)
