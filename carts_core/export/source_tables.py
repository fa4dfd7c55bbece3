"""Recorded tables of an imported sequence: their rows, and the corrected values of their columns.

An import converts recorded columns to joint positions [rad, m]. To write results back, the conversion of each column is
identified by comparing the column with the imported positions of all frames: a joint's column is `scale * position +
offset`, and the tip poses of an arm are T_reference_base T_base_tip(joint positions) T_tip_point. A recording whose
columns are not related to the sequence in this way is another recording, and is refused.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation

from ..errors import SequenceError
from ..model.psm_kinematics import JOINT_NAMES, PsmGeometry, forward
from ..model.robot import Robot
from ..recording import Sequence as Recording
from ..recording.importing.columns import ColumnMeanings, arm_in, guess_columns
from ..recording.importing.foreign_tables import ForeignTable
from ..recording.importing.found import PartError
from ..recording.importing.logs import ACCEPTED, CANDIDATES, fit_base_frame, fit_tool_point, transforms
from ..recording.kinematics_table import LENGTH_UNITS
from ..settings.interchange import ImportOptions
from ..wording import counted
from .dataset import Dataset

POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
"""Components of a tip pose: position and quaternion."""
_SCALES = tuple(sign * scale for scale in (1.0, 180.0 / np.pi, 1e3, 1e2, 10.0) for sign in (1.0, -1.0))
"""Scales of columns in the units of the importer, with both signs [1 per rad or m]."""
_ROUNDING, _SINGLE = 2e-9, 2e-7
"""Rounding of imported positions [rad, m], and relative rounding of single-precision columns."""
_SAME_TIME = 1e-5
"""Maximum difference of times that were rounded to single precision [s]."""
_MIN_TOOL_POINT_ROWS = 4
"""Minimum number of rows for the estimate of a point of the tool, which has three parameters."""
_IDENTITY = 1e-6
"""Deviation from the identity [m, 1] below which a fitted transform is considered the identity."""


def source_of(recording: Path | None, sequence: Recording) -> Path:
    """Path of the recording that a sequence was imported from: the given one, else that of the sequence file.

    Raises:
        SequenceError: no recording is known, or it does not exist.
    """
    path = recording or sequence.recording
    if path is None:
        raise SequenceError(
            f"{sequence.path} does not name the recording it was imported from, and this format adds the results to "
            "its tables. Give the recording: --recording PATH, or the key `recording` in the sequence file."
        )
    if not path.exists():
        raise SequenceError(f"the recording {path} is missing. Give its current path: --recording PATH.")
    return path.absolute()


def as_imported(sequence: Recording) -> Recording:
    """The sequence with the joint positions of its file at a time offset of 0, which are those of the recorded rows."""
    opened = Recording.open(sequence.path)
    return opened if opened.matching is None else opened.with_time_offset(0.0, of_arms=False)


def rows_of_frames(
    sequence: Recording, rows: int, times: Float[ndarray, " rows"] | None, where: object
) -> Int[ndarray, " frames"]:
    """Row of each frame, for recordings whose frame ids are row numbers from 0.

    Args:
        sequence: the sequence, whose timestamps count from its first frame.
        rows: number of rows of the recording.
        times: times of the rows [s]; not compared if None.
        where: the recording, for errors.

    Raises:
        SequenceError: a frame has no row, or a frame and its row differ in time.
    """
    numbers = [int(frame) if frame.isdecimal() else -1 for frame in sequence.frame_ids]
    if wrong := [frame for frame, row in zip(sequence.frame_ids, numbers, strict=True) if not 0 <= row < rows]:
        raise SequenceError(
            f"{where} has {counted(rows, 'row')}, but frame {wrong[0]!r} of {sequence.path} is not one of them. Give "
            "the recording from which the sequence was imported: --recording PATH."
        )
    found = np.array(numbers, int)
    if times is not None and sequence.timestamps is not None:
        own = times[found] - times[found].min()
        late = np.abs(own - (sequence.timestamps - sequence.timestamps.min()))
        if late.max() > _SAME_TIME + 1e-6 * own.max():
            worst = int(late.argmax())
            raise SequenceError(
                f"frame {sequence.frame_ids[worst]!r} of {sequence.path} and its row of {where} are "
                f"{late[worst]:.4g} s apart. Give the recording from which the sequence was imported: --recording PATH."
            )
    return found


def frame_positions(
    dataset: Dataset,
) -> tuple[dict[str, Float[ndarray, "frames dofs"]], Bool[ndarray, " frames"]]:
    """Joint positions of all frames of the sequence, and whether they replace those of the frames' rows.

    Returns:
        Arm -> joint positions [rad, m]; and the replaced frames. These are the corrected frames, or with a time offset
        all, since their rows are of other times than their images.
    """
    sequence, matching = dataset.sequence, dataset.sequence.matching
    changed = np.zeros(len(sequence), bool)
    if matching is not None and (matching.time_offset or any(sequence.arm_time_offsets.values())):
        # The joint positions of the dataset's sequence may be corrected ones.
        sequence = sequence.with_time_offset(matching.time_offset)
        changed[:] = True
    positions = {arm: values.copy() for arm, values in sequence.measured.items()}
    for frame in dataset.frames:
        if frame.source != "measured":
            changed[frame.index] = True
            for arm, values in frame.joint_positions.items():
                positions[arm][frame.index] = values
    return positions, changed


@dataclass(frozen=True, eq=False)
class JointMap:
    """Conversion of one joint: column = scale * position + offset."""

    joint: str
    index: int
    """Index of the joint in `Robot.joint_names`."""
    column: str
    scale: float
    offset: float


@dataclass(frozen=True, eq=False)
class PoseMap:
    """Conversion of the joint positions of a PSM to tip poses."""

    joints: tuple[int, ...]
    """Indices of the six joints of the PSM in `Robot.joint_names`."""
    columns: tuple[str, ...]
    """Columns of the pose, in the order of `POSE`."""
    geometry: PsmGeometry
    T_reference_base: Float[ndarray, "4 4"]
    T_tip_point: Float[ndarray, "4 4"]
    scale: float
    """Scale of lengths [1 per m]."""

    def poses(self, joints: Float[ndarray, "rows 6"]) -> Float[ndarray, "rows 7"]:
        """Poses at joint positions [rad, m], in the units of the columns."""
        Ts = self.T_reference_base @ forward(joints, self.geometry) @ self.T_tip_point
        return np.column_stack([Ts[:, :3, 3] * self.scale, Rotation.from_matrix(Ts[:, :3, :3]).as_quat()])


@dataclass(frozen=True, eq=False)
class ColumnMaps:
    """Conversions of the joint positions of an arm to columns of a table."""

    arm: str
    rows: Int[ndarray, " n"]
    """Row of each frame, or of each logged row of the sequence."""
    joints: tuple[JointMap, ...]
    pose: PoseMap | None

    @property
    def meanings(self) -> dict[str, str]:
        """Column -> `ARM.JOINT`, or `ARM.tip.COMPONENT`."""
        tip = {} if self.pose is None else dict(zip(self.pose.columns, POSE, strict=True))
        joints = {one.column: f"{self.arm}.{one.joint}" for one in self.joints}
        return {**joints, **{column: f"{self.arm}.tip.{part}" for column, part in tip.items()}}

    def columns(self, positions: Float[ndarray, "n dofs"], table: ForeignTable) -> dict[str, Float[ndarray, " n"]]:
        """Columns at joint positions [rad, m] of `rows`; quaternions have the signs of those in the table, since a
        quaternion and its negative are the same rotation."""
        found = {one.column: one.scale * positions[:, one.index] + one.offset for one in self.joints}
        if self.pose is not None:
            values = self.pose.poses(positions[:, self.pose.joints])
            recorded = np.stack([table.numbers(name)[self.rows] for name in self.pose.columns[3:]], 1)
            values[:, 3:] *= np.where((values[:, 3:] * recorded).sum(1) < 0, -1.0, 1.0)[:, None]
            found |= dict(zip(self.pose.columns, values.T, strict=True))
        return found


T = TypeVar("T")


def matched_arms(
    arms: Iterable[str], recorded: Iterable[str], fit: Callable[[str, str], T | None]
) -> dict[str, tuple[str, T]]:
    """Recorded arm of each arm, which may have another name, and its fit.

    Args:
        arms: arms of the sequence.
        recorded: arms of the recording.
        fit: compares the values of an arm and a recorded arm; None if they differ. Equal names are compared first.
    """
    found: dict[str, tuple[str, T]] = {}
    for arm, name in sorted(product(arms, recorded), key=lambda pair: pair[0] != pair[1]):
        if arm not in found and name not in {other for other, _ in found.values()}:
            fitting = fit(arm, name)
            if fitting is not None:
                found[arm] = name, fitting
    return found


def column_meanings(table: ForeignTable, sequence: Recording) -> ColumnMeanings:
    """Meanings of the columns of a table by their names; without arms if none is recognized."""
    robots = {
        arm.name: str(arm.robot.urdf)
        for arm in sequence.scene.arms
        if not set(JOINT_NAMES) <= set(arm.robot.joint_names)
    }
    try:
        return guess_columns(table, ImportOptions(robot=robots))
    except PartError:
        return replace(guess_columns(table, ImportOptions()), arms={})


def column_maps(
    table: ForeignTable,
    meanings: ColumnMeanings,
    sequence: Recording,
    rows_of: Callable[[str, Sequence[str]], tuple[Int[ndarray, " n"], Float[ndarray, "n dofs"]] | None],
) -> dict[str, ColumnMaps]:
    """Identify the columns of the arms of a sequence by names and values, else by values alone.

    An import may rename arms and choose columns, so names may differ.

    Args:
        rows_of: returns, for an arm and the columns that an import would use, the rows with values and the imported
            joint positions of the arm in these rows [rad, m]; None if their numbers differ.

    Returns:
        Arm -> conversions, for the arms whose values are in the table.
    """
    arms = {arm.name: arm for arm in sequence.scene.arms}
    recorded = {name or arm_in(table.path.stem) or "PSM1": columns for name, columns in meanings.arms.items()}

    def by_name(arm: str, name: str) -> ColumnMaps | None:
        columns, robot = recorded[name], arms[arm].robot
        joints = [joint for joint in robot.joint_names if joint in columns]
        has_pose = set(POSE) <= set(columns) and set(JOINT_NAMES) <= set(robot.joint_names)
        used = POSE if has_pose and not set(JOINT_NAMES) <= set(columns) else joints
        if not used or (found := rows_of(arm, [columns[part] for part in used])) is None:
            return None
        rows, values = found
        joint_columns, pose = joint_maps(robot, columns, table, values, rows), None
        if has_pose:
            places = tuple(columns[part] for part in POSE)
            poses = np.stack([table.numbers(column).astype(np.float64)[rows] for column in places], 1)
            pose = pose_map(robot, places, poses, values)
        # A jaw does not identify an arm of another name.
        identified = pose is not None or any(arm == name or one.joint != "jaw" for one in joint_columns)
        return ColumnMaps(arm, rows, tuple(joint_columns), pose) if identified else None

    def by_value(arm: str) -> ColumnMaps | None:
        if not numeric or (found := rows_of(arm, numeric)) is None:
            return None
        rows, values = found
        wanted, columns = sequence.measured_joints[arm], {}
        for joint in wanted:
            fitting = [one for one in numeric if joint_maps(arms[arm].robot, {joint: one}, table, values, rows)]
            columns |= {joint: fitting[0]} if len(fitting) == 1 else {}
        # Joints that do not move may fit several columns, or share one.
        if not {*wanted} - {"jaw"} <= columns.keys() or len({*columns.values()}) < len(columns):
            return None
        return ColumnMaps(arm, rows, tuple(joint_maps(arms[arm].robot, columns, table, values, rows)), None)

    found = {arm: maps for arm, (_, maps) in matched_arms(arms, recorded, by_name).items()}
    taken = {column for maps in found.values() for column in maps.meanings}
    numeric = [name for name, values in table.columns.items() if values.dtype.kind in "iuf" and name not in taken]
    return found | {arm: maps for arm in arms if arm not in found and (maps := by_value(arm)) is not None}


def joint_maps(
    robot: Robot,
    columns: Mapping[str, str],
    table: ForeignTable,
    measured: Float[ndarray, "n dofs"],
    rows: Int[ndarray, " n"],
) -> list[JointMap]:
    """Conversions of the joints of an arm (joint -> column) whose values fit; empty unless those of all joints but the
    jaw fit."""
    found: list[JointMap] = []
    names = [name for name in robot.joint_names if name in columns]
    for name in names:
        index = robot.joint_names.index(name)
        values, positions = table.numbers(columns[name]).astype(np.float64)[rows], measured[:, index]
        used = np.ones(len(values), bool)
        if name == "jaw" and (positions > 0).any():
            used = positions > 0  # Negative jaw angles are imported as 0.
        limits = robot.joint_limits[index].tolist()
        fit = _linear(values[used], positions[used], limits)
        if fit is not None:
            found.append(JointMap(name, index, columns[name], *fit))
        elif name != "jaw":
            return []
    return found


def _linear(
    values: Float[ndarray, " n"], positions: Float[ndarray, " n"], limits: Sequence[float]
) -> tuple[float, float] | None:
    """Scale and offset that convert positions to the values of a column; None if no known unit fits."""
    candidates = [(scale, 0.0) for scale in _SCALES]
    lower, upper = limits
    if np.isfinite([lower, upper]).all() and upper > lower:
        # Percent of the range: -100 to 100, or 0 to 100 as of LeRobot's grippers.
        for least in (-100.0, 0.0):
            percent = (100.0 - least) / (upper - lower)
            candidates += [(sign * percent, least - percent * lower) for sign in (1.0, -1.0)]
    for scale, offset in candidates:
        rounding = abs(scale) * _ROUNDING + _SINGLE * np.abs(values)
        if (np.abs(scale * positions + offset - values) <= rounding).all():
            return scale, offset
    return None


def pose_map(
    robot: Robot,
    columns: tuple[str, ...],
    values: Float[ndarray, "frames 7"],
    measured: Float[ndarray, "frames dofs"],
) -> PoseMap | None:
    """Conversion of the joint positions of a PSM to recorded tip poses in any frame; None if no instrument fits.

    Instruments and units are tried in order; a later combination is preferred only if its deviation is less than half
    that of the best one so far. Poses of another point of the tool are only tried if those of the tip do not fit.

    Args:
        values: recorded poses: position, and quaternion x y z w.
        measured: joint positions of the same frames [rad, m].
    """
    indices = tuple(robot.joint_names.index(name) for name in JOINT_NAMES)
    joints = measured[:, indices]
    known: Bool[ndarray, " frames"] = np.isfinite(values).all(1) & (np.linalg.norm(values[:, 3:], axis=1) > 0.5)
    if not known.any():
        return None
    best: PoseMap | None = None
    deviation = ACCEPTED
    for move in (False, True) if known.sum() >= _MIN_TOOL_POINT_ROWS else (False,):
        for unit in LENGTH_UNITS.values():
            Ts = transforms(np.column_stack([values[known, :3] * unit, values[known, 3:]]))
            for geometry in CANDIDATES.values():
                T_tip_point = np.eye(4)
                if move:
                    T_tip_point[:3, 3] = fit_tool_point(Ts, joints[known], geometry)[0]
                fit = fit_base_frame(Ts @ np.linalg.inv(T_tip_point), joints[known], geometry)
                if fit.deviation < deviation:
                    T = fit.T_reference_base
                    T = np.eye(4) if np.abs(T - np.eye(4)).max() < _IDENTITY else T
                    best = PoseMap(indices, columns, geometry, T, T_tip_point, 1.0 / unit)
                    deviation = 0.5 * fit.deviation
        if best is not None:
            return best
    return None
