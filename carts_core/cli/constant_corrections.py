"""Corrections that are large and the same in all frames: joints that make up for what is wrong elsewhere."""

from collections.abc import Sequence

import numpy as np

from .. import recording
from ..export.kinematics import KinematicsRow, joint_columns, joint_units, position_values

_FRAMES = 4
"""Frames from which corrections can be called the same in all of them."""
_LARGE = 5.0
"""What joints are seldom off by in all frames, twice the prior of the default solver [deg, mm]."""


def constant_correction_hint(where: str, sequence: recording.Sequence, rows: Sequence[KinematicsRow]) -> str | None:
    """What large corrections that are much the same in all frames may come from, or None if there are none.

    Joints make up for a wrong focal length or base frame, so the image fits and the joints are wrong.

    Args:
        where: what tells people which frames are meant.
        sequence: with the measured joint positions.
        rows: results; those that were not optimized do not count.
    """
    scene, position = sequence.scene, {frame_id: index for index, frame_id in enumerate(sequence.frame_ids)}
    rows = [row for row in rows if row.source == "optimized"]
    if len(rows) < _FRAMES:
        return None
    before = [
        np.concatenate([sequence.measured[arm.name][position[row.frame_id]] for arm in scene.arms]) for row in rows
    ]
    off = np.stack([position_values(scene, row) for row in rows]) - np.stack(before)
    prismatic = np.array([unit == "m" for unit in joint_units(scene)])
    shown = np.where(prismatic, 1e3 * off, np.degrees(off))
    typical = np.median(shown, axis=0)
    # Four of five frames agree with the median to within half of it.
    spread = np.quantile(np.abs(shown - typical), 0.8, axis=0)
    constant = np.flatnonzero((np.abs(typical) >= _LARGE) & (spread < np.abs(typical) / 2))
    if not constant.size:
        return None
    names, units = joint_columns(scene), np.where(prismatic, "mm", "deg")
    found = ", ".join(f"{names[joint]} {typical[joint]:+.1f} {units[joint]}" for joint in constant)
    return (
        f"{where}: corrections are large and much the same in all frames: {found}. Joints make up alike for wrong "
        "intrinsics, base frames and joint zeros, so check these before you rely on joint positions. Masks fit anyway."
    )
