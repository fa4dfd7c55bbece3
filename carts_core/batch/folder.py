"""Folder of a batch: states and results of its jobs, a summary, and projects for the review of jobs."""

import json
import os
import socket
import threading
import time
from array import array
from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Rows
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import msgspec
import numpy as np

from ..errors import CartsError, SettingsError
from ..export import KinematicsRow, outlined, read_kinematics_csv
from ..export.kinematics import joint_columns, joint_units, position_values, std_values
from ..files import BusyError, OutputPath, check_name, holds_file, locked_folder, set_aside, write_bytes, write_text
from ..files.reading import IMAGE, TABLE, VALUES, read_bytes, typed_json
from ..package_imports import gc_paused
from ..project import FitVerdict, JointCorrection, Key, Project, Provenance
from ..provenance import Record, fingerprint, read_records
from ..recording import Sequence
from .manifest import Job

JOB_FILE = "job.json"
HEARTBEAT_SECONDS = 10.0
"""Interval of the heartbeat of a running job [s]."""

Status = Literal["waiting", "running", "done", "failed", "stopped"]


@dataclass(frozen=True)
class StepState:
    """State of a finished step."""

    key: str
    """Fingerprint of the step's inputs; the step runs again after a change."""
    seconds: float
    """Duration [s]."""


@dataclass(frozen=True)
class JobState:
    """State of a job."""

    status: Status = "waiting"
    steps: Mapping[str, StepState] = field(default_factory=dict)
    """Finished steps."""
    attempts: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Number of starts since the job last finished or failed; more than 1 if a worker was lost."""
    error: str = ""
    """Reason for a failure."""
    worker: str = ""
    """Machine and process of the last run."""
    heartbeat: float = 0.0
    """Time of the last heartbeat [s since 1970]."""
    format: Literal["carts-job/1"] = "carts-job/1"


def read_state(folder: OutputPath) -> JobState:
    """State of the job in a folder; `failed` if its file is damaged."""
    try:
        return _read(folder)
    except (OSError, ValueError) as error:
        remedy = "Run the batch again: the job is restarted, and the damaged file is kept."
        return JobState("failed", error=f"{JOB_FILE} cannot be read: {error}. {remedy}")


def _read(folder: OutputPath) -> JobState:
    """Read the state of a job; `OSError` or `ValueError` if its file is damaged."""
    path = folder / JOB_FILE
    if not holds_file(path):
        return JobState()
    return typed_json(read_bytes(path.path, VALUES), JobState)


def write_state(folder: OutputPath, state: JobState) -> None:
    """Replace the state of a job."""
    write_text(folder / JOB_FILE, json.dumps(asdict(state), indent=1))


def present_status(folder: OutputPath) -> tuple[str, JobState]:
    """Current status and state of a job; the status is `lost` if the job is marked as running but no process holds its
    lock."""
    state = read_state(folder)
    if state.status == "running":
        with suppress(BusyError), locked_folder(folder):
            return "lost", state
    return state.status, state


class RunningJob:
    """Job run by this process, with its state on disk.

    Attributes:
        state: current state.
    """

    def __init__(self, folder: OutputPath) -> None:
        self._folder, self._changing = folder, threading.Lock()
        try:
            self.state = _read(folder)
        except (OSError, ValueError):
            set_aside(folder / JOB_FILE)
            self.state = JobState()

    def change(self, **values: object) -> None:
        """Update fields of the state on disk."""
        with self._changing:
            self.state = replace(self.state, heartbeat=time.time(), **values)  # pyright: ignore[reportArgumentType]
            write_state(self._folder, self.state)


@contextmanager
def running(folder: OutputPath) -> Iterator[RunningJob | None]:
    """Lock a job and write its heartbeat while the block runs; None if another process runs it."""
    with ExitStack() as held:
        try:
            held.enter_context(locked_folder(folder))
        except BusyError:
            yield None
            return
        job, ended = RunningJob(folder), threading.Event()
        job.change(
            status="running", error="", attempts=job.state.attempts + 1, worker=f"{socket.gethostname()}:{os.getpid()}"
        )

        def beat() -> None:
            while not ended.wait(HEARTBEAT_SECONDS):
                job.change()

        thread = threading.Thread(target=beat, name="heartbeat", daemon=True)
        thread.start()
        try:
            yield job
        finally:
            ended.set()
            thread.join()


FINDINGS_FILE = "findings.json"
_WORST = 3
"""Number of worst frames of a job with preview images."""
_WIDTH = 480
"""Maximum width of preview images [px]."""


@dataclass(frozen=True)
class FrameFinding:
    """Verdict on one frame, with its reason and probability."""

    camera: str
    frame: str
    verdict: str
    """`good`, `doubtful` or `failed`."""
    reason: str
    probability: Annotated[float, msgspec.Meta(ge=0, le=1)]
    """Probability that the frame's mask is wrong [1]."""
    picture: str = ""
    """Preview image in the job's folder; empty except for the worst frames."""


@dataclass(frozen=True)
class Findings:
    """Results of a job."""

    recording: str
    frames: list[FrameFinding] = field(default_factory=list)
    corrections: dict[str, list[float]] = field(default_factory=dict)
    """`ARM.JOINT` -> corrected minus measured position of each frame [deg, mm]."""
    deviations: dict[str, list[float]] = field(default_factory=dict)
    """`ARM.JOINT` -> reported standard deviations [deg, mm] of the frames with known standard deviations."""
    base_frames: dict[str, list[list[float]]] = field(default_factory=dict)
    """`ARM in CAMERA` -> T_camera_base [4 x 4, m], calibrated if the job has a calibration step."""
    format: Literal["carts-findings/1"] = "carts-findings/1"


def read_findings(folder: OutputPath) -> Findings | None:
    """Read the results of the job in a folder; None if it has not finished. `OSError` or `ValueError` if the file is
    damaged."""
    path = folder / FINDINGS_FILE
    if not holds_file(path):
        return None
    found = typed_json(read_bytes(path.path, VALUES), Findings)
    if any(len(rows) != 4 or {len(row) for row in rows} != {4} for rows in found.base_frames.values()):
        raise ValueError("a base frame is not a 4 x 4 matrix")
    return found


def write_findings(job: Job, folder: OutputPath, sequence_file: Path) -> None:
    """Write `findings.json` of a finished job, and preview images of its worst frames."""
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
    write_text(folder / FINDINGS_FILE, json.dumps(asdict(found)))


def kinematics_tables(folder: OutputPath, job: Job) -> list[Path]:
    """Tables of a job's corrected joints, one per domain and group of cameras; empty without optimization."""
    steps = [step for step in ("sequence", "optimize") if step in job.steps]
    return sorted((folder / steps[0]).path.glob("*/*/kinematics.csv")) if steps else []


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
        yield replace(frame, picture=name)


BATCH_FILE = "batch.json"
_MAX_ERROR_LENGTH = 1000
"""Maximum length of a stored error [characters]."""
ORDER = ("failed", "lost", "stopped", "running", "waiting", "done")
"""Statuses, most urgent first."""
_ENDED = ("failed", "stopped", "done")
"""Statuses that change only with the file of the state."""


@dataclass(frozen=True)
class KnownJob:
    """Job with its state and results."""

    job: Job
    status: str
    """One of `ORDER`."""
    state: JobState
    findings: Findings | None
    damage: str = ""
    """Reason why the results cannot be read."""
    written: tuple[int, ...] = ()
    """Times [ns] and sizes [bytes] of the files of state and results."""

    @property
    def error(self) -> str:
        """Last line of the job's error, or reason why its results cannot be read; empty if there is neither."""
        lines = self.state.error.strip().splitlines()
        return lines[-1][:_MAX_ERROR_LENGTH] if lines else self.damage


JointErrors = dict[str, tuple[array, array]]
"""`ARM.JOINT` -> corrections and deviations of all jobs, as in `Findings`."""


def known_jobs(
    batch: OutputPath, jobs: Rows[Job], before: Rows[KnownJob] = (), joints: JointErrors | None = None
) -> list[KnownJob]:
    """States and results of jobs, in the given order, without corrections and deviations of joints.

    Args:
        before: earlier result; its jobs are kept if their files have not changed.
        joints: to which corrections and deviations are added, except those of kept jobs.
    """
    folder, earlier = batch / "jobs", {entry.job.name: entry for entry in before if entry.status in _ENDED}
    with gc_paused():
        return [_known(folder, job, earlier.get(job.name), {} if joints is None else joints) for job in jobs]


def _known(jobs: OutputPath, job: Job, before: KnownJob | None, joints: JointErrors) -> KnownJob:
    place = os.path.join(jobs.path, job.name)
    if not os.path.isdir(place):
        return KnownJob(job, "waiting", JobState(), None)
    written: list[int] = []
    for name in (JOB_FILE, FINDINGS_FILE):
        with suppress(OSError):
            found = os.lstat(os.path.join(place, name))
            written += [found.st_mtime_ns, found.st_size]
    if before is not None and before.written == tuple(written):
        return before
    folder = jobs / job.name
    status, state = present_status(folder)
    try:
        found = read_findings(folder)
        if found is not None:
            for name, values in found.corrections.items():
                corrections, deviations = joints.setdefault(name, (array("d"), array("d")))
                corrections.extend(values)
                deviations.extend(found.deviations.get(name, []))
            found = replace(found, corrections={}, deviations={})
        return KnownJob(job, status, state, found, written=tuple(written))
    except (OSError, ValueError) as error:
        damage = (
            f"{FINDINGS_FILE} cannot be read: {str(error)[:_MAX_ERROR_LENGTH]}. Run the batch again to recreate it."
        )
        return KnownJob(job, status, state, None, damage, tuple(written))


def most_urgent_first(known: Rows[KnownJob]) -> list[KnownJob]:
    """Jobs sorted by `ORDER`."""
    return sorted(known, key=lambda entry: ORDER.index(entry.status))


@dataclass(frozen=True)
class _Batch:
    """Content of the file with the list of jobs."""

    format: Literal["carts-batch-jobs/1"]
    jobs: list[Job]


def write_jobs(batch: OutputPath, jobs: Rows[Job]) -> None:
    """Write the list of jobs, for readers without the manifest."""
    rows = [{**asdict(job), "recording": str(job.recording.resolve())} for job in jobs]
    for row in rows:
        del row["options"]
    write_text(batch / BATCH_FILE, json.dumps({"format": "carts-batch-jobs/1", "jobs": rows}, indent=1))


def is_batch(folder: Path) -> bool:
    """Whether a folder is a batch folder."""
    return (folder / BATCH_FILE).is_file()


def read_jobs(folder: Path) -> list[Job]:
    """Read the jobs of a batch folder, without options; `SettingsError` if the folder is not a batch folder or its list
    is damaged."""
    try:
        jobs = typed_json(read_bytes(folder / BATCH_FILE, VALUES), _Batch).jobs
        for job in jobs:
            check_name(job.name, f"a job of {folder}")
            if not job.recording.is_absolute():
                raise ValueError(f"the recording {str(job.recording)!r} is not an absolute path")
    except (OSError, ValueError) as error:
        raise SettingsError(
            f"{folder} is not a readable batch: {error}. Give the output folder of carts batch."
        ) from error
    return jobs


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
