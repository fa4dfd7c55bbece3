"""Joint positions and camera poses at the times of the frames, from the rows of kinematics tables."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from ..errors import SequenceError
from ..model.ecm_kinematics import JOINT_NAMES, forward
from ..wording import counted
from .frame_list import FrameList, FrameNames, list_of_rows, take_delimiter, take_frame_list, take_frame_names
from .kinematics_table import LENGTH_UNITS, PLAUSIBLE, JointColumns, Table, read_table
from .toml_table import TomlTable


def neighbours(
    times: Float[np.ndarray, " rows"], wanted: Float[np.ndarray, " wanted"]
) -> tuple[Int[np.ndarray, " wanted"], Int[np.ndarray, " wanted"]]:
    """Indices of the rows before and after each query time; equal at the time of a row and outside the range."""
    after = np.searchsorted(times, wanted).clip(0, len(times) - 1)
    return np.where(times[after] > wanted, after - 1, after).clip(0), after


def at_times(
    wanted: Float[np.ndarray, " wanted"], times: Float[np.ndarray, " rows"], values: Float[np.ndarray, "rows columns"]
) -> Float[np.ndarray, "wanted columns"]:
    """Interpolate values linearly at query times; NaN outside the range of the rows."""
    return np.stack([np.interp(wanted, times, column, left=np.nan, right=np.nan) for column in values.T], axis=1)


INTERPOLATIONS = ("linear", "nearest")
MISSING_ROWS = ("error", "omit")
_ROUNDING = 1e-6
"""Minimum distinguishable time difference [s]."""


@dataclass(frozen=True)
class TimeMatching:
    """Matching of frames and rows, at the frame's time plus `time_offset` in the table's clock."""

    time_offset: float = 0.0
    """Table time minus image time [s]."""
    interpolation: str = "linear"
    """`linear` between neighbouring rows, or the `nearest` row."""
    max_gap: float = 0.1
    """Maximum time difference between a frame and the rows used for it [s]."""
    missing_rows: str = "error"
    """`omit` to leave out frames without such rows, or `error`."""


def take_matching(section: TomlTable) -> TimeMatching:
    """Read the keys `time_offset`, `interpolation`, `max_gap` and `missing_rows` of `[frames]`."""
    time_offset = float(section.take("time_offset", float, 0.0))
    interpolation = section.take_choice("interpolation", INTERPOLATIONS, "linear")
    max_gap = float(section.take("max_gap", float, TimeMatching.max_gap))
    if not 0.0 < max_gap < np.inf:
        raise section.error("max_gap", f"is {max_gap}, but must be a positive number [s].")
    return TimeMatching(
        time_offset,
        interpolation,
        max_gap,
        section.take_choice("missing_rows", MISSING_ROWS, TimeMatching.missing_rows),
    )


@dataclass(frozen=True)
class Samples:
    """Logged rows of a table: joint positions [rows, dofs] [rad], [m], or poses T_world_mount [rows, 4, 4] [m]."""

    values: Float[np.ndarray, "rows ..."]
    table: Table
    """Table, for error messages."""
    times: Float[np.ndarray, " rows"] | None
    """Time of each row in the table's clock, increasing [s]; None if row n belongs to frame n."""
    time_offset: float = 0.0
    """Time in the table's clock minus time in the clock of `[kinematics]` [s]."""
    unlimited: Bool[np.ndarray, " dofs"] | bool = False
    """Whether a joint is revolute without limits, so that its positions are equivalent modulo 2 pi."""

    def at_frames(self, frames: FrameList, matching: TimeMatching | None) -> Float[np.ndarray, "frames ..."]:
        """Values of the frames; joints and positions are interpolated linearly, rotations spherically, and joints
        without limits through at most half a turn."""
        if matching is None:
            return self.values
        before, after, share, far = self._rows_at(frames, matching)
        if far.any():
            raise self._too_far(frames, matching, np.flatnonzero(far))
        if self.values.ndim == 3:
            return self._poses_at(before + share * (after - before))
        first, last = self.values[before], self.values[after]
        last = last - np.where(self.unlimited, 2.0 * np.pi * np.round((last - first) / (2.0 * np.pi)), 0.0)
        return (1.0 - share[:, None]) * first + share[:, None] * last

    def is_missing(self, frames: FrameList, matching: TimeMatching) -> Bool[np.ndarray, " frames"]:
        """Whether a frame has no rows within `max_gap`."""
        return self._rows_at(frames, matching)[-1]

    def _rows_at(self, frames: FrameList, matching: TimeMatching) -> tuple[np.ndarray, ...]:
        """Rows before and after each frame, share of the latter, and whether a row is too distant in time."""
        assert self.times is not None and frames.timestamps is not None
        wanted = frames.timestamps + matching.time_offset + self.time_offset
        before, after = neighbours(self.times, wanted)
        to_before, to_after = np.abs(wanted - self.times[before]), np.abs(self.times[after] - wanted)
        if matching.interpolation == "nearest":
            before = after = np.where(to_before <= to_after, before, after)
            distance = np.minimum(to_before, to_after)
            share = np.zeros(len(wanted))
        else:
            distance = np.maximum(to_before, to_after)
            share = np.where(before == after, 0.0, to_before / np.maximum(to_before + to_after, _ROUNDING))
        return before, after, share, distance > matching.max_gap + _ROUNDING

    def logged_at(self, times: Float[np.ndarray, " times"]) -> Float[np.ndarray, "times ..."]:
        """Values at times of the clock of `[kinematics]` [s]; NaN outside the table's range."""
        assert self.times is not None
        times = times + self.time_offset
        if self.values.ndim == 2:
            values = np.where(self.unlimited, np.unwrap(self.values, axis=0), self.values)
            return at_times(times, self.times, values)
        places = np.interp(times, self.times, np.arange(len(self.times), dtype=float), left=np.nan, right=np.nan)
        Ts = self._poses_at(np.nan_to_num(places))
        Ts[np.isnan(places)] = np.nan
        return Ts

    def _poses_at(self, places: Float[np.ndarray, " places"]) -> Float[np.ndarray, "places 4 4"]:
        """Poses at fractional row numbers, from 0."""
        if len(self.values) == 1:
            return np.tile(self.values, (len(places), 1, 1))
        rows = np.arange(len(self.values))
        Ts = np.tile(np.eye(4), (len(places), 1, 1))
        from scipy.spatial.transform import Rotation, Slerp  # noqa: PLC0415  takes 0.2 s

        Ts[:, :3, :3] = Slerp(rows, Rotation.from_matrix(self.values[:, :3, :3]))(places).as_matrix()
        Ts[:, :3, 3] = np.stack([np.interp(places, rows, one) for one in self.values[:, :3, 3].T], 1)
        return Ts

    def _too_far(self, frames: FrameList, matching: TimeMatching, far: np.ndarray) -> SequenceError:
        assert self.times is not None and frames.timestamps is not None
        row, what = far[0], "joint positions" if self.values.ndim == 2 else "camera poses"
        offset = matching.time_offset + self.time_offset
        wanted = frames.timestamps + offset
        after = int(np.searchsorted(self.times, wanted[row]))
        near = " and ".join(
            f"line {self.table.lines[index]} at {self.times[index]:.6g} s"
            for index in (after - 1, after)
            if 0 <= index < len(self.times)
        )
        return self.table.error(
            f" has no {what} for {len(far)} of {counted(len(wanted), 'frame')}. The first is frame "
            f"{frames.frame_ids[row]!r} at {wanted[row]:.6g} s of the table's clock (image time plus time_offset = "
            f"{offset:g} s), next to {near}; at most {matching.max_gap:g} s are allowed. "
            f"The frames are from {wanted.min():.6g} to {wanted.max():.6g} s, the rows from {self.times[0]:.6g} to "
            f"{self.times[-1]:.6g} s. Correct `time_offset` in [frames] (both clocks are in seconds), leave out these "
            'frames with missing_rows = "omit", or allow a larger `max_gap`.'
        )


@dataclass(frozen=True)
class Rows:
    """Tables of a sequence, as described by `[kinematics]` and `[frames]`."""

    frames: FrameList
    matching: TimeMatching | None
    """Matching of rows and frames by time; None if each row is a frame."""
    table: Table
    """Measured joint positions."""
    truth: Path | None
    """Table of true joint positions."""
    delimiter: str
    names: FrameNames | None
    """Column and pattern of frame ids; None if rows are matched by time."""
    timestamp: str
    """Column with the times of the rows; empty without times."""

    def measured_of(self, arm: TomlTable, columns: JointColumns) -> Samples:
        """Measured joint positions of an arm, from its `table` or the table of the sequence; errors as in `read`."""
        own = arm.take("table", str, "")
        table = self.read(arm.path(own)) if own else self.table
        return self._joints(arm, table, columns)

    def offset_of(self, arm: TomlTable) -> float:
        """Key `time_offset` of an arm [s]; `SequenceError` if rows are not matched by time."""
        offset = float(arm.take("time_offset", float, 0.0))
        if offset and self.matching is None:
            raise arm.error(
                "time_offset", "needs [frames], so that rows are matched by time. Add it, or remove the key."
            )
        return offset

    def truth_of(self, arm: TomlTable, columns: JointColumns) -> Samples | None:
        """True joint positions of an arm, from its `truth` or the table of the sequence; errors as in `read`."""
        own = arm.take("truth", str, "")
        if (path := arm.path(own) if own else self.truth) is None:
            return None
        return self._joints(arm, self.read(path), columns)

    def _joints(self, arm: TomlTable, table: Table, columns: JointColumns) -> Samples:
        samples = self.samples(table, columns.read(table))
        return replace(samples, time_offset=self.offset_of(arm), unlimited=columns.robot.unlimited)

    def read(self, path: Path) -> Table:
        """Read another table, which must have the same frames or the same clock."""
        table = read_table(path, self.delimiter)
        if self.names is None:
            return table
        ids, wanted = self.names.of(table), self.frames.frame_ids
        same = "All tables of a sequence must have the same frames in the same order."
        if len(ids) != len(wanted):
            rows = counted(len(ids), "row")
            raise table.error(f" has {rows}, but the kinematics table has {len(wanted)}. {same}")
        for row, (given, expected) in enumerate(zip(ids, wanted, strict=True)):
            if given != expected:
                text = f" is frame {given!r}, but the kinematics table has frame {expected!r} there. {same}"
                raise table.error(text, row)
        return table

    def samples(self, table: Table, values: np.ndarray) -> Samples:
        """Values of the rows of a table, with their times."""
        if self.matching is None:
            return Samples(values, table, None)
        column = self.timestamp
        times = table.numbers(column, "`timestamp` in [kinematics]")
        if (wrong := np.flatnonzero(np.diff(times) <= 0.0)).size:
            row = wrong[0] + 1
            raise table.error(
                f", column {column!r}: {times[row]:.9g} s is not after {times[row - 1]:.9g} s in line "
                f"{table.lines[row - 1]}. Sort the rows by time, and keep one row for each time.",
                row,
            )
        return Samples(values, table, times)


def take_rows(section: TomlTable, frames_section: TomlTable | None) -> Rows:
    """Read the tables described by `[kinematics]` and `[frames]`; without `[frames]`, each row is a frame."""
    delimiter = take_delimiter(section)
    table = read_table(section.path(section.take("table", str)), delimiter)
    timestamp, truth = section.take("timestamp", str, ""), section.take("truth", str, "")
    if frames_section is None:
        names, matching = take_frame_names(section), None
        frames = list_of_rows(
            table, names, timestamp, section, f"the kinematics table has {counted(len(table), 'row')}"
        )
    else:
        for key in ("frame", "frame_id", "video_frame"):
            if key in section:
                raise section.error(key, "describes frames. Move it to [frames].")
        if not timestamp:
            raise section.error(
                "timestamp", "is missing, but with [frames] rows are matched by time. Name the column of times [s]."
            )
        names, matching = None, take_matching(frames_section)
        frames = take_frame_list(frames_section)
        frames_section.finish()
    section.finish()
    return Rows(frames, matching, table, section.path(truth) if truth else None, delimiter, names, timestamp)


POSES = ("T_world_mount", "T_mount_world")
POSITION, ORIENTATION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
"""Default columns of a pose: position [m] and unit quaternion."""

_NORM_TOLERANCE = 0.01
"""Maximum deviation of a quaternion's norm from 1."""
_FARTHEST = 100.0
"""Maximum absolute coordinate of a pose's position [m]."""


def take_camera_motion(table: TomlTable, rows: Rows) -> Samples | None:
    """Read the key `motion` of a `[[cameras]]` table; None if it is absent."""
    given = table.take("motion", (str, dict), {})
    if not given:
        return None
    values = {"table": given} if isinstance(given, str) else given
    section = TomlTable(values, table.file, f"{table.where}: motion")
    poses = rows.read(section.path(section.take("table", str)))
    joints = section.take("ecm_joints", list, [])
    if joints:
        positions = _numbers(section, "ecm_joints", poses, joints, len(JOINT_NAMES))
        for joint, largest in zip(JOINT_NAMES, np.abs(positions).max(0), strict=True):
            if largest > (allowed := PLAUSIBLE["prismatic" if joint == "insertion" else "revolute"]):
                text = f"has {joint} at {largest:.4g}; at most {allowed:.3g} is allowed. Give [rad] and [m]."
                raise section.error("ecm_joints", text)
        Ts = forward(positions)
    else:
        Ts = _poses(section, poses)
    section.finish()
    return rows.samples(poses, Ts)


def _poses(section: TomlTable, table: Table) -> Float[np.ndarray, "rows 4 4"]:
    kind = section.take_choice("pose", POSES, POSES[0])
    unit = LENGTH_UNITS[section.take_choice("length_unit", ("m", "mm"), "m")]
    positions = unit * _numbers(section, "position", table, section.take("position", list, list(POSITION)), 3)
    rotations = _numbers(section, "orientation", table, section.take("orientation", list, list(ORIENTATION)), 4)
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(rotations, axis=1)
    if (wrong := np.flatnonzero(~(np.abs(lengths - 1.0) <= _NORM_TOLERANCE))).size:
        raise table.error(
            f": the norm of the quaternion is {lengths[wrong[0]]:.4g}, but must be 1. List its columns as "
            "`orientation`, in the order x, y, z, w.",
            wrong[0],
        )
    if (far := np.flatnonzero(~(np.abs(positions).max(1) <= _FARTHEST))).size:
        raise table.error(
            f": a coordinate of the position is {np.abs(positions[far[0]]).max():.4g} m; at most {_FARTHEST:g} m is "
            'allowed. If the columns are in mm, set length_unit = "mm".',
            far[0],
        )
    Ts = np.tile(np.eye(4), (len(table), 1, 1))
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  takes 0.2 s

    Ts[:, :3, :3], Ts[:, :3, 3] = Rotation.from_quat(rotations).as_matrix(), positions
    return Ts if kind == POSES[0] else np.linalg.inv(Ts)


def _numbers(section: TomlTable, key: str, table: Table, columns: list, count: int) -> Float[np.ndarray, "rows n"]:
    if len(columns) != count or not all(isinstance(column, str) for column in columns):
        raise section.error(key, f"is {columns!r}. Give the names of {count} columns.")
    return np.column_stack([table.numbers(column, section.name(key)) for column in columns])
