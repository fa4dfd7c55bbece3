"""Kinematics tables: CSV files whose columns are joint positions in given units."""

import csv
import io
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from operator import itemgetter
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..errors import SequenceError
from ..files.reading import ROBOT, TABLE, open_regular, read_text
from ..model.instruments import robot_file
from ..model.robot import Robot, parsed_urdf
from ..wording import closest, listed, shown
from .toml_table import TomlTable

MAX_CELLS = 10_000_000
"""Maximum number of cells of a table; one hour at 100 rows per second allows 27 columns."""


class TableError(SequenceError):
    """Error of a sequence's table.

    Attributes:
        path: path of the table.
        row: index of the row; None for the whole table.
        text: message, which follows the location.
    """

    def __init__(self, path: Path, text: str, row: int | None = None, line: int | None = None) -> None:
        super().__init__(f"{path}{'' if line is None else f', line {line}'}{text}")
        self.path, self.text, self.row = path, text, row


@dataclass(frozen=True)
class Table:
    """CSV file as text; cells are parsed when their column is requested."""

    path: Path
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    """Number of the line in which each row ends, from 1."""

    def __len__(self) -> int:
        return len(self.rows)

    def text(self, column: str, key: str) -> list[str]:
        """Cells of a column as text."""
        return [cell.strip() for cell in self._cells(column, key)]

    def numbers(self, column: str, key: str) -> Float[np.ndarray, " rows"]:
        """Values of a column as numbers."""
        try:
            values = np.fromiter(map(float, self._cells(column, key)), np.float64, len(self))
        except ValueError:
            # This slower loop finds the cell that is not a number.
            values = np.fromiter(map(_number, self._cells(column, key)), np.float64, len(self))
        if (wrong := np.flatnonzero(~np.isfinite(values))).size:
            cell = self.text(column, key)[wrong[0]]
            raise self.error(
                f", column {column!r}: {shown(cell)} is not a finite number. Correct the cell, or remove the row and, "
                "if images are numbered by row, its image.",
                wrong[0],
            )
        return values

    def error(self, text: str, row: int | np.integer | None = None) -> TableError:
        """Create an error about the table or one of its rows."""
        return TableError(self.path, text) if row is None else TableError(self.path, text, int(row), self.lines[row])

    def _cells(self, column: str, key: str) -> Iterator[str]:
        """Cells of a column as text, not yet stripped."""
        if column not in self.header:
            raise self.error(
                f" has no column {column!r}, which {key} names.{closest(column, self.header)} "
                f"Its columns are: {listed(self.header)}."
            )
        return map(itemgetter(self.header.index(column)), self.rows)


def read_table(path: Path, delimiter: str = ",", what: str = "kinematics table") -> Table:
    """Read a CSV file, named `what` in errors; blank lines are skipped."""
    rows: list[tuple[str, ...]] = []
    lines: list[int] = []
    cells = 0
    try:
        with io.TextIOWrapper(open_regular(path, TABLE), encoding="utf-8-sig", newline="") as handle:
            reader = csv.reader(handle, delimiter=delimiter, skipinitialspace=True)
            for row in filter(any, reader):
                rows.append(tuple(row))  # Python's garbage collector untracks tuples, but not lists.
                lines.append(reader.line_num)
                cells += len(row)
                if cells > MAX_CELLS:
                    raise SequenceError(f"{what} {path} has more than {MAX_CELLS:,} cells. Divide the recording.")
    except (FileNotFoundError, IsADirectoryError) as error:
        raise SequenceError(f"{what} {path} is missing. Correct the path in the sequence file.") from error
    except (OSError, ValueError, csv.Error) as error:
        raise SequenceError(f"{what} {path} is not a readable CSV file: {error}.") from error
    if len(rows) < 2:
        raise SequenceError(f"{what} {path} has no rows. It needs a header and at least one row.")
    header = tuple(name.strip() for name in rows[0])
    if len(header) == 1 and (found := next((mark for mark in ";\t," if mark in header[0]), None)):
        raise SequenceError(
            f"the cells of {path} are not separated by {delimiter!r}, but probably by {found!r}. "
            f"Set `delimiter = {found!r}` in [kinematics], or in [frames] for a table of frames; the decimal separator "
            "must be a point."
        )
    repeated = sorted(name for name, count in Counter(header).items() if name and count > 1)
    if repeated:
        raise SequenceError(f"{path} has duplicate columns: {listed(map(repr, repeated))}. Rename the duplicates.")
    if set(map(len, rows)) != {len(header)}:
        line, row = next((line, row) for line, row in zip(lines, rows, strict=True) if len(row) != len(header))
        raise SequenceError(
            f"{path}, line {line} has {len(row)} cells, but the header has {len(header)}. Correct the row."
        )
    return Table(path, header, tuple(rows[1:]), tuple(lines[1:]))


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


ANGLE_UNITS: Mapping[str, float] = {"rad": 1.0, "deg": float(np.pi / 180)}
"""Angle unit -> [rad]; without "percent", which depends on the joint limits."""
LENGTH_UNITS: Mapping[str, float] = {"m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3}
"""Length unit -> [m]."""
PERCENT = "percent"
"""Unit in which the range of the joint is -100 to 100."""
_BEYOND = 0.15
"""Share of a joint's range by which positions may exceed its limits."""
FAR = 0.5
"""Share of a joint's range beyond its limits above which the unit is considered wrong."""
_FEW = 0.02
"""Share of rows that may exceed the limits, for example because of encoder spikes."""


@dataclass(frozen=True)
class Joint:
    """An independent joint of a robot."""

    name: str
    revolute: bool
    lower: float
    """Lower limit [rad], [m]; infinite if not given."""
    upper: float

    @property
    def kind(self) -> str:
        """Type of the joint, as in `Robot.joint_types`."""
        return "revolute" if self.revolute else "prismatic"

    @property
    def unit(self) -> str:
        """SI unit of the joint."""
        return "rad" if self.revolute else "m"

    @property
    def units(self) -> Mapping[str, float]:
        """Unit -> [rad] or [m]; without percent."""
        return ANGLE_UNITS if self.revolute else LENGTH_UNITS

    def beyond(self, values: Float[np.ndarray, " rows"], share: float = _BEYOND) -> np.ndarray:
        """Mask of positions [rad], [m] that exceed the limits by more than a share of the joint's range."""
        if not np.isfinite([self.lower, self.upper]).all():
            return np.zeros(len(values), bool)
        margin = share * (self.upper - self.lower)
        return (values < self.lower - margin) | (values > self.upper + margin)

    def fits(self, values: Float[np.ndarray, " rows"], share: float = _BEYOND) -> bool:
        """Whether nearly all positions are within the limits."""
        return bool(self.beyond(values, share).mean() <= _FEW)

    def from_percent(self, values: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        """Convert positions from percent of the range (-100 to 100) to [rad] or [m]."""
        return self.lower + (values + 100) / 200 * (self.upper - self.lower)


def joints_of(robot: str | Path) -> tuple[Joint, ...]:
    """Independent joints of a robot, in the order of its URDF."""
    return _joints_of(robot_file(robot).absolute())


@lru_cache(maxsize=16)
def _joints_of(urdf: Path) -> tuple[Joint, ...]:
    found = []
    for joint in parsed_urdf(read_text(urdf, ROBOT), urdf).iter("joint"):
        kind = joint.get("type")
        if kind not in ("revolute", "continuous", "prismatic") or joint.find("mimic") is not None:
            continue
        limit = joint.find("limit")
        lower, upper = -np.inf, np.inf
        if limit is not None and kind != "continuous":
            lower, upper = float(limit.get("lower", "0")), float(limit.get("upper", "0"))
        if lower >= upper:
            lower, upper = -np.inf, np.inf
        found.append(Joint(joint.get("name", ""), kind != "prismatic", lower, upper))
    return tuple(found)


PLAUSIBLE = {"revolute": 4 * np.pi, "prismatic": 2.0}
"""Maximum plausible joint position [rad], [m]; larger values indicate a wrong unit."""


@dataclass(frozen=True)
class JointColumn:
    """Linear map from a column to a joint: position = column * scale + offset."""

    joint: Joint
    column: str
    scale: float
    """Scale [rad or m per unit of the column]."""
    offset: float
    """Offset [rad] or [m]."""
    unit: str
    given: bool = False
    """Whether the file states the unit, so that positions beyond the limits are accepted."""

    def read(self, table: Table, key: str) -> Float[np.ndarray, " rows"]:
        """Read the joint positions of all rows [rad], [m]."""
        joint, where = self.joint, f"column {self.column!r}"
        with np.errstate(over="ignore", invalid="ignore"):
            values = table.numbers(self.column, f"{key} {joint.name}") * self.scale + self.offset
        allowed, other = PLAUSIBLE[joint.kind], "deg" if joint.revolute else "mm"
        if not (worst := np.abs(values).max()) <= allowed:
            raise table.error(
                f", {where}: read in {self.unit}, joint {joint.name!r} is at {worst:.4g} {joint.unit}, which no "
                f"instrument reaches ({allowed:.3g} {joint.unit} is allowed). If the column is in {other}, set "
                f'{joint.name} = {{ column = "{self.column}", unit = "{other}" }}.',
                np.abs(values).argmax(),
            )
        if self.given or joint.fits(values, FAR):
            return values
        # The unit is not stated, and another unit may fit the limits of the robot.
        fitting = [unit for unit, factor in joint.units.items() if factor != 1.0 and joint.fits(values * factor)]
        if fitting:
            option = "angle_unit" if joint.revolute else "length_unit"
            raise table.error(
                f", {where}: read in {joint.unit}, the positions of joint {joint.name!r} range from "
                f"{values.min():.4g} to {values.max():.4g} {joint.unit}, but its limits are {joint.lower:.4g} to "
                f"{joint.upper:.4g}. "
                f'Set the unit in [[arms]]: {option} = "{fitting[0]}" or "{PERCENT}" (-100 to 100 of the range), or '
                f'"{joint.unit}" if it is correct.'
            )
        return values


@dataclass(frozen=True)
class JointColumns:
    """Mapping from the columns of a table to the joint positions of a robot."""

    robot: Robot
    columns: tuple[JointColumn, ...]
    defaults: Mapping[str, float]
    """Constant position [rad], [m] of each joint that the table does not measure."""
    key: str
    """Name of the mapping, for errors."""

    @property
    def measured(self) -> tuple[str, ...]:
        """Joints that have a column, in the robot's order."""
        mapped = {column.joint.name for column in self.columns}
        return tuple(name for name in self.robot.joint_names if name in mapped)

    def read(self, table: Table) -> Float[np.ndarray, "rows dofs"]:
        """Read the joint positions of all rows [rad], [m], in the robot's order; errors as in `JointColumn.read`."""
        names = self.robot.joint_names
        positions = np.tile([self.defaults.get(name, 0.0) for name in names], (len(table), 1))
        for column in self.columns:
            positions[:, names.index(column.joint.name)] = column.read(table, self.key)
        return positions


def take_joints(table: TomlTable, robot: Robot) -> JointColumns:
    """Read the keys `joints`, `defaults`, `angle_unit` and `length_unit` of an `[[arms]]` table."""
    units = {
        "revolute": (table.take_choice("angle_unit", (*ANGLE_UNITS, PERCENT), "rad"), "angle_unit" in table),
        "prismatic": (table.take_choice("length_unit", (*LENGTH_UNITS, PERCENT), "m"), "length_unit" in table),
    }
    mapping, defaults = table.take_table("joints"), table.take_table("defaults")
    columns = tuple(_take_column(mapping, name, robot, units) for name in mapping.items())
    values: dict[str, float] = {}
    for name in defaults.items():
        largest = PLAUSIBLE[_joint(defaults, name, robot).kind]
        values[name] = float(defaults.take(name, float))
        if abs(values[name]) > largest:
            raise defaults.error(name, f"is {values[name]:g}; allowed: up to {largest:.3g} [rad or m].")
        if name in mapping:
            raise defaults.error(name, "is given, but the joint also has a column in [arms.joints]. Remove one.")
    for name in robot.joint_names:
        if name not in mapping and name not in values:
            raise mapping.error(
                name,
                f"is missing: robot {robot.name!r} has this joint. Name its column here, or give its constant position "
                f"[{_joint(mapping, name, robot).unit}] under [arms.defaults], such as {name} = 0.0.",
            )
    return JointColumns(robot, columns, values, mapping.where)


def _joint(table: TomlTable, name: str, robot: Robot) -> Joint:
    if name not in robot.joint_names:
        raise table.error(
            name,
            f"is not a joint of robot {robot.name!r} ({robot.urdf}).{closest(name, robot.joint_names)} "
            f"Its joints are: {', '.join(robot.joint_names)}.",
        )
    index = robot.joint_names.index(name)
    return Joint(name, robot.joint_types[index] == "revolute", *robot.joint_limits[index].tolist())


def _take_column(mapping: TomlTable, name: str, robot: Robot, units: Mapping[str, tuple[str, bool]]) -> JointColumn:
    joint = _joint(mapping, name, robot)
    unit, given = units[joint.kind]
    value = mapping.take(name, (str, dict))
    if isinstance(value, str):
        return JointColumn(joint, value, *_conversion(joint, unit, robot), unit, given)
    entry = TomlTable(value, mapping.file, f"{mapping.where}: {name}")
    given = given or "unit" in entry or "scale" in entry
    unit = entry.take_choice("unit", (*joint.units, PERCENT), unit)
    scale, offset = _conversion(joint, unit, robot)
    scale, offset = scale * float(entry.take("scale", float, 1.0)), offset + float(entry.take("offset", float, 0.0))
    column = entry.take("column", str)
    entry.finish()
    return JointColumn(joint, column, scale, offset, unit, given)


def _conversion(joint: Joint, unit: str, robot: Robot) -> tuple[float, float]:
    """Scale and offset that convert a unit to [rad] or [m]; percent refers to the limits of the joint."""
    if unit != PERCENT:
        return joint.units[unit], 0.0
    if not np.isfinite([joint.lower, joint.upper]).all():
        raise SequenceError(
            f"joint {joint.name!r} of {robot.urdf} has no limits, so {PERCENT} cannot be converted. Give another unit."
        )
    return (joint.upper - joint.lower) / 200, (joint.upper + joint.lower) / 2
