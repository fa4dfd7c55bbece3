"""Conversion of logged joint positions to radians and metres, with units that are given, named in columns, or plausible
for the joint limits."""

import re
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ...errors import SequenceError
from ...model.instruments import robot_file
from ...model.psm_kinematics import JOINT_NAMES
from ..kinematics_table import ANGLE_UNITS, FAR, LENGTH_UNITS, PERCENT, Joint, joints_of
from .found import FoundArm, Import, PartError

_INSERTED = 0.03
"""Insertion that is exceeded in most recordings, since the tip is in view [m]."""


def in_si(
    values: Float[np.ndarray, "rows joints"],
    joints: Sequence[Joint],
    job: Import,
    *,
    arm: str,
    columns: Sequence[str] = (),
    instrument: bool = True,
) -> Float[np.ndarray, "rows joints"]:
    """Convert logged positions of an arm to radians and metres, with the signs of the robot.

    Args:
        columns: names of a table's columns, whose units are guessed; empty for messages, which are in SI units.
        instrument: whether large angles are assumed to be degrees; angles of other robots may be percentages of their
            range.
    """
    names, options = [joint.name for joint in joints], job.options
    allowed = (*JOINT_NAMES, "jaw") if instrument else (*names, "jaw")
    for option, joint in [*(("flip", joint) for joint in options.flip), *(("units", joint) for joint in options.units)]:
        if joint not in allowed:
            problem = f"{joint} is not a joint. Joints are: {', '.join(allowed)}."
            raise PartError("columns", problem, f"Correct --{option}.")
    angle, length = options.angle_unit or "rad", options.length_unit or "m"
    if columns:
        rest = [index for index, name in enumerate(names) if name not in options.units]
        own = values[:, rest], [joints[index] for index in rest], arm, [columns[index] for index in rest]
        angle = options.angle_unit or _angle_unit(*own, instrument)
        length = options.length_unit or _length_unit(*own)
        given = bool(options.angle_unit and options.length_unit)
        job.found(f"angles are in {angle}, lengths in {length}.", arm, "--angle-unit, --length-unit", given=given)
    result = values.copy()
    for index, joint in enumerate(joints):
        unit = options.units.get(joint.name, angle if joint.revolute else length)
        factors = ANGLE_UNITS if joint.revolute else LENGTH_UNITS
        if columns and not options.units and not instrument and re.search(r"(?i)gripper\.pos$", columns[index]):
            result[:, index] = joint.from_percent(2.0 * values[:, index] - 100.0)
            job.guessed(f"{joint.name} is in percent of its range (0 to 100).", arm, f"--units {joint.name} UNIT")
        elif unit == PERCENT:
            result[:, index] = joint.from_percent(values[:, index])
        elif unit in factors:
            result[:, index] *= factors[unit]
        else:
            problem = f"the unit of {joint.name} is {unit}; allowed: {', '.join(factors)} and {PERCENT}."
            raise PartError("columns", problem, f"Correct --units {joint.name}.")
        if joint.name in options.flip:
            result[:, index] *= -1.0
    return result


def urdf_of(arm: str, robot: str) -> Path:
    """Path of the URDF of an arm's robot; `SequenceError` if it is missing."""
    if not (urdf := robot_file(robot)).is_file():
        raise SequenceError(f"robot {robot} of {arm} is missing. Give the path of a URDF; carts robot generates one.")
    return urdf


def psm_joints(arm: str, names: Sequence[str], job: Import) -> list[Joint]:
    """Joints of the robot given for an arm, else of the default robot; joints that the robot lacks have no limits."""
    robot = job.options.robot.get(arm, FoundArm.robot)
    urdf_of(arm, robot)
    known = {joint.name: joint for joint in joints_of(robot)}
    return [known.get(name, Joint(name, name != "insertion", -np.inf, np.inf)) for name in names]


def _angle_unit(values: np.ndarray, joints: Sequence[Joint], arm: str, columns: Sequence[str], instrument: bool) -> str:
    chosen = [index for index, joint in enumerate(joints) if joint.revolute and joint.name not in ("jaw", "gripper")]
    if not chosen:
        return "rad"
    text = " ".join(columns[index] for index in chosen)
    if re.search(r"(?i)deg|°", text):
        return "deg"
    if re.search(r"(?i)(^|[^a-z])rad(ians?)?([^a-z]|$)", text):
        return "rad"
    if not instrument and re.search(r"\.pos\b", text):
        raise _unknown_unit(values, joints, arm, chosen, "LeRobot does not store the unit of motor positions")
    if all(joints[i].fits(values[:, i], FAR) or joints[i].fits(-values[:, i], FAR) for i in chosen):
        return "rad"
    if not instrument:
        raise _unknown_unit(values, joints, arm, chosen, "as radians they are far beyond the limits of the robot")
    return "deg"


def _unknown_unit(values: np.ndarray, joints: Sequence[Joint], arm: str, chosen: list[int], why: str) -> PartError:
    worst = max(chosen, key=lambda index: float(np.nanmax(np.abs(values[:, index]))))
    joint, column = joints[worst], values[:, worst]
    return PartError(
        "columns",
        f"{arm}: the unit of the angles is not known, since {why}: positions of {joint.name} range from "
        f"{np.nanmin(column):.4g} to {np.nanmax(column):.4g}, and its limits are {joint.lower:.4g} to "
        f"{joint.upper:.4g} rad. Give the unit: deg, percent (-100 to 100 of the range of each joint) or rad.",
        "Use --angle-unit.",
    )


def _length_unit(values: np.ndarray, joints: Sequence[Joint], arm: str, columns: Sequence[str]) -> str:
    chosen = [index for index, joint in enumerate(joints) if not joint.revolute]
    if not chosen:
        return "m"
    if (unit := named_length_unit(" ".join(columns[index] for index in chosen))) is not None:
        return unit
    highest = max(float(np.nanmax(np.abs(values[:, index]))) for index in chosen)
    limit = max(abs(joints[index].upper) for index in chosen)
    orders = _column_orders(joints, values, _beyond_limits(joints, values))
    return length_unit(highest, limit, arm, " ".join(joints[index].name for index in chosen), orders)


def named_length_unit(text: str) -> str | None:
    """Unit of length other than metres in the names of columns; None if not found."""
    units = [unit for unit in LENGTH_UNITS if unit != "m"]
    return next((unit for unit in units if re.search(rf"(?i)(^|[^a-z]){unit}([^a-z]|$)", text)), None)


def length_unit(highest: float, limit: float, arm: str, what: str, orders: Sequence[str] = ()) -> str:
    """Unit in which a length is plausible; `PartError` if ambiguous."""
    if not np.isfinite(limit) or highest <= 1.5 * limit + 0.1:
        return "m"
    fitting = [unit for unit, factor in LENGTH_UNITS.items() if _INSERTED <= highest * factor <= 1.5 * limit]
    if "mm" in fitting or not fitting:
        return "mm"
    listed = ", ".join(f"{unit} ({highest * LENGTH_UNITS[unit]:.3g} m)" for unit in (*fitting, "mm"))
    also = f" Or choose other columns: {' or '.join(orders)} would fit." if orders else ""
    raise PartError(
        "columns",
        f"{arm}: the unit of {what} is ambiguous: its values reach {highest:.4g}, but its limit is {limit:.3g} m. "
        f"Give the unit: {listed}.{also}",
        "Use --length-unit or --columns." if orders else "Use --length-unit.",
    )


def check_limits(arm: FoundArm, job: Import) -> bool:
    """Whether an arm's positions are within its robot's limits; a note names violations and remedies."""
    if arm.values is None or not len(arm.values):
        return True
    known = {joint.name: joint for joint in joints_of(arm.robot)}
    shared = [index for index, name in enumerate(arm.columns) if name in known]
    joints, values = [known[arm.columns[index]] for index in shared], arm.values[:, shared]
    wrong = _beyond_limits(joints, values)
    orders = dict.fromkeys(_column_orders(joints, values, wrong), "--columns yaw COLUMN pitch COLUMN ...")
    for index in wrong:
        joint, own = joints[index], values[:, index]
        remedies = {**_other_readings(joint, own), **orders}
        text = (
            f"positions of {joint.name} range from {own.min():.4g} to {own.max():.4g} {joint.unit}, and the robot's "
            f"limits are {joint.lower:.4g} to {joint.upper:.4g} {joint.unit}"
        )
        text += f"; {' or '.join(remedies)} would fit." if remedies else ". Check the columns."
        options = " or ".join(dict.fromkeys(remedies.values()))
        job.warning(text, arm.name, remedy=f"Give {options}." if remedies else "")
    return not wrong


def _beyond_limits(joints: Sequence[Joint], values: Float[np.ndarray, "rows joints"]) -> list[int]:
    """Indices of joints whose positions [rad], [m] exceed their limits."""
    return [index for index, joint in enumerate(joints) if len(values) and not joint.fits(values[:, index])]


def _other_readings(joint: Joint, values: Float[np.ndarray, " rows"]) -> dict[str, str]:
    """Descriptions of signs and units that bring the positions of a joint within its limits -> option."""
    found = {"the opposite sign": f"--flip {joint.name}"} if joint.fits(-values) else {}
    for unit, factor in joint.units.items():
        if factor != 1.0 and joint.fits(values * factor) and not (found and unit != "deg"):
            text = f"{unit} (interpreted as {values.min() * factor:.3g} to {values.max() * factor:.3g} {joint.unit})"
            found[text] = f"--units {joint.name} {unit}"
    return found


def _column_orders(joints: Sequence[Joint], values: np.ndarray, wrong: list[int]) -> list[str]:
    """Column orders that bring all positions within the limits; empty if changed signs suffice."""
    if not wrong or all(joints[index].fits(-values[:, index]) for index in wrong):
        return []
    names = [joint.name for joint in joints]

    def fit(order: Sequence[int]) -> bool:
        return all(joint.fits(values[:, place]) for joint, place in zip(joints, order, strict=True))

    alphabetical = [sorted(names).index(name) for name in names]
    if alphabetical != list(range(len(names))) and fit(alphabetical):
        return ["the alphabetical order of the joints' names"]
    found = []
    for a, b in combinations(range(len(joints)), 2):
        order = list(range(len(joints)))
        order[a], order[b] = b, a
        if (a in wrong or b in wrong) and fit(order):
            found.append(f"exchanged columns of {names[a]} and {names[b]}")
    return found
