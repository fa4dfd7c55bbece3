"""Corrected kinematics as CSV: one row per frame, with a column `source` and a column `ARM.JOINT` per joint [rad, m].

If standard deviations are known, a column `ARM.JOINT.std` [rad, m] per joint follows. If a frame has a verdict,
`verdict` (of the mask) and `not_determined` (joints not determined by the image) follow.
"""

import csv
import io
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import SequenceError
from ..files import csv_cell, text_of_cell
from ..files.reading import TABLE, open_regular
from ..model.scene import Scene
from ..optimization.results import undetermined_joints
from ..reprs import short_repr
from ..wording import shortened

_TEXT_COLUMNS = ["verdict", "not_determined"]
"""Text columns, after the numeric columns."""
JOINED = "; "
"""Separator of joint names in a text column."""


@dataclass(frozen=True)
class KinematicsRow:
    """Joint positions of one frame and their source."""

    frame_id: str
    source: str
    """Source of the values: measured, edited, optimized or propagated."""
    joint_positions: Mapping[str, np.ndarray]
    """Arm name -> joint positions [dofs], [rad, m]."""
    joint_std: Mapping[str, np.ndarray] | None = None
    """Arm name -> standard deviation of the joint positions [dofs], [rad, m]; NaN or no entry if unknown."""
    verdict: str | None = None
    """Verdict on the mask: good, doubtful or failed; None if it was not assessed."""

    __repr__ = short_repr

    def undetermined(self, scene: Scene) -> list[str] | None:
        """`ARM.JOINT` of the joints not determined by the images; None if no standard deviation is known."""
        return undetermined_joints(scene, self.joint_std or {})


def joint_columns(scene: Scene) -> list[str]:
    """`ARM.JOINT` of each degree of freedom, in the scene's order."""
    return [f"{arm.name}.{joint}" for arm in scene.arms for joint in arm.robot.joint_names]


def joint_units(scene: Scene) -> list[str]:
    """`rad` or `m` for each of `joint_columns`."""
    return ["m" if kind == "prismatic" else "rad" for arm in scene.arms for kind in arm.robot.joint_types]


def position_values(scene: Scene, row: KinematicsRow) -> np.ndarray:
    """Joint positions of a row in the order of `joint_columns`, [columns] [rad, m]."""
    return np.concatenate([np.asarray(row.joint_positions[arm.name], dtype=np.float64) for arm in scene.arms])


def std_values(scene: Scene, row: KinematicsRow) -> np.ndarray:
    """Standard deviations of a row in the order of `joint_columns`, [columns] [rad, m]; NaN if unknown."""
    known = row.joint_std or {}
    unknown = {arm.name: np.full(len(arm.robot.joint_names), math.nan) for arm in scene.arms}
    return np.concatenate([np.asarray(known.get(name, nothing), dtype=np.float64) for name, nothing in unknown.items()])


def kinematics_csv(scene: Scene, rows: Iterable[KinematicsRow]) -> str:
    """Format a kinematics table as CSV, with standard deviations if any row has them."""
    rows = list(rows)
    with_std, with_verdict = any(row.joint_std is not None for row in rows), any(row.verdict for row in rows)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(_header(scene, with_std, with_verdict))
    for row in rows:
        values = [position_values(scene, row), *([std_values(scene, row)] if with_std else [])]
        texts = [row.verdict or "", JOINED.join(row.undetermined(scene) or ())]
        numbers, verdict = np.concatenate(values), list(map(csv_cell, texts)) if with_verdict else []
        table.writerow([csv_cell(row.frame_id), csv_cell(row.source), *(f"{value:.9g}" for value in numbers), *verdict])
    return text.getvalue()


def read_kinematics_csv(path: Path, scene: Scene) -> list[KinematicsRow]:
    """Read a table written by `kinematics_csv`; `SequenceError` if arms or joints differ or the file is unreadable."""
    try:
        return _read(path, scene)
    except (OSError, ValueError, csv.Error) as error:
        raise SequenceError(f"{path} is not a readable kinematics table: {error}.") from error


def _header(scene: Scene, with_std: bool, with_verdict: bool = False) -> list[str]:
    columns = joint_columns(scene)
    further = [f"{column}.std" for column in columns] if with_std else []
    return ["frame", "source", *map(csv_cell, [*columns, *further]), *(_TEXT_COLUMNS if with_verdict else [])]


def _read(path: Path, scene: Scene) -> list[KinematicsRow]:
    with io.TextIOWrapper(open_regular(path, TABLE), encoding="utf-8", newline="") as file:
        table = csv.reader(file)
        header = next(table, [])
        # In tables of earlier versions, the verdict is the last column.
        texts = [name for name in header[-len(_TEXT_COLUMNS) :] if name in _TEXT_COLUMNS]
        numbers = header[: len(header) - len(texts)]
        with_std = numbers == _header(scene, True)
        if not with_std and numbers != _header(scene, False):
            found, wanted = ", ".join(header), ", ".join(_header(scene, False))
            raise SequenceError(f"{path} has columns {shortened(found, 1000)}; expected: {wanted}. Remove the file.")
        rows = []
        for line, cells in enumerate(table, start=2):
            try:
                values = np.array([float(cell) for cell in cells[2 : len(numbers)]])
            except ValueError:
                values = np.empty(0)
            if len(cells) != len(header) or len(values) != len(numbers) - 2:
                raise SequenceError(f"{path}, line {line}: expected {len(numbers) - 2} numbers. Remove the line.")
            if not np.isfinite(values[: len(joint_columns(scene))]).all():
                raise SequenceError(f"{path}, line {line}: a joint position is not finite. Remove the line.")
            positions, std = np.split(values, [len(joint_columns(scene))])
            rows.append(
                KinematicsRow(
                    text_of_cell(cells[0]),
                    text_of_cell(cells[1]),
                    _by_arm(scene, positions),
                    _by_arm(scene, std) if with_std else None,
                    (text_of_cell(cells[len(numbers)]) or None) if texts else None,
                )
            )
    return rows


def _by_arm(scene: Scene, values: np.ndarray) -> dict[str, np.ndarray]:
    ends = np.cumsum([len(arm.robot.joint_names) for arm in scene.arms])[:-1]
    return {arm.name: part for arm, part in zip(scene.arms, np.split(values, ends), strict=True)}
