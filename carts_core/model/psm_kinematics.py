"""Closed-form kinematics of the classic and Si Patient Side Manipulator (PSM) with a wristed instrument.

The chain, in modified Denavit-Hartenberg parameters (alpha [rad], a [m], theta [rad], d [m]):

    yaw           pi/2   0             q1 + pi/2   0
    pitch        -pi/2   0             q2 - pi/2   0
    insertion     pi/2   0             0           q3 - remote_center
    roll          0      0             q4          shaft_length
    wrist pitch  -pi/2   0             q5 - pi/2   0
    wrist yaw    -pi/2   wrist_length  q6 - pi/2   0
    tip          -pi/2   0             pi/2        0

The base frame is at the remote centre of motion. The tip frame is that of the dVRK: its origin is on the wrist's yaw
axis, and z is along the closed jaws. `tip_offset` converts poses that a controller reports for a more distal point.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from ..errors import SettingsError
from ..reprs import short_repr

JOINT_NAMES = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")
"""Names of the joints, in the order of all arrays in this module."""

ROLL = 3
_SINGULAR = 1e-9
"""Distance from an axis below which a direction is undefined [m]."""
_SHOWN_ROWS = 5
_LIMIT_TOLERANCE = 1e-9
"""Tolerance of joint limits for round-off [rad, m]."""


@dataclass(frozen=True)
class PsmGeometry:
    """Lengths and joint limits of an arm with an instrument.

    Raises:
        SettingsError: a length is out of range.
    """

    shaft_length: float = 0.4162
    """Distance from the instrument's base to the wrist's pitch axis [m]: 0.4162 classic, 0.4670 Si."""
    wrist_length: float = 0.0091
    """Distance from the wrist's pitch axis to its yaw axis [m]."""
    remote_center: float = 0.4318
    """Distance from the instrument's base at insertion 0 to the remote centre [m]: 0.4318 classic, 0.4826 Si."""
    limits: tuple[tuple[float, float], ...] = field(
        default=((-1.588, 1.588), (-0.925, 0.925), (0.0, 0.24), (-4.538, 4.538), (-1.396, 1.396), (-1.571, 1.571))
    )
    """Lower and upper limit of each joint [rad], [m]."""

    def __post_init__(self) -> None:
        for name, value, highest in (
            ("shaft_length", self.shaft_length, 1.0),
            ("wrist_length", self.wrist_length, 0.1),
        ):
            if not 0.0 <= value <= highest:
                raise SettingsError(f"{name} is {value:g} m; allowed: 0 to {highest:g} m. Give metres.")
        if len(self.limits) != len(JOINT_NAMES) or any(low > high for low, high in self.limits):
            raise SettingsError(
                f"limits are {self.limits}. Give a pair (lower, upper) for each of {', '.join(JOINT_NAMES)}."
            )
        if any(abs(value) >= np.pi / 2 for index in (1, 4) for value in self.limits[index]):
            raise SettingsError(
                "limits of pitch and wrist_pitch must be within 90 degrees, since poses beyond these are ambiguous."
            )


CLASSIC = PsmGeometry()
"""Classic PSM with a Large Needle Driver."""

SI = PsmGeometry(
    shaft_length=0.4670,
    remote_center=0.4826,
    limits=((-2.964, 2.964), (-1.265, 1.301), (0.0, 0.29), (-4.538, 4.538), (-1.396, 1.396), (-1.571, 1.571)),
)
"""Si PSM with a Large Needle Driver."""


@dataclass(frozen=True)
class Unreachable:
    """Rows that are unreachable within the joint limits, for the same reason."""

    rows: tuple[int, ...]
    """Row numbers from 0."""
    reason: str
    """Message without a full stop."""

    def __str__(self) -> str:
        shown = ", ".join(str(row) for row in self.rows[:_SHOWN_ROWS])
        rest = f" and {len(self.rows) - _SHOWN_ROWS} more" if len(self.rows) > _SHOWN_ROWS else ""
        return f"{'row' if len(self.rows) == 1 else 'rows'} {shown}{rest}: {self.reason}"


@dataclass(frozen=True, eq=False)
class InverseKinematics:
    """Joint positions for a series of poses."""

    joints: Float[np.ndarray, "rows 6"]
    """Joint positions [rad], [m]; NaN in unreachable rows."""
    unreachable: tuple[Unreachable, ...]

    __repr__ = short_repr

    @property
    def reachable(self) -> Bool[np.ndarray, " rows"]:
        """Whether each row is reachable."""
        return np.asarray(np.isfinite(self.joints).all(1))


def forward(joints: Float[np.ndarray, "*batch 6"], geometry: PsmGeometry = CLASSIC) -> Float[np.ndarray, "*batch 4 4"]:
    """T_base_tip [m] at joint positions [rad], [m]."""
    q = np.asarray(joints, dtype=np.float64)
    half_turn = np.pi / 2
    rows = (
        (half_turn, 0.0, q[..., 0] + half_turn, 0.0),
        (-half_turn, 0.0, q[..., 1] - half_turn, 0.0),
        (half_turn, 0.0, 0.0, q[..., 2] - geometry.remote_center),
        (0.0, 0.0, q[..., 3], geometry.shaft_length),
        (-half_turn, 0.0, q[..., 4] - half_turn, 0.0),
        (-half_turn, geometry.wrist_length, q[..., 5] - half_turn, 0.0),
        (-half_turn, 0.0, half_turn, 0.0),
    )
    T = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
    for alpha, a, theta, d in rows:
        T = T @ modified_dh(alpha, a, np.broadcast_to(theta, q.shape[:-1]), np.broadcast_to(d, q.shape[:-1]))
    return T


def modified_dh(alpha: float, a: float, theta: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Transform Rx(alpha) Tx(a) Rz(theta) Tz(d) of the modified DH convention, [batch ..., 4, 4]."""
    c, s = np.cos(theta), np.sin(theta)
    ca, sa = np.cos(alpha), np.sin(alpha)
    T = np.zeros((*theta.shape, 4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 3] = c, -s, a
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2], T[..., 1, 3] = s * ca, c * ca, -sa, -sa * d
    T[..., 2, 0], T[..., 2, 1], T[..., 2, 2], T[..., 2, 3] = s * sa, c * sa, ca, ca * d
    T[..., 3, 3] = 1.0
    return T


def inverse(
    Ts_base_tip: Float[np.ndarray, "rows 4 4"],
    geometry: PsmGeometry = CLASSIC,
    *,
    tip_offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
    continuous: bool = True,
    roll_near: float = 0.0,
) -> InverseKinematics:
    """Compute joint positions for poses of the tip, without clamping.

    A pose has up to two solutions with the wrist bent by less than 90 degrees. In one of them the wrist is behind the
    remote centre, which requires an insertion below about 16 mm. The solution within the limits is returned. If both
    are within the limits, as the wider yaw range of Si arms allows, it is the solution with the wrist in front of the
    remote centre.

    Args:
        Ts_base_tip: poses of the tip in the arm's base frame, translation in [m].
        tip_offset: position of the poses' origin relative to the tip frame defined above, in the axes of the pose [m].
        continuous: whether rows are consecutive in time, so that the roll, with a range of more than one revolution,
            must not jump.
        roll_near: if several revolutions are within the limits, the (mean) roll nearest to this value is chosen [rad].

    Raises:
        SettingsError: poses are not 4x4 matrices.
    """
    Ts = np.asarray(Ts_base_tip, dtype=np.float64)
    if Ts.ndim != 3 or Ts.shape[1:] != (4, 4):
        raise SettingsError(f"poses have the shape {Ts.shape}. Give [rows, 4, 4].")
    R = Ts[:, :3, :3]
    tip = Ts[:, :3, 3] - R @ np.asarray(tip_offset)
    with np.errstate(invalid="ignore", divide="ignore"):
        joints = _solve(R, tip, geometry)
    finite, solvable = np.isfinite(Ts).all((1, 2)), np.isfinite(joints).all(1)
    joints[:, ROLL] = _roll_turns(joints[:, ROLL], geometry.limits[ROLL], continuous, roll_near)
    reasons = [
        (~finite, "the pose is not finite"),
        (
            finite & ~solvable,
            "the wrist's yaw axis passes through the remote centre, where joint positions are not unique",
        ),
    ]
    for index, (name, (low, high)) in enumerate(zip(JOINT_NAMES, geometry.limits, strict=True)):
        value = joints[:, index]
        outside = (value < low - _LIMIT_TOLERANCE) | (value > high + _LIMIT_TOLERANCE)
        if outside.any():
            reasons.append((outside, _beyond(name, value[outside], low, high)))
    unreachable = tuple(
        Unreachable(tuple(int(row) for row in np.flatnonzero(wrong)), reason)
        for wrong, reason in reasons
        if wrong.any()
    )
    for entry in unreachable:
        joints[list(entry.rows)] = np.nan
    return InverseKinematics(joints, unreachable)


def _solve(R: np.ndarray, tip: np.ndarray, geometry: PsmGeometry) -> np.ndarray:
    """Joint positions [rows, 6] with the roll in (-pi, pi]; NaN without a solution."""
    # The wrist link points from the pitch axis to the tip. It is normal to the yaw axis, which is -x of the pose, and
    # lies in the plane of the yaw axis and the shaft, which also contains the remote centre.
    yaw_axis = -R[:, :, 0]
    link = tip - _dot(tip, yaw_axis)[:, None] * yaw_axis
    length = np.linalg.norm(link, axis=1)
    link = link / length[:, None]
    # Since the angle between link and shaft is less than 90 degrees, each direction of the link has one direction of
    # the shaft.
    outside = np.where(length >= geometry.wrist_length, 1.0, -1.0)
    first = _solve_link(R, tip, yaw_axis, link, outside, geometry)
    second = _solve_link(R, tip, yaw_axis, -link, -np.ones(len(tip)), geometry)
    limits = np.delete(np.array(geometry.limits), ROLL, axis=0)
    beyond = [
        np.maximum(limits[:, 0] - q, q - limits[:, 1]).max(1)
        for q in (np.delete(q, ROLL, axis=1) for q in (first, second))
    ]
    better = (beyond[0] > _LIMIT_TOLERANCE) & (beyond[1] < beyond[0])
    joints = np.where(better[:, None], second, first)
    joints[(length < _SINGULAR) | ~np.isfinite(joints).all(1)] = np.nan
    return joints


def _solve_link(
    R: np.ndarray, tip: np.ndarray, yaw_axis: np.ndarray, link: np.ndarray, side: np.ndarray, geometry: PsmGeometry
) -> np.ndarray:
    """Joint positions [rows, 6] for a direction of the wrist link, with the wrist in front of (1) or behind (-1) the
    remote centre."""
    wrist = tip - geometry.wrist_length * link
    depth = side * np.linalg.norm(wrist, axis=1)
    shaft = wrist / depth[:, None]
    x, y, z = shaft.T
    q1, q2 = np.arctan2(x, -z), np.arctan2(-y, np.hypot(x, z))
    pitch_axis = np.cross(link, yaw_axis)
    # Axes of the insertion frame; z is along the shaft.
    across = np.stack([-np.sin(q1) * np.sin(q2), -np.cos(q2), np.cos(q1) * np.sin(q2)], 1)
    beside = np.cross(shaft, across)
    q3 = depth + geometry.remote_center - geometry.shaft_length
    q4 = np.arctan2(-_dot(pitch_axis, across), _dot(pitch_axis, beside))
    q5 = np.arctan2(_dot(link, np.cross(pitch_axis, shaft)), _dot(link, shaft))
    q6 = np.arctan2(-_dot(R[:, :, 1], link), -_dot(R[:, :, 1], pitch_axis))
    return np.stack([q1, q2, q3, q4, q5, q6], 1)


def _roll_turns(roll: np.ndarray, limits: tuple[float, float], continuous: bool, near: float) -> np.ndarray:
    """Add full revolutions to the roll, so that it does not jump if `continuous`, and is within the limits if
    possible."""
    known = np.isfinite(roll)
    if not known.any():
        return roll
    turned, (low, high) = roll.copy(), limits
    if continuous:
        turned[known] = np.unwrap(roll[known])
        turns = 2 * np.pi * np.arange(-2, 3)
        lows, highs = turned[known].min() + turns, turned[known].max() + turns
        beyond = np.maximum(low - lows, 0.0) + np.maximum(highs - high, 0.0)
        fitting = np.flatnonzero(beyond <= beyond.min() + _LIMIT_TOLERANCE)
        distance = np.abs(turned[known].mean() + turns[fitting] - near)
        return turned + turns[fitting[int(distance.argmin())]]
    options = turned[:, None] + 2 * np.pi * np.arange(-1, 2)
    beyond = np.maximum(low - options, 0.0) + np.maximum(options - high, 0.0)
    cost = np.where(beyond <= np.nanmin(beyond, axis=1, keepdims=True, initial=np.inf) + _LIMIT_TOLERANCE, 0.0, np.inf)
    choice = np.nan_to_num(cost + np.abs(options - near), nan=np.inf).argmin(1)
    return options[np.arange(len(roll)), choice]


def _beyond(name: str, values: np.ndarray, low: float, high: float) -> str:
    worst = values[np.argmax(np.maximum(low - values, values - high))]
    unit = "m" if name == "insertion" else "rad"
    return f"{name} would be {worst:.4g} {unit}; allowed: {low:g} to {high:g} {unit}"


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", a, b)
