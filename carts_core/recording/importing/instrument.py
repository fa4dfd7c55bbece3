"""Which instrument made a recording that has both joint positions and tip poses.

The pose of the arm's base, `T_reference_tip @ inv(T_base_tip(joints))`, does not move. With the right lengths it comes
out the same in every row; with another wrist or shaft it moves with the wrist.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ...errors import CartsError
from ...model.psm_kinematics import CLASSIC, PsmGeometry, forward

ACCEPTED = 2e-5
"""[m] The base of the right instrument moves by no more than this, in the median row."""
_AMBIGUOUS = 2.0
"""The best lengths must be this many times as good as the next ones."""
_FEWEST_ROWS = 20

WRIST_LENGTHS = (0.0091, 0.0093, 0.0100, 0.0107, 0.0112)
"""[m] From wrist pitch to wrist yaw, of all wristed 8 mm instruments."""

CANDIDATES: Mapping[str, PsmGeometry] = {
    f"{1e3 * length:.1f} mm wrist": replace(CLASSIC, wrist_length=length) for length in WRIST_LENGTHS
}
"""Lengths of the known instruments on their own arm; classic and Si come out the same, since only shaft length minus
distance to the remote centre counts (-15.6 mm for both)."""


@dataclass(frozen=True, eq=False)
class BaseFrame:
    """The arm's base as a recording with joints and poses gives it."""

    T_reference_base: Float[np.ndarray, "4 4"]
    """[m] The reference is the frame that the poses are given in."""
    deviation: float
    """How far the base is from there in the median row [m]."""
    largest_deviation: float
    """In the worst row [m]."""
    rotation_deviation: float
    """How far it is turned in the median row [rad]."""


def fit_base_frame(
    Ts_reference_tip: Float[np.ndarray, "rows 4 4"],
    joints: Float[np.ndarray, "rows 6"],
    geometry: PsmGeometry = CLASSIC,
) -> BaseFrame:
    """The base frame that joint positions [rad, m] and the tip's poses [m] at the same times agree on.

    Raises:
        CartsError: there are no rows with both.
    """
    known = np.isfinite(joints).all(1) & np.isfinite(Ts_reference_tip).all((1, 2))
    if not known.any():
        raise CartsError(
            "no row has both joint positions and a tip pose, so the base frame is not known from them. "
            "Check that both topics were recorded at the same time."
        )
    Ts = Ts_reference_tip[known] @ np.linalg.inv(forward(joints[known], geometry))
    rotations = Rotation.from_matrix(Ts[:, :3, :3])
    mean = rotations.mean()
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = mean.as_matrix(), np.median(Ts[:, :3, 3], axis=0)
    distances = np.linalg.norm(Ts[:, :3, 3] - T[:3, 3], axis=1)
    turned = np.median((mean.inv() * rotations).magnitude())
    return BaseFrame(T, float(np.median(distances)), float(distances.max()), float(turned))


def fit_tool_point(
    Ts_reference_point: Float[np.ndarray, "rows 4 4"],
    joints: Float[np.ndarray, "rows 6"],
    geometry: PsmGeometry = CLASSIC,
) -> tuple[Float[np.ndarray, "3"], float]:
    """Where the point of poses is, seen from the tip, and how far the base moves with it in the median row [m].

    With T_reference_base = (R, p) and T_base_tip = (R_i, t_i), the places of the point at d from the tip are
    p_i = R (R_i d + t_i) + p: R is the mean of the rotations, and d and p solve a linear least squares problem.

    Raises:
        CartsError: there are no rows with both.
    """
    known = np.isfinite(joints).all(1) & np.isfinite(Ts_reference_point).all((1, 2))
    R = fit_base_frame(Ts_reference_point, joints, geometry).T_reference_base[:3, :3]
    Ts = forward(joints[known], geometry)
    A = np.concatenate([R @ Ts[:, :3, :3], np.broadcast_to(np.eye(3), (len(Ts), 3, 3))], axis=2).reshape(-1, 6)
    b = (Ts_reference_point[known, :3, 3] - Ts[:, :3, 3] @ R.T).reshape(-1)
    solved = np.linalg.lstsq(A, b, rcond=None)[0]
    residuals = np.linalg.norm((b - A @ solved).reshape(-1, 3), axis=1)
    return solved[:3], float(np.median(residuals))


@dataclass(frozen=True, eq=False)
class InstrumentCheck:
    """How well instruments explain a recording."""

    fits: Mapping[str, BaseFrame]
    """Name -> fit, the best first."""

    @property
    def best(self) -> str:
        """Name of the instrument that explains the recording best."""
        return next(iter(self.fits))

    def accepts(self, name: str) -> bool:
        """Whether a recording can be of this instrument."""
        return self.fits[name].deviation <= ACCEPTED

    @property
    def decides(self) -> bool:
        """Whether the best instrument is accepted and clearly better than every other one."""
        deviations = [fit.deviation for fit in self.fits.values()]
        return self.accepts(self.best) and all(_AMBIGUOUS * deviations[0] < other for other in deviations[1:])

    def warning(self, name: str) -> str | None:
        """What to tell whoever chose an instrument; None when it fits."""
        fit = self.fits[name]
        if self.accepts(name):
            return None
        text = (
            f"the recording does not fit {name}: measured_cp and measured_js place the arm's base "
            f"{1e3 * fit.deviation:.3f} mm apart from row to row (allowed is {1e3 * ACCEPTED:g} mm)."
        )
        if self.accepts(self.best):
            return f"{text} It fits {self.best} ({1e3 * self.fits[self.best].deviation:.4f} mm): choose that one."
        return (
            f"{text} No known instrument does: check that joints and poses are of the same arm, in metres and radians."
        )


def check_instrument(
    Ts_reference_tip: Float[np.ndarray, "rows 4 4"],
    joints: Float[np.ndarray, "rows 6"],
    candidates: Mapping[str, PsmGeometry] = CANDIDATES,
) -> InstrumentCheck:
    """Compare instruments by how still the arm's base stands with each.

    Args:
        Ts_reference_tip: poses of the tip in any frame that does not move against the base [m].
        joints: joint positions at the same times [rad, m].
        candidates: name -> lengths.

    Raises:
        CartsError: fewer than 20 rows have both.
    """
    rows = int((np.isfinite(joints).all(1) & np.isfinite(Ts_reference_tip).all((1, 2))).sum())
    if rows < _FEWEST_ROWS:
        raise CartsError(f"{rows} rows have both joints and a pose, at least {_FEWEST_ROWS} are needed. Record longer.")
    fits = {name: fit_base_frame(Ts_reference_tip, joints, geometry) for name, geometry in candidates.items()}
    return InstrumentCheck(dict(sorted(fits.items(), key=lambda item: item[1].deviation)))
