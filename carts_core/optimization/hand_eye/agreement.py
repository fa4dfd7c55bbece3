"""Agreement of a calibration with points that a person has found."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import chdtri

from ...model.scene import Scene
from .points import ImagePoint, views_of
from .result import HandEyeResult

_LEVEL = 0.01
"""Probability that a true calibration is said to disagree, by any single point or by all together [1]."""


@dataclass(frozen=True, eq=False)
class PointAgreement:
    """Residuals of points before and after a calibration, and how large the noise of points makes them."""

    before: Float[np.ndarray, " points"]
    """[px], of the calibration from the points; NaN for points that were not used."""
    after: Float[np.ndarray, " points"]
    """[px]"""
    limits: Float[np.ndarray, " points"]
    """Largest residual that noise explains [px]; infinite for points that were not used or contradict the others."""
    rms_before: float
    """Root mean square of the residuals of points with a limit [px]."""
    rms_after: float
    rms_limit: float
    """Largest root mean square that noise explains [px]."""

    @property
    def disagreeing(self) -> tuple[int, ...]:
        """Points whose residual has grown beyond its limit."""
        return tuple(np.flatnonzero((self.after > self.limits) & (self.after > self.before)).tolist())

    @property
    def agrees(self) -> bool:
        """Whether neither a single point nor all together speak against the calibration."""
        return not self.disagreeing and self.rms_after <= max(self.rms_limit, self.rms_before)


def agreement_with_points(
    scene: Scene,
    measured: Mapping[str, Float[np.ndarray, "frames dofs"]],
    points: Sequence[ImagePoint],
    found: HandEyeResult,
) -> PointAgreement:
    """Compare a calibration with points.

    Where a calibration is true, squared residuals over the variance of a point follow a chi-square distribution, with
    two degrees of freedom for a point and one for a line. A single point is tested at a level that is divided by the
    number of points (Bonferroni), and the sum over all points at the same level.

    Args:
        scene: with the calibration.
        measured: arm -> joint positions of all frames [rad, m].
        points: what a person has found.
        found: the calibration from these points.

    Raises:
        SettingsError: a point names a frame or a landmark that does not exist.
        RobotError: a point names an arm or a camera that does not exist.
    """
    after, freedom = np.full(len(points), np.nan), np.ones(len(points))
    for view in views_of(scene, measured, points):
        camera, arm = scene.cameras[view.camera], scene.arms[view.arm]
        distances = view.distances(camera.T_camera_world @ arm.T_world_base, np.array(camera.intrinsics))
        after[list(view.rows)] = np.linalg.norm(distances, axis=-1)
        freedom[list(view.rows)] += view.is_point
    counted = np.setdiff1d(np.flatnonzero(np.isfinite(found.distances)), found.contradicting)
    limits = np.full(len(points), np.inf)
    limits[counted] = found.noise * np.sqrt(chdtri(freedom[counted], _LEVEL / len(counted)))
    rms_limit = found.noise * np.sqrt(chdtri(freedom[counted].sum(), _LEVEL) / len(counted))
    before = found.distances
    rms_before, rms_after = (float(np.sqrt((each[counted] ** 2).mean())) for each in (before, after))
    return PointAgreement(before, after, limits, rms_before, rms_after, float(rms_limit))
