"""Project for the review of a job: its recording with the results as corrections."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import CartsError
from ..export import KinematicsRow, read_kinematics_csv
from ..files import OutputPath, holds_file
from ..files.reading import TABLE, read_bytes
from ..project import FitVerdict, JointCorrection, Key, Project, Provenance
from ..provenance import Record, fingerprint, read_records
from ..recording import Sequence
from .folder import kinematics_tables
from .manifest import Job

_MADE = {"calibrate": "calibration", "import": "recording"}
"""Step -> folder of the sequence file that it writes; a job's results refer to the first of these that exists."""


def sequence_file(folder: OutputPath, job: Job) -> Path:
    """Sequence file to which a job's results refer."""
    made = [folder / name / "sequence.toml" for step, name in _MADE.items() if step in job.steps]
    return next((path.path for path in made if holds_file(path)), job.recording)


def review_project(folder: OutputPath, job: Job) -> Path:
    """Project for the review of a job, created if missing. New results get a new project; old projects are kept.

    Raises:
        CartsError: a table of results cannot be read.
    """
    tables = kinematics_tables(folder, job)
    try:
        digest = fingerprint(*(read_bytes(table, TABLE) for table in tables))
    except OSError as error:
        raise CartsError(f"results of {job.name} cannot be read ({error}). Run the job again.") from error
    path = (folder / f"review-{digest[:12]}.carts").path
    if not path.exists():
        project = Project.open(sequence := Sequence.open(sequence_file(folder, job)), path)
        try:
            edits = {key: value for table in tables for key, value in _edits(sequence, table)}
            project.apply(f"Results of {job.name}", edits)
        finally:
            project.close()
    return path


def _edits(sequence: Sequence, table: Path) -> Iterator[tuple[Key[Any], Any]]:
    """Edits with the corrected joints and the verdict of each frame of a table."""
    order = {frame_id: index for index, frame_id in enumerate(sequence.frame_ids)}
    try:
        records = read_records(table.parent / "results.json")
        for row in read_kinematics_csv(table, sequence.scene):
            if row.source != "measured":
                yield from _of_frame(sequence, order[row.frame_id], row, records[row.frame_id])
    except (OSError, ValueError, KeyError) as error:
        raise CartsError(
            f"{table.parent} holds no results that can be read: {error!r}. Run the batch again."
        ) from error


def _of_frame(sequence: Sequence, index: int, row: KinematicsRow, record: Record) -> Iterator[tuple[Key[Any], Any]]:
    made_by = Provenance.made_by_optimizer({"batch": dict(record.origin)}, record.origin["weights"])
    for arm in sequence.scene.arms:
        positions = tuple(map(float, row.joint_positions[arm.name]))
        std = None if row.joint_std is None else np.asarray(row.joint_std.get(arm.name, np.nan), float)
        known = None if std is None or not np.isfinite(std).any() else tuple(std.tolist())
        yield Key.joints(index, arm.name), JointCorrection(positions, made_by, known)
    if record.verdict:
        yield Key.verdict(index), FitVerdict(record.verdict, record.reason, "", record.probability or 0.0)
