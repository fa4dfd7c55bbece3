"""Conversion of logged joint positions to radians and metres: units given, named in columns, or fitting the limits."""

import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ...errors import SequenceError
from ...model.instruments import robot_file
from ...settings.interchange import ImportOptions
from ..kinematics_table import ANGLE_UNITS, LENGTH_UNITS, Joint, fits_roughly, joints_of, misfits
from .found import FoundArm, Note, Notes

_INSERTED = 0.03
"""Insertion [m] that the insertion axis exceeds in most recordings, since the tip is in view."""


def in_si(
    values: Float[np.ndarray, "rows joints"],
    joints: Sequence[Joint],
    options: ImportOptions,
    notes: Notes,
    *,
    arm: str,
    columns: Sequence[str] = (),
    instrument: bool = True,
) -> Float[np.ndarray, "rows joints"]:
    """Logged positions in radians and metres, with the signs of the robot.

    Args:
        values: of each joint, by rows.
        joints: of the columns.
        options: with `angle_unit`, `length_unit` and `flip`.
        notes: of the import; some are added.
        arm: its name, for notes.
        columns: names of a table's columns, whose units are guessed; empty for messages, which are in SI units.
        instrument: whether angles can be guessed to be degrees; those of other robots may be shares of their range.

    Raises:
        SequenceError: the unit is not clear, or a joint to be flipped is not there.
    """
    names = [joint.name for joint in joints]
    for joint in (*options.flip, *options.units):
        if joint not in (*names, "jaw"):
            option = "--flip" if joint in options.flip else "--units"
            raise SequenceError(f"{option} {joint} is no joint. Joints are: {', '.join(names)}.")
    angle, length = options.angle_unit or "rad", options.length_unit or "m"
    if columns:
        rest = [index for index, name in enumerate(names) if name not in options.units]
        asked = values[:, rest], [joints[index] for index in rest], arm, [columns[index] for index in rest]
        angle = options.angle_unit or _angle_unit(*asked, instrument)
        length = options.length_unit or _length_unit(*asked)
        text = f"{arm}: angles are in {angle}, lengths in {length} (change: --angle-unit, --length-unit)."
        notes.append(Note("found" if options.angle_unit and options.length_unit else "guessed", text))
    result = values.copy()
    for index, joint in enumerate(joints):
        unit = options.units.get(joint.name, angle if joint.revolute else length)
        if columns and not options.units and _is_lerobot_gripper(columns[index]) and not instrument:
            result[:, index] = joint.from_percent(2.0 * values[:, index] - 100.0)
            notes.guessed(f"{arm}: {joint.name} is 0 to 100 of its range (change: --units {joint.name} UNIT).")
        elif unit == "percent":
            result[:, index] = joint.from_percent(values[:, index])
        else:
            factors = ANGLE_UNITS if joint.revolute else LENGTH_UNITS
            if unit not in factors:
                raise SequenceError(f"--units {joint.name} {unit} does not fit: give {', '.join(factors)} or percent.")
            result[:, index] *= factors[unit]
        if joint.name in options.flip:
            result[:, index] *= -1.0
    return result


def joints_of_arm(arm: str, options: ImportOptions) -> tuple[Joint, ...]:
    """Joints of the robot given for an arm, else of the default one.

    Raises:
        SequenceError: the robot is missing.
        RobotError: it is no URDF.
    """
    robot = options.robot.get(arm, "builtin:psm_lnd")
    if not robot_file(robot).is_file():
        raise SequenceError(f"robot {robot} of {arm} is missing. Give the path of a URDF (carts robot makes one).")
    return joints_of(robot)


def _is_lerobot_gripper(column: str) -> bool:
    return re.search(r"(?i)gripper\.pos$", column) is not None


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
        raise _asked(values, joints, arm, chosen, "LeRobot does not keep the unit of its motors' positions")
    tested = [joints[index] for index in chosen]
    own = [values[:, index] for index in chosen]
    if fits_roughly(tested, own, lambda joint, column: column):
        return "rad"
    if not instrument:
        raise _asked(values, joints, arm, chosen, "as radians they are far beyond the robot's limits")
    return "deg"


def _asked(values: np.ndarray, joints: Sequence[Joint], arm: str, chosen: list[int], why: str) -> SequenceError:
    worst = max(chosen, key=lambda index: float(np.nanmax(np.abs(values[:, index]))))
    joint, column = joints[worst], values[:, worst]
    return SequenceError(
        f"{arm}: the unit of the angles is not known, since {why}: {joint.name} is from {np.nanmin(column):.4g} to "
        f"{np.nanmax(column):.4g}, and its limits are {joint.lower:.4g} to {joint.upper:.4g} rad. Give it: "
        "--angle-unit deg, percent (-100 to 100 of the range of each joint) or rad."
    )


def _length_unit(values: np.ndarray, joints: Sequence[Joint], arm: str, columns: Sequence[str]) -> str:
    chosen = [index for index, joint in enumerate(joints) if not joint.revolute]
    if not chosen:
        return "m"
    text = " ".join(columns[index] for index in chosen)
    for unit in LENGTH_UNITS:
        if unit != "m" and re.search(rf"(?i)(^|[^a-z]){unit}([^a-z]|$)", text):
            return unit
    highest = max(float(np.nanmax(np.abs(values[:, index]))) for index in chosen)
    limit = max(abs(joints[index].upper) for index in chosen)
    remedies = dict.fromkeys(text for misfit in misfits(joints, values) for text in misfit.remedies)
    orders = [text for text in remedies if "order" in text or "way round" in text]
    return length_unit(highest, limit, arm, " ".join(joints[index].name for index in chosen), orders)


def length_unit(highest: float, limit: float, arm: str, what: str, orders: Sequence[str] = ()) -> str:
    """The unit in which a length is plausible.

    Args:
        highest: largest magnitude, as logged.
        limit: largest possible magnitude [m].
        arm: its name, for notes.
        what: name of the length, for errors.
        orders: of the columns that would fit as well, for errors.

    Raises:
        SequenceError: decimetres or centimetres would fit better than millimetres.
    """
    if not np.isfinite(limit) or highest <= 1.5 * limit + 0.1:
        return "m"
    fitting = [unit for unit, factor in LENGTH_UNITS.items() if _INSERTED <= highest * factor <= 1.5 * limit]
    if "mm" in fitting or not fitting:
        return "mm"
    listed = ", ".join(f"{unit} ({highest * LENGTH_UNITS[unit]:.3g} m)" for unit in (*fitting, "mm"))
    also = f" Or name the columns (--columns), since {' or '.join(orders)} would fit." if orders else ""
    raise SequenceError(
        f"{arm}: the unit of {what} is not clear: it is up to {highest:.4g}, and at most {limit:.3g} m is possible. "
        f"Give it: --length-unit {listed}.{also}"
    )


def check_limits(arm: FoundArm, notes: Notes) -> bool:
    """Compare an arm's positions with its robot's limits; a note names violations and remedies.

    Returns:
        Whether all are within.

    Raises:
        RobotError: the robot is missing or no URDF.
    """
    if arm.values is None or not len(arm.values):
        return True
    known = {joint.name: joint for joint in joints_of(arm.robot)}
    there = [index for index, name in enumerate(arm.columns) if name in known]
    found = misfits([known[arm.columns[index]] for index in there], arm.values[:, there])
    for misfit in found:
        options = dict.fromkeys(_option(misfit.joint.name, text) for text in misfit.remedies)
        remedy = f" Give {' or '.join(options)}." if options else " Check the columns."
        notes.warning(f"{arm.name}: {misfit.sentence()}.{remedy}")
    return not found


def _option(joint: str, remedy: str) -> str:
    """The command line option for a remedy."""
    if remedy == "the other sign":
        return f"--flip {joint}"
    if "order" in remedy or "way round" in remedy:
        return "--columns yaw COLUMN pitch COLUMN ..."
    return f"--units {joint} {remedy.partition(' ')[0]}"
