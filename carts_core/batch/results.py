"""Results of a job: findings with preview images, written when it finishes, and projects for their review."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from ..errors import CartsError
from ..export import KinematicsRow, outlined, read_kinematics_csv
from ..export.kinematics import joint_columns, joint_units, position_values, std_values
from ..files import OutputPath, holds_file, write_bytes
from ..files.reading import IMAGE, TABLE, read_bytes
from ..project import FitVerdict, JointCorrection, Key, Project, Provenance
from ..provenance import Record, fingerprint, read_records
from ..recording import Sequence
from .folder import FINDINGS_FILE, Findings, FrameFinding, kinematics_tables
from .manifest import Job

_WORST = 3
"""Number of worst frames of a job with preview images."""
_WIDTH = 480
"""Maximum width of preview images [px]."""


def write_findings(job: Job, folder: OutputPath, sequence_file: Path) -> Findings:
    """Write `findings.json` of a finished job, and preview images of its worst frames; returns the findings."""
    sequence = Sequence.open(sequence_file)
    scene, found = sequence.scene, Findings(str(job.recording))
    for arm in scene.arms:
        for camera in scene.cameras:
            T_mount_world = sequence.mounts(0).get(camera.name)
            moved = np.eye(4) if T_mount_world is None else T_mount_world
            seen_in = camera.name if T_mount_world is None else f"the first frame of {camera.name}"
            found.base_frames[f"{arm.name} in {seen_in}"] = (camera.T_camera_world @ moved @ arm.T_world_base).tolist()
    for table in kinematics_tables(folder, job):
        rows = read_kinematics_csv(table, scene)
        _add_corrections(found, sequence, rows)
        cameras = table.parent.name
        records = read_records(table.parent / "results.json")
        frames = [
            FrameFinding(cameras, row.frame_id, record.verdict, record.reason, record.probability or 0.0)
            for row in rows
            if (record := records.get(row.frame_id)) and record.verdict
        ]
        found.frames.extend(_pictured(folder, sequence, table.parent, frames))
    write_bytes(folder / FINDINGS_FILE, msgspec.json.encode(found))
    return found


def _add_corrections(found: Findings, sequence: Sequence, rows: list[KinematicsRow]) -> None:
    scene = sequence.scene
    order = {frame_id: index for index, frame_id in enumerate(sequence.frame_ids)}
    units = [np.rad2deg(1.0) if unit == "rad" else 1000.0 for unit in joint_units(scene)]
    for row in rows:
        index = order[row.frame_id]
        measured = np.concatenate([sequence.measured[arm.name][index] for arm in scene.arms])
        change, deviation = position_values(scene, row) - measured, std_values(scene, row)
        for name, unit, moved, std in zip(joint_columns(scene), units, change, deviation, strict=True):
            found.corrections.setdefault(name, []).append(round(float(moved * unit), 6))
            if np.isfinite(std):
                found.deviations.setdefault(name, []).append(round(float(std * unit), 6))


def _pictured(folder: OutputPath, sequence: Sequence, part: Path, frames: list[FrameFinding]) -> Iterator[FrameFinding]:
    """Yield the frames, with preview images of the worst frames that show the outline of the mask."""
    worst = sorted(frames, key=lambda frame: -frame.probability)[:_WORST]
    domain, first = part.parent.name, part.name.split("+")[0]
    masks = part / "masks" / first if "+" in part.name else part / "masks"
    for frame in frames:
        if frame not in worst:
            yield frame
            continue
        index = list(sequence.frame_ids).index(frame.frame)
        image = sequence.frame(index, domain, [first]).images[first]
        mask = cv2.imdecode(np.frombuffer(read_bytes(masks / f"{frame.frame}.png", IMAGE), np.uint8), 0)
        assert mask is not None
        shown = outlined(image, mask > 0)
        scale = min(1.0, _WIDTH / shown.shape[1])
        small = cv2.resize(shown, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        name = f"worst-{part.name}-{frame.frame}.jpg"
        write_bytes(folder / name, cv2.imencode(".jpg", small[..., ::-1])[1].tobytes())
        yield msgspec.structs.replace(frame, picture=name)


_MADE = {"calibrate": "calibration", "import": "recording"}
"""Step -> folder with its sequence file; the results of a job refer to the first of these files that exists."""


def sequence_file(folder: OutputPath, job: Job) -> Path:
    """Sequence file to which a job's results refer."""
    made = [folder / name / "sequence.toml" for step, name in _MADE.items() if step in job.steps]
    return next((path.path for path in made if holds_file(path)), job.recording)


def review_project(folder: OutputPath, job: Job) -> Path:
    """Project for the review of a job, created if missing. New results have a new project; old projects are kept.

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
        sequence = Sequence.open(sequence_file(folder, job))
        edits = {key: value for table in tables for key, value in _edits(sequence, table)}
        project = Project.open(sequence, path)
        try:
            project.apply(f"Results of {job.name}", edits)
        finally:
            project.close()
    return path


def _edits(sequence: Sequence, table: Path) -> Iterator[tuple[Key[Any], Any]]:
    """Edits with the corrected joints and the verdict of each corrected frame of a table."""
    order = {frame_id: index for index, frame_id in enumerate(sequence.frame_ids)}
    try:
        records = read_records(table.parent / "results.json")
        for row in read_kinematics_csv(table, sequence.scene):
            if row.source != "measured":
                yield from _of_frame(sequence, order[row.frame_id], row, records[row.frame_id])
    except (OSError, ValueError, KeyError) as error:
        raise CartsError(f"{table.parent} holds no readable results: {error!r}. Run the batch again.") from error


def _of_frame(sequence: Sequence, index: int, row: KinematicsRow, record: Record) -> Iterator[tuple[Key[Any], Any]]:
    made_by = Provenance.made_by_optimizer({"batch": dict(record.origin)}, record.origin["weights"])
    for arm in sequence.scene.arms:
        positions = tuple(map(float, row.joint_positions[arm.name]))
        std = None if row.joint_std is None else np.asarray(row.joint_std.get(arm.name, np.nan), float)
        known = None if std is None or not np.isfinite(std).any() else tuple(std.tolist())
        yield Key.joints(index, arm.name), JointCorrection(positions, made_by, known)
    if record.verdict:
        yield Key.verdict(index), FitVerdict(record.verdict, record.reason, "", record.probability or 0.0)
