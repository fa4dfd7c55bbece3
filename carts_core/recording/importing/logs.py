"""Logs of arms and of the endoscope: joint positions with times, instruments and base frames."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ...errors import CartsError, SequenceError
from ...model import ecm_kinematics
from ...model.camera import T_DVRK_OPENCV
from ...model.psm_kinematics import CLASSIC, JOINT_NAMES, PsmGeometry, forward, inverse
from ...reprs import short_repr
from ...wording import counted
from ..matching import at_times, neighbours
from .calibrations import read_base_frames
from .found import FoundArm, Import, PartError, Track
from .joint_units import in_si, psm_joints

SAME_CYCLE = 2e-3
"""Maximum time between rows of two topics of the same controller cycle [s]."""


def clock_offset(times: Float[np.ndarray, " rows"], other: Float[np.ndarray, " other_rows"]) -> float:
    """Difference between the time stamps of rows of `times` and `other` from the same cycle [s].

    Topics of one cycle are stamped one after the other, so their stamps differ by a constant. The result is the median
    over rows within `SAME_CYCLE` of each other, or 0 if these are fewer than half of the rows, as for topics of
    different rates.
    """
    difference = times - other[nearest(times, other)]
    same = np.abs(difference) <= SAME_CYCLE
    return float(np.median(difference[same])) if 2 * same.sum() >= len(times) else 0.0


def nearest(times: Float[np.ndarray, " rows"], other: Float[np.ndarray, " other_rows"]) -> Int[np.ndarray, " rows"]:
    """Index of the row of `other` (increasing) nearest to each of `times`."""
    before, after = neighbours(other, times)
    return np.where(np.abs(times - other[before]) <= np.abs(times - other[after]), before, after)


ACCEPTED = 2e-5
"""Maximum median deviation of the base frame for the correct instrument [m]."""
_AMBIGUOUS = 2.0
"""Minimum ratio between the deviations of the second best and the best lengths."""
_MIN_ROWS = 20

WRIST_LENGTHS = (0.0091, 0.0093, 0.0100, 0.0107, 0.0112)
"""Wrist lengths of wristed 8 mm instruments, from wrist pitch to wrist yaw [m]."""

CANDIDATES: Mapping[str, PsmGeometry] = {
    f"{1e3 * length:.1f} mm wrist": replace(CLASSIC, wrist_length=length) for length in WRIST_LENGTHS
}
"""Lengths of the known instruments. Classic and Si are equivalent, since only shaft length minus distance to the remote
centre matters (-15.6 mm for both)."""


@dataclass(frozen=True, eq=False)
class BaseFrame:
    """Base frame of an arm, estimated from joint positions and poses."""

    T_reference_base: Float[np.ndarray, "4 4"]
    """Base frame in the reference frame of the poses [m]."""
    deviation: float
    """Median distance of the base in a row from the estimate [m]."""

    __repr__ = short_repr


def fit_base_frame(
    Ts_reference_tip: Float[np.ndarray, "rows 4 4"],
    joints: Float[np.ndarray, "rows 6"],
    geometry: PsmGeometry = CLASSIC,
) -> BaseFrame:
    """Estimate the base frame from joints [rad, m] and poses of the tip [m] in the same rows; `CartsError` if no row
    has both."""
    known = np.isfinite(joints).all(1) & np.isfinite(Ts_reference_tip).all((1, 2))
    if not known.any():
        raise CartsError(
            "no row has both joint positions and a tip pose, so they do not determine the base frame. "
            "Check that both topics were recorded at the same time."
        )
    return _mean_base(Ts_reference_tip[known] @ np.linalg.inv(forward(joints[known], geometry)))


def _mean_base(Ts: Float[np.ndarray, "rows 4 4"]) -> BaseFrame:
    """Mean rotation and median position of the base frames of all rows."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_matrix(Ts[:, :3, :3]).mean().as_matrix()
    T[:3, 3] = np.median(Ts[:, :3, 3], axis=0)
    return BaseFrame(T, float(np.median(np.linalg.norm(Ts[:, :3, 3] - T[:3, 3], axis=1))))


def fit_tool_point(
    Ts_reference_point: Float[np.ndarray, "rows 4 4"],
    joints: Float[np.ndarray, "rows 6"],
    geometry: PsmGeometry = CLASSIC,
) -> tuple[Float[np.ndarray, "3"], float]:
    """Estimate the point that poses refer to; returns its position in the tip frame and the median deviation of the
    base [m].

    With T_reference_base = (R, p) and T_base_tip = (R_i, t_i), the positions of the point at offset d from the tip are
    p_i = R (R_i d + t_i) + p: R is the mean of the rotations, and d and p solve a linear least squares problem.
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
    """Result of testing the known instruments on a recording."""

    fits: Mapping[str, BaseFrame]
    """Name -> estimated base frame, the best first."""

    @property
    def best(self) -> str:
        """Name of the best instrument."""
        return next(iter(self.fits))

    def accepts(self, name: str) -> bool:
        """Whether a recording is compatible with this instrument."""
        return self.fits[name].deviation <= ACCEPTED

    @property
    def decides(self) -> bool:
        """Whether the best instrument is accepted and clearly better than all others."""
        deviations = [fit.deviation for fit in self.fits.values()]
        return self.accepts(self.best) and all(_AMBIGUOUS * deviations[0] < other for other in deviations[1:])

    def warning(self, name: str) -> str | None:
        """Warning about a chosen instrument; None if it is consistent with the recording."""
        fit = self.fits[name]
        if self.accepts(name):
            return None
        text = (
            f"the recording is inconsistent with {name}: with its link lengths, the base frame computed from "
            f"measured_cp and measured_js varies by {1e3 * fit.deviation:.3f} mm ({1e3 * ACCEPTED:g} mm is allowed)."
        )
        if self.accepts(self.best):
            return f"{text} It is consistent with {self.best} ({1e3 * self.fits[self.best].deviation:.4f} mm)."
        return (
            f"{text} No known instrument fits. Check that joints and poses are of the same arm, in metres and radians."
        )


def check_instrument(
    Ts_reference_tip: Float[np.ndarray, "rows 4 4"],
    joints: Float[np.ndarray, "rows 6"],
    candidates: Mapping[str, PsmGeometry] = CANDIDATES,
) -> InstrumentCheck:
    """Rank instruments (name -> lengths) by the deviation of the arm's base from a constant frame.

    Args:
        Ts_reference_tip: poses of the tip in any frame fixed relative to the base [m].
        joints: joint positions at the same times [rad, m]; at least 20 rows must have joints and a pose.
    """
    rows = int((np.isfinite(joints).all(1) & np.isfinite(Ts_reference_tip).all((1, 2))).sum())
    if rows < _MIN_ROWS:
        raise CartsError(
            f"{counted(rows, 'row')} with both joints and a pose; at least {_MIN_ROWS} are needed. Record longer."
        )
    fits = {name: fit_base_frame(Ts_reference_tip, joints, geometry) for name, geometry in candidates.items()}
    return InstrumentCheck(dict(sorted(fits.items(), key=lambda item: item[1].deviation)))


_SAME_BASE = 1e-3
"""Distance from the identity [m], [rad] below which a base frame is considered not set in the dVRK."""
_CHECKED_ROWS = 5000
_MIN_REACHABLE_FRACTION = 0.5
_ACCURACY = "; the error of set-up joints is about 5 cm unless they are registered."
_SAME_POINT = 1e-4
"""Distance from the tip below which a point is considered the tip [m]."""


@dataclass(frozen=True, eq=False)
class ArmLog:
    """Logged values of one arm."""

    name: str
    joints: Track | None = None
    """Six joint positions [rad], [m]."""
    jaw: Track | None = None
    """Jaw angle [rad]."""
    poses: Track | None = None
    """Poses of the tip in any frame: x y z [m], quaternion x y z w."""
    local_poses: Track | None = None
    """Poses of the tip in the arm's base frame."""
    setup: Track | None = None
    """Poses of the arm's base in the camera frame, from set-up joints."""
    tool: str = ""
    """The dVRK's `tool_type`."""
    opencv_axes: bool = False
    """Whether `poses` and `setup` use OpenCV's camera axes instead of the dVRK's."""
    names: tuple[str, ...] = ()
    """Names of the joints of a robot other than a PSM; empty for a PSM."""
    si: bool = False
    """Whether joint positions have already been converted with the given units and signs."""

    @property
    def T_axes(self) -> Float[np.ndarray, "4 4"]:
        """Transform from the axes of `poses` and `setup` to those of OpenCV."""
        return np.eye(4) if self.opencv_axes else T_DVRK_OPENCV


def track(times: ArrayLike, values: ArrayLike) -> Track | None:
    """Sort rows by time, and remove rows that are not finite or repeat a time; None if no rows remain."""
    times, values = np.asarray(times, np.float64), np.asarray(values, np.float64)
    if not len(times) or values.ndim > 2:
        return None
    table = np.column_stack([times, values])
    table = table[np.isfinite(table).all(1)]
    table = table[np.argsort(table[:, 0], kind="stable")]
    table = table[np.concatenate([[True], np.diff(table[:, 0]) > 0])[: len(table)]]
    return Track(table[:, 0], table[:, 1:]) if len(table) else None


def transforms(values: Float[np.ndarray, "rows 7"]) -> Float[np.ndarray, "rows 4 4"]:
    """Convert x y z [m] and a quaternion x y z w to matrices; NaN for a zero quaternion."""
    Ts = np.tile(np.eye(4), (len(values), 1, 1))
    Ts[:, :3, 3] = values[:, :3]
    good = np.linalg.norm(values[:, 3:7], axis=1) > 1e-6
    Ts[~good] = np.nan
    if good.any():
        Ts[good, :3, :3] = Rotation.from_quat(values[good, 3:7]).as_matrix()
    return Ts


def arm_from_log(log: ArmLog, job: Import, start: float | None = None, motion: Track | None = None) -> FoundArm:
    """Determine joint positions and base frame of an arm; notes name their sources.

    Args:
        start: time of the first image, at which the pose of the set-up joints is taken [s].
        motion: motion of the endoscope from `endoscope_motion`, by which poses in the camera frame are converted to the
            world.
    """
    log = _in_world(log, start, motion)
    robot = job.options.robot.get(log.name, FoundArm.robot)
    if log.names:
        assert log.joints is not None
        T_base, base_from = _base_frame(log, CLASSIC, job)
        return FoundArm(log.name, log.names, log.joints.values, log.joints.times, robot, T_base, base_from)
    log = _with_tip_poses(log if log.si else _in_si(log, job), job)
    geometry = _geometry(log, job)
    T_camera_base, base_from = _base_frame(log, geometry, job)
    joints = log.joints if log.joints is not None else _joints_from_poses(log, T_camera_base, geometry, job)
    columns, values = JOINT_NAMES, joints.values
    if log.jaw is not None:
        jaw = np.interp(joints.times, log.jaw.times, log.jaw.values[:, 0])
        columns, values = (*JOINT_NAMES, "jaw"), np.column_stack([values, jaw])
        if jaw.min() < -0.1:
            job.found(f"jaw angles below 0 (down to {jaw.min():.2f} rad, while grasping) are set to 0.", log.name)
            values[:, -1] = np.maximum(values[:, -1], 0.0)
    else:
        job.missing("no jaw angle was recorded; the jaw is rendered closed.", log.name)
    return FoundArm(log.name, columns, values, joints.times, robot, T_camera_base, base_from)


def _in_world(log: ArmLog, start: float | None, motion: Track | None) -> ArmLog:
    """Convert poses in the frame of a moving camera to the world, and keep the set-up joints near the first image."""
    if motion is not None:
        log = replace(log, poses=_moved(log.poses, motion, log.T_axes), setup=_moved(log.setup, motion, log.T_axes))
    if log.setup is not None and start is not None:
        row = slice(place := int(np.abs(log.setup.times - start).argmin()), place + 1)
        log = replace(log, setup=Track(log.setup.times[row], log.setup.values[row]))
    return log


def _moved(poses: Track | None, motion: Track, T_axes: Float[np.ndarray, "4 4"]) -> Track | None:
    """Poses in the world, from poses in the camera frame at the same times."""
    if poses is None:
        return None
    moved = np.linalg.inv(T_axes) @ motion.values[nearest(poses.times, motion.times)] @ T_axes
    return _track_of_transforms(poses.times, moved @ transforms(poses.values))


def _in_si(log: ArmLog, job: Import) -> ArmLog:
    """Convert a log to SI units with the given units and signs."""

    def applied(logged: Track | None, names: tuple[str, ...]) -> Track | None:
        if logged is None:
            return None
        return replace(logged, values=in_si(logged.values, psm_joints(log.name, names, job), job, arm=log.name))

    return replace(log, joints=applied(log.joints, JOINT_NAMES), jaw=applied(log.jaw, ("jaw",)))


def _checked_rows(log: ArmLog) -> tuple[np.ndarray, np.ndarray] | None:
    """Poses and joints of sampled rows that have both; None if there are too few."""
    poses = log.poses or log.local_poses
    if log.joints is None or poses is None:
        return None
    measured = _joints_at(poses, log.joints)
    rows = np.flatnonzero(np.isfinite(measured).all(1))
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), _CHECKED_ROWS)).astype(int)] if len(rows) else rows
    return None if len(rows) < _MIN_ROWS else (transforms(poses.values[rows]), measured[rows])


def _joints_at(poses: Track, joints: Track) -> Float[np.ndarray, "rows 6"]:
    """Joint positions in the controller cycles of the poses; NaN outside the range of the joint log."""
    return at_times(poses.times - clock_offset(poses.times, joints.times), joints.times, joints.values)


def _with_tip_poses(log: ArmLog, job: Import) -> ArmLog:
    """Convert the poses of a log to those of the tip, if they refer to another point of the tool."""
    if job.options.tool_point is not None:
        point = np.array([0.0, 0.0, job.options.tool_point])
    elif (both := _checked_rows(log)) is not None and not _is_base_constant(*both):
        inverted = np.linalg.inv(both[0])
        if _is_base_constant(inverted, both[1]):
            job.warning(
                "measured_cp contains inverse transforms (the reference in the tip frame); they were inverted.",
                log.name,
            )
            return replace(log, poses=_inverse_of(log.poses), local_poses=_inverse_of(log.local_poses))
        fits = [fit_tool_point(*both, geometry) for geometry in CANDIDATES.values()]
        point, moves = min(fits, key=lambda fit: fit[1])
        if moves > ACCEPTED or np.linalg.norm(point) < _SAME_POINT:
            return log
        x, y, z = 1e3 * point
        text = f"poses refer to a point at {x:.1f}, {y:.1f}, {z:.1f} mm from the tip, along the tool's axes x, y, z"
        job.found(f"{text}; they are converted to the tip.", log.name, "--tool-point")
    else:
        return log
    return replace(log, poses=_poses_of_point(log.poses, -point), local_poses=_poses_of_point(log.local_poses, -point))


def _is_base_constant(Ts: np.ndarray, joints: np.ndarray) -> bool:
    return any(fit_base_frame(Ts, joints, geometry).deviation <= ACCEPTED for geometry in CANDIDATES.values())


def _poses_of_point(poses: Track | None, point: np.ndarray) -> Track | None:
    """Poses of a point that is fixed to the tool [m]."""
    if poses is None:
        return None
    values = poses.values.copy()
    values[:, :3] += transforms(values)[:, :3, :3] @ point
    return replace(poses, values=values)


def _inverse_of(poses: Track | None) -> Track | None:
    if poses is None:
        return None
    Ts = transforms(poses.values)
    known = np.isfinite(Ts).all((1, 2))
    Ts[known] = np.linalg.inv(Ts[known])
    return _track_of_transforms(poses.times, Ts)


def _track_of_transforms(times: Float[np.ndarray, " rows"], Ts: Float[np.ndarray, "rows 4 4"]) -> Track:
    """Inverse of `transforms`, without rows that are not finite."""
    known = np.isfinite(Ts).all((1, 2))
    Ts = Ts[known]
    return Track(times[known], np.column_stack([Ts[:, :3, 3], Rotation.from_matrix(Ts[:, :3, :3]).as_quat()]))


def _geometry(log: ArmLog, job: Import) -> PsmGeometry:
    """Lengths of the instrument: estimated from the recording, else given, else of a Large Needle Driver."""
    if log.tool:
        job.found(f"tool_type is {log.tool}.", log.name)
    given = job.options.wrist_length
    chosen = replace(CLASSIC, wrist_length=given) if given is not None else CLASSIC
    if (both := _checked_rows(log)) is None:
        return chosen
    name = f"{1e3 * chosen.wrist_length:.1f} mm wrist"
    candidates = {**CANDIDATES, name: chosen}
    check = check_instrument(*both, candidates)
    if check.decides:
        deviation = 1e3 * check.fits[check.best].deviation
        job.found(
            f"joints and tip poses are consistent with a {check.best} (deviation of the base frame: {deviation:.4f} "
            "mm).",
            log.name,
        )
        chosen = candidates[check.best]
    elif (warning := check.warning(name)) is not None:
        job.warning(warning, log.name)
    if chosen.wrist_length != CLASSIC.wrist_length and log.name not in job.options.robot:
        job.warning(
            "the shipped robot has a wrist of 9.1 mm and this instrument one of "
            f"{1e3 * chosen.wrist_length:.1f} mm. Generate the URDF of this instrument with carts robot and select it.",
            log.name,
            remedy=f"Use --robot {log.name} FILE.urdf.",
        )
    return chosen


def _base_frame(log: ArmLog, geometry: PsmGeometry, job: Import) -> tuple[np.ndarray | None, str]:
    """Base frame of the arm in the camera frame with OpenCV's axes, and its source; None if unknown."""
    if (path := job.options.base.get(log.name)) is not None:
        frames = read_base_frames(path, job.options.axes)
        chosen = [frame for frame in frames if frame.arm == log.name] or ([frames[0]] if len(frames) == 1 else [])
        if not chosen:
            known = ", ".join(frame.arm for frame in frames)
            raise SequenceError(f"{path} has no base frame of {log.name}. It has: {known}. Give another file.")
        (frame, *_), recorded = chosen, job.options.arms.get(log.name)
        reference = f", relative to {frame.reference}" if frame.reference else ""
        job.found(f"base frame from {path}{reference}.", log.name)
        if frame.arm not in ("", log.name, recorded):
            remedy = f"Check --base {log.name} FILE."
            job.warning(f"{path.name} has the base frame of {frame.arm}.", log.name, remedy=remedy)
        if re.search(r"(?i)cart|world", frame.reference):
            text = f"the base frame of {path.name} is relative to {frame.reference}, not to the camera"
            job.warning(f"{text}; it is used as if it were.", log.name)
        return frame.T_camera_base, str(path)
    if log.poses is not None and (log.joints is not None or log.local_poses is not None):
        T, what = _own_base_frame(log, geometry)
        if T is not None and np.abs(T - np.eye(4)).max() > _SAME_BASE:
            job.found(f"base frame from {what}{_ACCURACY}", log.name)
            return log.T_axes @ T, what
    if log.setup is not None:
        T = transforms(log.setup.values[len(log.setup.values) // 2][None])[0]
        job.found(f"base frame from set-up joints{_ACCURACY}", log.name)
        return log.T_axes @ T, "set-up joints (SUJ)"
    return None, ""


def _own_base_frame(log: ArmLog, geometry: PsmGeometry) -> tuple[np.ndarray | None, str]:
    assert log.poses is not None
    if log.joints is not None:
        joints = _joints_at(log.poses, log.joints)
        if not np.isfinite(joints).all(1).any():
            return None, ""
        fit = fit_base_frame(transforms(log.poses.values), joints, geometry)
        return fit.T_reference_base, "measured_cp and measured_js"
    assert log.local_poses is not None
    rows = nearest(log.poses.times, log.local_poses.times)
    Ts = transforms(log.poses.values) @ np.linalg.inv(transforms(log.local_poses.values)[rows])
    Ts = Ts[np.isfinite(Ts).all((1, 2))]
    return (_mean_base(Ts).T_reference_base, "measured_cp and local/measured_cp") if len(Ts) else (None, "")


def _joints_from_poses(log: ArmLog, T_camera_base: np.ndarray | None, geometry: PsmGeometry, job: Import) -> Track:
    """Compute joint positions from poses by inverse kinematics."""
    source = log.local_poses or log.poses
    if source is None:
        raise PartError(
            "recording",
            f"{log.name} has neither joint positions (measured_js) nor tip poses (measured_cp, local/measured_cp).",
            "Record one of them, or leave the arm out: --arms.",
        )
    Ts = transforms(source.values)
    if log.local_poses is None and T_camera_base is not None:
        # In this case measured_cp is in the camera frame, with the axes of the log.
        Ts = np.linalg.inv(T_camera_base) @ log.T_axes @ Ts
    found = inverse(Ts, geometry)
    reached = found.reachable
    for entry in found.unreachable:
        job.warning(f"unreachable poses were left out: {entry}.", log.name)
    if reached.mean() < _MIN_REACHABLE_FRACTION:
        raise PartError(
            "recording",
            f"{log.name}: {int((~reached).sum())} of {counted(len(Ts), 'pose')} are unreachable "
            f"({found.unreachable[0].reason}). They are probably in a frame other than the arm's base frame, or in "
            "another unit.",
            f"Give the base frame with --base {log.name} FILE, or record local/measured_cp.",
        )
    job.found(f"joint positions by inverse kinematics of {int(reached.sum())} poses.", log.name)
    return Track(source.times[reached], found.joints[reached])


_MOVES = 5e-4, 0.1
"""Motion [m], [deg] below which an endoscope is considered static."""


def endoscope_motion(poses: Track | None, joints: Track | None, start: float, job: Import) -> Track | None:
    """Pose of the camera mount over time, in a world with its origin at the first image; None for a static or
    unrecorded endoscope.

    The camera mount is the ECM's tip, from logged poses or joints; `carts calibrate` estimates the camera's pose
    relative to the mount.

    Args:
        start: time of the first image [s].
    """
    chosen = poses if poses is not None else joints
    if chosen is None or len(chosen.times) < 2:
        return None
    Ts = transforms(chosen.values) if poses is not None else ecm_kinematics.forward(chosen.values)
    known = np.asarray(np.isfinite(Ts).all((1, 2)))
    if known.sum() < 2:
        return None
    times, Ts = chosen.times[known], Ts[known]
    first = int(np.abs(times - start).argmin())
    relative = T_DVRK_OPENCV @ np.linalg.inv(Ts[first]) @ Ts @ T_DVRK_OPENCV
    distance = float(np.linalg.norm(relative[:, :3, 3], axis=1).max())
    turn = float(np.degrees(Rotation.from_matrix(relative[:, :3, :3]).magnitude().max()))
    if distance <= _MOVES[0] and turn <= _MOVES[1]:
        job.found("the endoscope (ECM) is static.")
        return None
    job.found(
        f"the endoscope (ECM) moves by up to {1e3 * distance:.1f} mm and {turn:.1f} deg; the poses of the cameras are "
        "written to a table. Base frames refer to its pose at the first image."
    )
    job.guessed("the camera pose is that of the ECM's tip; carts calibrate estimates their offset and the base frames.")
    return Track(times, relative)
