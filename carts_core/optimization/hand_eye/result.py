"""Solver of hand-eye calibration, its result with standard deviations, and tests of later calibrations against the
points."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from jaxtyping import Float
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from ...errors import SettingsError
from ...model.keypoints import LandmarkKind
from ...model.scene import Scene
from ...settings import SurfaceSolver
from ..results import PoseDeviation
from .problem import HandEyeProblem, HandEyeSettings, ImagePoint, View, transform_point, views_of

_OUTLIER = 4.0
"""Multiple of the expected error beyond which a point contradicts the others [1]."""
_FEW_POINTS = 6
"""Number of points of an arm below which several poses can fit equally well."""
_SINGULAR = 1e-12
"""Eigenvalue of the scaled curvature below which a direction is undetermined [1]."""


@dataclass(frozen=True, eq=False)
class HandEyeResult:
    """Result of hand-eye calibration."""

    scene: Scene
    """The given scene with estimated base frames, camera poses and focal lengths."""
    distances: Float[np.ndarray, " points"]
    """Distance of each point from its projected landmark [px]; NaN for unused points."""
    deviations: Mapping[tuple[str, str], PoseDeviation]
    """(arm, camera) -> standard deviations of the arm's pose relative to that camera."""
    base_covariances: Mapping[str, Float[np.ndarray, "6 6"]]
    """Arm -> covariance of rotation and translation of its base frame in its own axes [rad, m]."""
    focal_deviation: Mapping[str, float]
    """Camera -> relative standard deviation of its focal length [1]; empty unless it was estimated."""
    contradicting: tuple[int, ...]
    """Indices of outliers, which have little weight."""
    noise: float
    """Standard deviation of a point per axis [px]: the expected value, or the estimate from the residuals if that is
    larger."""
    missing: Mapping[tuple[str, str], int] = field(default_factory=dict)
    """(arm, camera) -> number of missing points, for poses that could not be estimated."""
    ambiguous: tuple[tuple[str, str], ...] = ()
    """(arm, camera) of base frames from so few points, or points of so few landmarks, that another pose can fit
    equally well."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about ambiguous base frames, as text for the user."""
        return tuple(
            f"{arm} in {camera}: another pose, beyond the standard deviations, can fit these points equally well. "
            "Click the tip and the wrist joints in three or more frames."
            for arm, camera in self.ambiguous
        )

    @property
    def error(self) -> float:
        """RMS distance of the inliers [px]."""
        good = np.setdiff1d(np.flatnonzero(np.isfinite(self.distances)), self.contradicting)
        return float(np.sqrt((self.distances[good] ** 2).mean())) if len(good) else float("nan")


def result_of(problem: HandEyeProblem, fit: OptimizeResult, count: int) -> HandEyeResult:
    """Result at a minimum of the least-squares problem; `SettingsError` if it has undetermined directions."""
    bases, cameras, intrinsics = problem.poses(fit.x)
    distances = np.full(count, np.nan)
    for view, found in zip(problem.views, problem.distances(fit.x), strict=True):
        distances[list(view.rows)] = np.linalg.norm(found, axis=-1)
    # Ratio of estimated to expected variance of the points [1].
    excess = max(2.0 * fit.cost / _degrees_of_freedom(problem, fit), 1.0)
    information = fit.jac.T @ fit.jac
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if values[0] < _SINGULAR:
        raise SettingsError("the points do not determine all unknowns. Click points in frames with other arm poses.")
    covariance = excess * ((vectors / values) @ vectors.T / np.outer(scale, scale))
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
        ambiguous=tuple(
            (arms[view.arm], names[view.camera])
            for view in problem.views
            if view.arm in bases and _is_ambiguous([other for other in problem.views if other.arm == view.arm])
        ),
    )


def _is_ambiguous(views: Sequence[View]) -> bool:
    """Whether an arm has few points, or points of a single landmark, whose positions may differ little."""
    points = [mark.name for view in views for mark in view.landmarks if mark.kind is LandmarkKind.POINT]
    return len(points) < _FEW_POINTS or len(set(points)) == 1


def _degrees_of_freedom(problem: HandEyeProblem, fit: OptimizeResult) -> int:
    """Number of residuals minus number of unknowns, at least 1."""
    return max(sum(2 if point else 1 for view in problem.views for point in view.is_point) - len(fit.x), 1)


def _noise(problem: HandEyeProblem, fit: OptimizeResult, excess: float) -> float:
    """Standard deviation of a point per axis [px].

    It is estimated from the median of the Rayleigh-distributed distances, which is robust to outliers; the Cauchy loss
    alone underestimates noise that is larger than expected.
    """
    points = [
        np.linalg.norm(found[view.is_point], axis=-1)
        for view, found in zip(problem.views, problem.distances(fit.x), strict=True)
    ]
    spare = _degrees_of_freedom(problem, fit)
    typical = float(np.median(np.concatenate(points))) / np.sqrt(2.0 * np.log(2.0))
    return float(max(problem.settings.pixel_error * np.sqrt(excess), typical * np.sqrt(1.0 + len(fit.x) / spare)))


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
    """Standard deviations of an arm's pose relative to the view's camera."""

    def seen(step: np.ndarray) -> np.ndarray:
        bases, cameras, _ = problem.poses(step)
        T = cameras[view.camera] @ bases[view.arm]
        turn = Rotation.from_matrix(T[:3, :3] @ T_now[:3, :3].T).as_rotvec()
        return np.concatenate([turn, transform_point(T, problem.middles[view.arm])])

    bases, cameras, _ = problem.poses(values)
    T_now = cameras[view.camera] @ bases[view.arm]
    J = _differences(seen, values)
    return PoseDeviation.of(J @ covariance @ J.T)


def _filled(
    problem: HandEyeProblem, bases: dict[int, np.ndarray], cameras: dict[int, np.ndarray], intrinsics: np.ndarray
) -> Scene:
    arms, views = list(problem.scene.arms), list(problem.scene.cameras)
    for index, T_world_base in bases.items():
        arms[index] = replace(arms[index], T_world_base=T_world_base)
    for index, T_camera_world in cameras.items():
        views[index] = replace(views[index], T_camera_world=T_camera_world)
    for index in problem.focal:
        views[index] = replace(views[index], intrinsics=tuple(intrinsics[index].tolist()))
    return replace(problem.scene, arms=tuple(arms), cameras=tuple(views))


def _differences(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """Jacobian by central differences."""
    columns = [(function(at + step * unit) - function(at - step * unit)) / (2 * step) for unit in np.eye(len(at))]
    return np.stack(columns, axis=1)


_FOCAL_FACTORS = (1.0, 0.55, 0.75, 1.35, 1.8)
"""Initial values of the focal length, as factors of the given one."""
_COMBINED = 4
"""Maximum number of views with edges for which all combinations of sides are tried."""
_STEPS = 60
"""Maximum number of steps from each initial value."""
_TOLERANCE = 1e-12
"""Relative change at which the search ends."""


def solve_hand_eye(
    scene: Scene,
    measured: Mapping[str, Float[np.ndarray, "frames dofs"]],
    points: Sequence[ImagePoint],
    settings: HandEyeSettings | None = None,
) -> HandEyeResult:
    """Estimate base frames from points in a few frames; no initial pose is needed.

    Minimizes the Cauchy loss of image distances divided by `pixel_error`, from several perspective-n-point solutions.
    Both sides of a shaft are tried for its edges. Joint positions are taken as measured. Base frames and the cameras in
    `free_cameras` are estimated; if all cameras with points are free, the camera with the most points keeps its pose.

    Args:
        scene: arms and cameras; its base frames are used only for arms without points.
        measured: arm -> joint positions of all frames [rad, m], as in `Sequence.measured`.
        points: three or more points in each of 3 to 6 frames are recommended; an arm needs 4 points in one camera.

    Raises:
        SettingsError: no arm has enough points, the points do not determine all unknowns, or a point names a missing
            frame or landmark.
        RobotError: a point or `free_cameras` names an arm or a camera that does not exist.
    """
    settings = settings or HandEyeSettings()
    free = {scene.cameras.index(scene.camera(name)) for name in settings.free_cameras}
    views = views_of(scene, measured, points)
    factors = _FOCAL_FACTORS if settings.focal_length else (1.0,)
    problems = [HandEyeProblem(scene, views, free, settings, factor) for factor in factors]
    fits = [(problem, _minimum(problem, problem.origin)) for problem in problems]
    problem, fit = min(fits, key=lambda found: found[1].cost)
    for sides in _sides(problem):
        other = _minimum(problem, _minimum(problem, fit.x, sides).x)
        fit = min(fit, other, key=lambda found: found.cost)
    return result_of(problem, fit, len(points))


def _minimum(problem: HandEyeProblem, start: np.ndarray, sides: Sequence[int] | None = None) -> OptimizeResult:
    """Least-squares solution from an initial value; `sides` as in `HandEyeProblem.distances`."""
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
    """Side assignments to try: all combinations for few views, the same side in all views otherwise."""
    edges = [any(mark.kind is LandmarkKind.EDGE for mark in view.landmarks) for view in problem.views]
    choices = [(1, -1) if there else (0,) for there in edges]
    if sum(len(choice) > 1 for choice in choices) <= _COMBINED:
        yield from (sides for sides in product(*choices) if any(sides))
        return
    for place in (0, -1):
        yield tuple(choice[place] for choice in choices)


_LEVEL = 0.01
"""Significance level for disagreement of points with a calibration, individually or jointly [1]."""
_MAX_DISAGREEING_FRACTION = 0.25
"""Share of points that may disagree individually [1]; joint positions of real recordings are less accurate in some
frames."""


@dataclass(frozen=True, eq=False)
class PointAgreement:
    """Residuals of points before and after a calibration, with limits for the expected noise."""

    before: Float[np.ndarray, " points"]
    """Residuals under the hand-eye calibration from the points [px]; NaN for unused points."""
    after: Float[np.ndarray, " points"]
    """Residuals under the tested calibration [px]; NaN for unused points."""
    limits: Float[np.ndarray, " points"]
    """Maximum residual explained by noise [px]; infinite for unused points and outliers."""
    rms_before: float
    """RMS of `before` over the points with a finite limit [px]."""
    rms_after: float
    rms_limit: float
    """Maximum RMS residual explained by noise [px]."""

    @property
    def disagreeing(self) -> tuple[int, ...]:
        """Indices of the points whose residual has increased and exceeds its limit."""
        return tuple(np.flatnonzero((self.after > self.limits) & (self.after > self.before)).tolist())

    @property
    def agrees(self) -> bool:
        """Whether the points agree with the calibration, most of them individually and all of them jointly."""
        most = _MAX_DISAGREEING_FRACTION * np.isfinite(self.limits).sum()
        return bool(len(self.disagreeing) <= most and self.rms_after <= max(self.rms_limit, self.rms_before))


def agreement_with_points(
    scene: Scene,
    measured: Mapping[str, Float[np.ndarray, "frames dofs"]],
    points: Sequence[ImagePoint],
    found: HandEyeResult,
) -> PointAgreement:
    """Test a calibration against the clicked points.

    For a correct calibration, squared residuals divided by the variance of a point follow a chi-square distribution,
    with two degrees of freedom for a point and one for a line. The variance includes errors of clicks and of measured
    joint positions (`SurfaceSolver.frame_prior_deg`, as in calibration), since few frames cannot distinguish joint
    errors from pose errors. Single points are tested at the level `_LEVEL` divided by the number of points
    (Bonferroni), and the sum over all points at `_LEVEL`.

    Args:
        measured: arm -> joint positions of all frames [rad, m].

    Raises:
        SettingsError: a point names a frame or a landmark that does not exist.
        RobotError: a point names an arm or a camera that does not exist.
    """
    after, freedom = np.full(len(points), np.nan), np.ones(len(points))
    for view, residuals in _residuals(scene, measured, points):
        after[list(view.rows)] = np.linalg.norm(residuals, axis=-1)
        freedom[list(view.rows)] += view.is_point
    variance = found.noise**2 + _variance_of_joints(scene, measured, points) / freedom
    there = np.flatnonzero(np.isfinite(found.distances))
    counted = np.setdiff1d(there, found.contradicting)
    counted = counted if len(counted) else there
    limits = np.full(len(points), np.inf)
    limits[counted] = np.sqrt(variance[counted] * chdtri(freedom[counted], _LEVEL / len(counted)))
    degrees = freedom[counted].sum()
    rms_limit = np.sqrt((variance * freedom)[counted].sum() / degrees * chdtri(degrees, _LEVEL) / len(counted))
    before = found.distances
    rms_before, rms_after = (float(np.sqrt((each[counted] ** 2).mean())) for each in (before, after))
    return PointAgreement(before, after, limits, rms_before, rms_after, float(rms_limit))


def _residuals(
    scene: Scene, measured: Mapping[str, Float[np.ndarray, "frames dofs"]], points: Sequence[ImagePoint]
) -> Iterator[tuple[View, Float[np.ndarray, "points 2"]]]:
    """Residuals of the points of each view under a calibration [px]."""
    for view in views_of(scene, measured, points):
        camera, arm = scene.cameras[view.camera], scene.arms[view.arm]
        yield view, view.distances(camera.T_camera_world @ arm.T_world_base, np.array(camera.intrinsics))


def _variance_of_joints(
    scene: Scene, measured: Mapping[str, Float[np.ndarray, "frames dofs"]], points: Sequence[ImagePoint]
) -> Float[np.ndarray, " points"]:
    """Variance of residuals from errors of measured joint positions, summed over both axes [px^2]."""
    expected = np.radians(SurfaceSolver.frame_prior_deg)
    variance = np.zeros(len(points))
    for arm in scene.arms:
        for joint, kind in enumerate(arm.robot.joint_types):
            error = np.zeros(len(arm.robot.joint_names))
            error[joint] = expected * (SurfaceSolver.length_scale if kind == "prismatic" else 1.0)
            moved = {**measured, arm.name: np.asarray(measured[arm.name]) + error}
            pairs = zip(_residuals(scene, measured, points), _residuals(scene, moved, points), strict=True)
            for (view, before), (_, after) in pairs:
                variance[list(view.rows)] += ((after - before) ** 2).sum(-1)
    return variance
