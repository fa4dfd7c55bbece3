"""Which column of a kinematics table is which joint of a robot, and in which unit."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..errors import SequenceError
from ..model.robot import Robot
from ..wording import closest
from .joint_limits import ANGLE_UNITS, FAR, LENGTH_UNITS, PERCENT, Joint
from .table import Table
from .toml_table import TomlTable

_UNITS = {"revolute": (*ANGLE_UNITS, PERCENT), "prismatic": (*LENGTH_UNITS, PERCENT)}

PLAUSIBLE = {"revolute": 4 * np.pi, "prismatic": 2.0}
"""Largest magnitude [rad], [m] of a joint position; more means that the unit was not given."""


@dataclass(frozen=True)
class JointColumn:
    """joint position = column * scale + offset."""

    joint: str
    column: str
    scale: float
    """[rad or m per unit of the column]"""
    offset: float
    """[rad] or [m]"""
    unit: str
    given: bool = False
    """Whether the file says the unit, so that positions beyond the limits are meant."""


@dataclass(frozen=True)
class JointColumns:
    """How the joint positions of one robot are read from a table."""

    robot: Robot
    columns: tuple[JointColumn, ...]
    defaults: Mapping[str, float]
    """Position [rad], [m] of every joint that the table does not measure."""
    key: str
    """How errors call the mapping."""

    @property
    def measured(self) -> tuple[str, ...]:
        """The joints that have a column, in the robot's order."""
        mapped = {column.joint for column in self.columns}
        return tuple(name for name in self.robot.joint_names if name in mapped)

    def read(self, table: Table) -> Float[np.ndarray, "rows dofs"]:
        """Joint positions of every row [rad], [m], in the order of `Robot.joint_names`.

        Raises:
            SequenceError: a column is missing, a cell is not a finite number, or values cannot be in the given unit.
        """
        names = self.robot.joint_names
        positions = np.tile([self.defaults.get(name, 0.0) for name in names], (len(table), 1))
        for column in self.columns:
            index = names.index(column.joint)
            with np.errstate(over="ignore", invalid="ignore"):
                values = table.numbers(column.column, f"{self.key} {column.joint}") * column.scale + column.offset
            kind = self.robot.joint_types[index]
            if not (worst := np.abs(values).max()) <= PLAUSIBLE[kind]:
                symbol, other = ("rad", "deg") if kind == "revolute" else ("m", "mm")
                raise SequenceError(
                    f"{table.path}, line {table.lines[int(np.abs(values).argmax())]}, column {column.column!r}: read "
                    f"as {column.unit}, joint {column.joint!r} is at {worst:.4g} {symbol}, which no instrument reaches "
                    f"({PLAUSIBLE[kind]:.3g} {symbol} is allowed). If the column is in {other}, say so: "
                    f'{column.joint} = {{ column = "{column.column}", unit = "{other}" }}.'
                )
            self._check_limits(table, column, index, values)
            positions[:, index] = values
        return positions

    def _check_limits(self, table: Table, column: JointColumn, index: int, values: np.ndarray) -> None:
        """See that positions whose unit is not given are not far beyond the limits of the robot.

        Raises:
            SequenceError: they are, and another unit would fit.
        """
        low, high = self.robot.joint_limits[index].tolist()
        joint = Joint(column.joint, self.robot.joint_types[index] == "revolute", low, high)
        if column.given or joint.fits(values, FAR):
            return
        units = ANGLE_UNITS if joint.revolute else LENGTH_UNITS
        fitting = [unit for unit, factor in units.items() if factor != 1.0 and joint.fits(values * factor)]
        if fitting:
            key, name = ("angle_unit", "rad") if joint.revolute else ("length_unit", "m")
            raise SequenceError(
                f"{table.path}, column {column.column!r}: read as {joint.unit}, joint {joint.name!r} is from "
                f"{values.min():.4g} to {values.max():.4g} {joint.unit}, and its limits are {low:.4g} to {high:.4g}. "
                f'Say the unit in [[arms]]: {key} = "{fitting[0]}" or "{PERCENT}" (-100 to 100 of the range), or '
                f'"{name}" if it is that.'
            )


def take_joints(table: TomlTable, robot: Robot) -> JointColumns:
    """The keys `joints`, `defaults`, `angle_unit` and `length_unit` of an `[[arms]]` table.

    Raises:
        SequenceError: a joint is not in the robot, has no value, or a unit does not fit it.
    """
    given = {"revolute": "angle_unit" in table, "prismatic": "length_unit" in table}
    units = {
        "revolute": table.take_choice("angle_unit", _UNITS["revolute"], "rad"),
        "prismatic": table.take_choice("length_unit", _UNITS["prismatic"], "m"),
    }
    mapping, defaults = table.take_table("joints"), table.take_table("defaults")
    columns = tuple(_take_column(mapping, joint, robot, units, given) for joint in mapping.items())
    values: dict[str, float] = {}
    for joint in defaults.items():
        _joint_type(defaults, joint, robot)
        values[joint] = float(defaults.take(joint, float))
        if abs(values[joint]) > (largest := PLAUSIBLE[_joint_type(defaults, joint, robot)]):
            raise defaults.error(joint, f"is {values[joint]:g}; allowed is up to {largest:.3g} [rad or m].")
        if joint in mapping:
            raise defaults.error(
                joint, "is given, but the joint has a column in [arms.joints] too. Remove one of them."
            )
    for joint in robot.joint_names:
        if joint not in mapping and joint not in values:
            unit = "[rad]" if _joint_type(mapping, joint, robot) == "revolute" else "[m]"
            raise mapping.error(
                joint,
                f"is missing: robot {robot.name!r} has this joint. Name its column here, "
                f"or give the position {unit} that it keeps under [arms.defaults], say {joint} = 0.0.",
            )
    return JointColumns(robot, columns, values, mapping.where)


def _joint_type(table: TomlTable, joint: str, robot: Robot) -> str:
    if joint not in robot.joint_names:
        raise table.error(
            joint,
            f"is not a joint of robot {robot.name!r} ({robot.urdf}).{closest(joint, robot.joint_names)} "
            f"Its joints are: {', '.join(robot.joint_names)}.",
        )
    return robot.joint_types[robot.joint_names.index(joint)]


def _take_column(
    mapping: TomlTable, joint: str, robot: Robot, units: Mapping[str, str], given: Mapping[str, bool]
) -> JointColumn:
    kind = _joint_type(mapping, joint, robot)
    if isinstance(mapping.take(joint, (str, dict)), str):
        scale, offset = _conversion(joint, units[kind], robot)
        return JointColumn(joint, mapping.take(joint, str), scale, offset, units[kind], given[kind])
    entry = TomlTable(mapping.take(joint, dict), mapping.file, f"{mapping.where}: {joint}")
    said = given[kind] or any(key in entry for key in ("unit", "scale"))
    unit = entry.take_choice("unit", _UNITS[kind], units[kind])
    scale, offset = _conversion(joint, unit, robot)
    scale, offset = scale * float(entry.take("scale", float, 1.0)), offset + float(entry.take("offset", float, 0.0))
    result = JointColumn(joint, entry.take("column", str), scale, offset, unit, said)
    entry.finish()
    return result


def _conversion(joint: str, unit: str, robot: Robot) -> tuple[float, float]:
    """Scale and offset to [rad] or [m]; those of percent are between the limits of the joint."""
    index = robot.joint_names.index(joint)
    if unit != PERCENT:
        return {**ANGLE_UNITS, **LENGTH_UNITS}[unit], 0.0
    low, high = robot.joint_limits[index].tolist()
    if not np.isfinite([low, high]).all():
        raise SequenceError(f"joint {joint!r} of {robot.urdf} has no limits, so {PERCENT} of its range is not known.")
    return (high - low) / 200, (high + low) / 2
