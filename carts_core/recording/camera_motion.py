"""A camera that moves: where what carries it is over time, as the key `motion` of `[[cameras]]` describes it.

The mount is whatever has measured poses, say the tip of the endoscope's manipulator (ECM). The camera's extrinsics are
then its place on the mount, and a point of the world is at `T_camera_mount @ inv(T_world_mount(t))` in the camera.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..errors import SequenceError
from ..model.ecm_kinematics import JOINT_NAMES, forward
from .joints import PLAUSIBLE
from .matching import PoseSamples
from .rows import Rows
from .table import Table
from .toml_table import TomlTable

POSES = ("T_world_mount", "T_mount_world")
POSITION, ORIENTATION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
"""Columns of a pose by default [m], unit quaternion."""

_UNITS = {"m": 1.0, "mm": 1e-3}
_NORM_TOLERANCE = 0.01
"""How far the length of a quaternion may be from 1."""
_FARTHEST = 100.0
"""[m]"""


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
    """Joints of the ECM are in rad and m; other units give impossible values."""
    for column, joint in zip(columns, JOINT_NAMES, strict=True):
        kind = "prismatic" if joint == "insertion" else "revolute"
        largest = np.abs(table.numbers(column, section.name("ecm_joints"))).max()
        if largest > PLAUSIBLE[kind]:
            raise section.error(
                "ecm_joints", f"has {joint} at {largest:.4g}; {PLAUSIBLE[kind]:.3g} is allowed. Give [rad] and [m]."
            )
