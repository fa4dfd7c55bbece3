"""Corrected kinematics as CSV: a row per frame, a column `source`, and `ARM.JOINT` for every joint [rad, m]."""

import csv
import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import SequenceError
from ..scene import Scene


@dataclass(frozen=True)
class KinematicsRow:
    """Joint positions of one frame and where they come from."""

    frame_id: str
    source: str
    """Who or what made the values: measured, edited, optimized."""
    joint_positions: Mapping[str, np.ndarray]
    """Arm name -> [dofs], [rad, m]."""


def _columns(scene: Scene) -> list[str]:
    return [f"{arm.name}.{joint}" for arm in scene.arms for joint in arm.robot.joint_names]


def kinematics_csv(scene: Scene, rows: Iterable[KinematicsRow]) -> str:
    """The table as text."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["frame", "source", *_columns(scene)])
    for row in rows:
        values = [f"{value:.9g}" for arm in scene.arms for value in row.joint_positions[arm.name]]
        table.writerow([row.frame_id, row.source, *values])
    return text.getvalue()


def read_kinematics_csv(path: Path, scene: Scene) -> list[KinematicsRow]:
    """Rows of a table that `kinematics_csv` wrote.

    Raises:
        SequenceError: the file is of other arms or joints, or not readable.
    """
    columns = ["frame", "source", *_columns(scene)]
    with path.open(newline="", encoding="utf-8") as file:
        table = csv.reader(file)
        header = next(table, [])
        if header != columns:
            found, wanted = ", ".join(header), ", ".join(columns)
            raise SequenceError(f"{path} has columns {found}; expected are {wanted}. Remove it.")
        rows = []
        for line, cells in enumerate(table, start=2):
            try:
                values = np.array([float(cell) for cell in cells[2:]])
                ends = np.cumsum([len(arm.robot.joint_names) for arm in scene.arms])[:-1]
                parts = np.split(values, ends) if len(values) == len(columns) - 2 else []
                positions = {arm.name: part for arm, part in zip(scene.arms, parts, strict=True)}
            except ValueError as error:
                raise SequenceError(f"{path}, line {line}: not {len(columns) - 2} numbers. Remove the line.") from error
            rows.append(KinematicsRow(cells[0], cells[1], positions))
    return rows
