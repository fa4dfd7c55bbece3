"""Which column of a kinematics table is which joint of a robot, and in which unit."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..errors import SequenceError
from ..model.robot import Robot
from ..wording import closest
from .table import Table
from .toml_table import TomlTable

_UNITS = {"revolute": {"rad": 1.0, "deg": float(np.pi / 180)}, "prismatic": {"m": 1.0, "mm": 1e-3}}

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
            positions[:, index] = values
        return positions


def take_joints(table: TomlTable, robot: Robot) -> JointColumns:
    """The keys `joints`, `defaults`, `angle_unit` and `length_unit` of an `[[arms]]` table.

    Raises:
        SequenceError: a joint is not in the robot, has no value, or a unit does not fit it.
    """
    units = {
        "revolute": table.take_choice("angle_unit", tuple(_UNITS["revolute"]), "rad"),
        "prismatic": table.take_choice("length_unit", tuple(_UNITS["prismatic"]), "m"),
    }
    mapping, defaults = table.take_table("joints"), table.take_table("defaults")
    columns = tuple(_take_column(mapping, joint, robot, units) for joint in mapping.items())
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


def _take_column(mapping: TomlTable, joint: str, robot: Robot, units: Mapping[str, str]) -> JointColumn:
    kind = _joint_type(mapping, joint, robot)
    if isinstance(mapping.take(joint, (str, dict)), str):
        return JointColumn(joint, mapping.take(joint, str), _UNITS[kind][units[kind]], 0.0, units[kind])
    entry = TomlTable(mapping.take(joint, dict), mapping.file, f"{mapping.where}: {joint}")
    unit = entry.take_choice("unit", tuple(_UNITS[kind]), units[kind])
    scale = float(entry.take("scale", float, 1.0)) * _UNITS[kind][unit]
    result = JointColumn(joint, entry.take("column", str), scale, float(entry.take("offset", float, 0.0)), unit)
    entry.finish()
    return result
