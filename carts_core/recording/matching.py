"""Joint positions and camera poses at the times of the frames, from the rows of kinematics tables."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation, Slerp

from ..errors import SequenceError
from ..model.ecm_kinematics import JOINT_NAMES, forward
from ..wording import counted
from .frame_list import FrameList, FrameNames, list_of_rows, take_delimiter, take_frame_list, take_frame_names
from .kinematics_table import PLAUSIBLE, JointColumns, Table, read_table
from .toml_table import TomlTable

INTERPOLATIONS = ("linear", "nearest")
_ROUNDING = 1e-6
"""Smallest distinguishable time difference [s]."""


@dataclass(frozen=True)
class TimeMatching:
    """Matching of frames and rows: at the frame's time plus `time_offset` in the table's clock."""

    time_offset: float = 0.0
    """Time in the table minus time of the image [s]."""
    interpolation: str = "linear"
    """`linear` between the row before and the row after, or the `nearest` row."""
    max_gap: float = 0.1
    """Largest time between a frame and the rows used for it [s]."""


def take_matching(section: TomlTable) -> TimeMatching:
    """The keys `time_offset`, `interpolation` and `max_gap` of `[frames]`.

    Raises:
        SequenceError: a value is not finite, or unknown.
    """
    time_offset = float(section.take("time_offset", float, 0.0))
    if not np.isfinite(time_offset):
        raise section.error("time_offset", f"is {time_offset}, but must be a finite number [s].")
    interpolation = section.take_choice("interpolation", INTERPOLATIONS, "linear")
    max_gap = float(section.take("max_gap", float, TimeMatching.max_gap))
    if not 0.0 < max_gap < np.inf:
        raise section.error("max_gap", f"is {max_gap}, but must be a positive number [s].")
    return TimeMatching(time_offset, interpolation, max_gap)


@dataclass(frozen=True)
class Neighbours:
    """Rows of a table on both sides of each frame in time."""

    before: Int[np.ndarray, " frames"]
    after: Int[np.ndarray, " frames"]
    share: Float[np.ndarray, " frames"]
    """Interpolation weight of the row after, in [0, 1]."""


@dataclass(frozen=True)
class RowTimes:
    """Origin and times of the rows of a table."""

    path: Path
    """Path of the table, for errors."""
    lines: tuple[int, ...]
    """Line of each row in the table, for errors."""
    times: Float[np.ndarray, " rows"] | None
    """Time of each row in the table's clock, increasing [s]; None where row n belongs to frame n."""

    def neighbours(self, frames: FrameList, matching: TimeMatching, what: str) -> Neighbours:
        """The rows on both sides of each frame in time.

        Args:
            frames: with their times.
            matching: time offset and interpolation.
            what: content of the rows, for errors.

        Raises:
            SequenceError: a frame has no row near enough in time.
        """
        assert self.times is not None and frames.timestamps is not None
        wanted = frames.timestamps + matching.time_offset
        last = len(self.times) - 1
        # Outside the range, both are the row at the end.
        after = np.searchsorted(self.times, wanted).clip(0, last)
        before = np.where(self.times[after] > wanted, after - 1, after).clip(0, last)
        to_before, to_after = np.abs(wanted - self.times[before]), np.abs(self.times[after] - wanted)
        if matching.interpolation == "nearest":
            before = after = np.where(to_before <= to_after, before, after)
            distance = np.minimum(to_before, to_after)
            share = np.zeros(len(wanted))
        else:
            distance = np.maximum(to_before, to_after)
            share = np.where(before == after, 0.0, to_before / np.maximum(to_before + to_after, _ROUNDING))
        if (far := np.flatnonzero(distance > matching.max_gap + _ROUNDING)).size:
            raise self._too_far(frames, matching, far, what)
        return Neighbours(before, after, share)

    def _too_far(self, frames: FrameList, matching: TimeMatching, far: np.ndarray, what: str) -> SequenceError:
        assert self.times is not None and frames.timestamps is not None
        row = far[0]
        wanted = frames.timestamps + matching.time_offset
        after = int(np.searchsorted(self.times, wanted[row]))
        near = " and ".join(
            f"line {self.lines[index]} at {self.times[index]:.6g} s"
            for index in (after - 1, after)
            if 0 <= index < len(self.times)
        )
        return SequenceError(
            f"{self.path} has no {what} for {len(far)} of {counted(len(wanted), 'frame')}. The first is frame "
            f"{frames.frame_ids[row]!r} at {wanted[row]:.6g} s of the table's clock (image time plus time_offset = "
            f"{matching.time_offset:g} s), next to {near}; a row that is used may be {matching.max_gap:g} s away. "
            f"The frames are from {wanted.min():.6g} to {wanted.max():.6g} s, the rows from {self.times[0]:.6g} to "
            f"{self.times[-1]:.6g} s. Correct `time_offset` in [frames] (both clocks are in seconds), leave the frames "
            "out by a table of the others, or allow a larger `max_gap`."
        )


@dataclass(frozen=True)
class JointSamples:
    """Joint positions of the rows of a table."""

    positions: Float[np.ndarray, "rows dofs"]
    """[rad, m]"""
    rows: RowTimes

    def at_times(self, frames: FrameList, matching: TimeMatching) -> Float[np.ndarray, "frames dofs"]:
        """The joint positions of every frame [rad, m].

        Raises:
            SequenceError: a frame has no row near enough in time.
        """
        found = self.rows.neighbours(frames, matching, "joint positions")
        share = found.share[:, None]
        return (1.0 - share) * self.positions[found.before] + share * self.positions[found.after]

    def logged_at(self, times: Float[np.ndarray, " times"]) -> Float[np.ndarray, "times dofs"]:
        """Joint positions at times of the table's clock [rad, m]; NaN outside its range."""
        assert self.rows.times is not None
        known = self.rows.times
        return np.stack([np.interp(times, known, one, left=np.nan, right=np.nan) for one in self.positions.T], 1)


@dataclass(frozen=True)
class PoseSamples:
    """Poses of a camera's mount of the rows of a table."""

    Ts_world_mount: Float[np.ndarray, "rows 4 4"]
    """[m]"""
    rows: RowTimes

    def at_times(self, frames: FrameList, matching: TimeMatching) -> Float[np.ndarray, "frames 4 4"]:
        """T_world_mount of every frame [m]; positions are interpolated linearly, rotations spherically.

        Raises:
            SequenceError: a frame has no row near enough in time.
        """
        found = self.rows.neighbours(frames, matching, "camera poses")
        # Fractional row numbers.
        return self._between(found.before + found.share * (found.after - found.before))

    def logged_at(self, times: Float[np.ndarray, " times"]) -> Float[np.ndarray, "times 4 4"]:
        """T_world_mount at times of the table's clock [m]; NaN outside its range."""
        assert self.rows.times is not None
        numbers = np.arange(len(self.rows.times), dtype=np.float64)
        places = np.interp(times, self.rows.times, numbers, left=np.nan, right=np.nan)
        Ts = self._between(np.nan_to_num(places))
        Ts[np.isnan(places)] = np.nan
        return Ts

    def _between(self, places: Float[np.ndarray, " places"]) -> Float[np.ndarray, "places 4 4"]:
        """Poses at fractional row numbers, from 0."""
        if len(self.Ts_world_mount) == 1:
            return np.tile(self.Ts_world_mount, (len(places), 1, 1))
        rows, points = np.arange(len(self.Ts_world_mount)), self.Ts_world_mount[:, :3, 3]
        Ts = np.tile(np.eye(4), (len(places), 1, 1))
        Ts[:, :3, :3] = Slerp(rows, Rotation.from_matrix(self.Ts_world_mount[:, :3, :3]))(places).as_matrix()
        Ts[:, :3, 3] = np.stack([np.interp(places, rows, one) for one in points.T], 1)
        return Ts


def row_times(table: Table, column: str, asked_by: str) -> Float[np.ndarray, " rows"]:
    """The time of every row [s].

    Raises:
        SequenceError: no such column, not numbers, or not increasing.
    """
    times = table.numbers(column, asked_by)
    if (wrong := np.flatnonzero(np.diff(times) <= 0.0)).size:
        row = wrong[0] + 1
        raise SequenceError(
            f"{table.path}, line {table.lines[row]}, column {column!r}: {times[row]:.9g} s does not come after "
            f"{times[row - 1]:.9g} s in line {table.lines[row - 1]}. Sort the rows by time, and keep one of each time."
        )
    return times


@dataclass(frozen=True)
class Rows:
    """The tables of a sequence, as `[kinematics]` and `[frames]` describe them."""

    frames: FrameList
    matching: TimeMatching | None
    """Matching of rows and frames by time; None where every row is a frame."""
    table: Table
    """Measured joint positions."""
    truth: Path | None
    """Table of true joint positions."""
    delimiter: str
    names: FrameNames | None
    """Column and pattern of the frames' ids; None where rows are matched by time."""
    timestamp: str
    """Column with the time of a row; empty without one."""

    def measured_of(self, arm: TomlTable, columns: JointColumns) -> JointSamples:
        """The measured joint positions of an arm, from its own `table` or that of the sequence.

        Raises:
            SequenceError: the table is missing, wrong, or has other frames.
        """
        own = arm.take("table", str, "")
        return self._samples(self.read(arm.path(own)) if own else self.table, columns)

    def truth_of(self, arm: TomlTable, columns: JointColumns) -> JointSamples | None:
        """The true joint positions of an arm, from its own `truth` or that of the sequence; None without either.

        Raises:
            SequenceError: the table is missing, wrong, or has other frames.
        """
        own = arm.take("truth", str, "")
        path = arm.path(own) if own else self.truth
        return None if path is None else self._samples(self.read(path), columns)

    def read(self, path: Path) -> Table:
        """Another table with the same frames, or of the same clock.

        Raises:
            SequenceError: the table is missing, wrong, or has other frames.
        """
        table = read_table(path, self.delimiter)
        if self.names is not None:
            _check_same_frames(table, self.names.of(table), self.frames.frame_ids)
        return table

    def times_of(self, table: Table) -> RowTimes:
        """Times of the rows of a table.

        Raises:
            SequenceError: there is no such column, or the times do not increase.
        """
        times = None if self.matching is None else row_times(table, self.timestamp, "`timestamp` in [kinematics]")
        return RowTimes(table.path, table.lines, times)

    def _samples(self, table: Table, columns: JointColumns) -> JointSamples:
        return JointSamples(columns.read(table), self.times_of(table))


def take_rows(section: TomlTable, frames_section: TomlTable | None) -> Rows:
    """Read the tables that `[kinematics]` and `[frames]` describe.

    Args:
        section: `[kinematics]`.
        frames_section: `[frames]`, whose times the rows are matched with; None where every row is a frame.

    Raises:
        SequenceError: a table is missing, or its frames, times or numbers are wrong.
    """
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
                raise section.error(key, "describes frames, which [frames] does here. Move it there.")
        if not timestamp:
            raise section.error(
                "timestamp", "is missing: with [frames], rows are matched by time. Name the column with the time [s]."
            )
        names, matching = None, take_matching(frames_section)
        frames = take_frame_list(frames_section)
        frames_section.finish()
    section.finish()
    return Rows(frames, matching, table, section.path(truth) if truth else None, delimiter, names, timestamp)


def _check_same_frames(table: Table, ids: tuple[str, ...], wanted: tuple[str, ...]) -> None:
    if len(ids) != len(wanted):
        raise SequenceError(
            f"{table.path} has {counted(len(ids), 'row')}, but the kinematics table has {len(wanted)}. "
            "All tables of a sequence must have the same frames in the same order."
        )
    for given, expected, line in zip(ids, wanted, table.lines, strict=True):
        if given != expected:
            raise SequenceError(
                f"{table.path}, line {line} is frame {given!r}, but the kinematics table has frame {expected!r} there. "
                "All tables of a sequence must have the same frames in the same order."
            )


POSES = ("T_world_mount", "T_mount_world")
POSITION, ORIENTATION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
"""Columns of a pose by default [m], unit quaternion."""

_UNITS = {"m": 1.0, "mm": 1e-3}
_NORM_TOLERANCE = 0.01
"""Largest deviation of a quaternion's norm from 1."""
_FARTHEST = 100.0
"""Largest distance of the mount from the origin [m]."""


def take_camera_motion(table: TomlTable, rows: Rows) -> PoseSamples | None:
    """The key `motion` of a `[[cameras]]` table; None without one.

    Raises:
        SequenceError: the table is missing, has other frames, or a pose is impossible.
    """
    given = table.take("motion", (str, dict), {})
    if not given:
        return None
    values = {"table": given} if isinstance(given, str) else given
    section = TomlTable(values, table.file, f"{table.where}: motion")
    poses = rows.read(section.path(section.take("table", str)))
    joints = section.take("ecm_joints", list, [])
    if joints:
        Ts = forward(_numbers(section, "ecm_joints", poses, joints, len(JOINT_NAMES)))
        _check_joints(section, poses, joints)
    else:
        Ts = _poses(section, poses)
    section.finish()
    return PoseSamples(Ts, rows.times_of(poses))


def _poses(section: TomlTable, table: Table) -> Float[np.ndarray, "rows 4 4"]:
    kind = section.take_choice("pose", POSES, POSES[0])
    unit = _UNITS[section.take_choice("length_unit", tuple(_UNITS), "m")]
    positions = unit * _numbers(section, "position", table, section.take("position", list, list(POSITION)), 3)
    turns = _numbers(section, "orientation", table, section.take("orientation", list, list(ORIENTATION)), 4)
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(turns, axis=1)
    if (wrong := np.flatnonzero(~(np.abs(lengths - 1.0) <= _NORM_TOLERANCE))).size:
        raise SequenceError(
            f"{table.path}, line {table.lines[wrong[0]]}: the quaternion has the length {lengths[wrong[0]]:.4g}, it "
            "must be 1. Name its columns as `orientation`, in the order x, y, z, w."
        )
    if (far := np.flatnonzero(~(np.abs(positions).max(1) <= _FARTHEST))).size:
        raise SequenceError(
            f"{table.path}, line {table.lines[far[0]]}: the camera is {np.abs(positions[far[0]]).max():.4g} m away, "
            f'{_FARTHEST:g} m is allowed. If the columns are in mm, say so: length_unit = "mm".'
        )
    Ts = np.tile(np.eye(4), (len(table), 1, 1))
    Ts[:, :3, :3], Ts[:, :3, 3] = Rotation.from_quat(turns).as_matrix(), positions
    return Ts if kind == POSES[0] else np.linalg.inv(Ts)


def _numbers(section: TomlTable, key: str, table: Table, columns: list, count: int) -> Float[np.ndarray, "rows n"]:
    if len(columns) != count or not all(isinstance(column, str) for column in columns):
        raise section.error(key, f"is {columns!r}. Give the names of {count} columns.")
    return np.column_stack([table.numbers(column, section.name(key)) for column in columns])


def _check_joints(section: TomlTable, table: Table, columns: list[str]) -> None:
    """Check that joints of the ECM are plausible in rad and m."""
    for column, joint in zip(columns, JOINT_NAMES, strict=True):
        kind = "prismatic" if joint == "insertion" else "revolute"
        largest = np.abs(table.numbers(column, section.name("ecm_joints"))).max()
        if largest > PLAUSIBLE[kind]:
            raise section.error(
                "ecm_joints", f"has {joint} at {largest:.4g}; {PLAUSIBLE[kind]:.3g} is allowed. Give [rad] and [m]."
            )
