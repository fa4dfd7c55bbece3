"""Folder of a batch: states and results of its jobs, a summary, and the list of jobs."""

import json
import os
import socket
import stat
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Sequence as Rows
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from ..errors import OutputError, SettingsError
from ..files import (
    BusyError,
    OutputPath,
    check_name,
    holds_file,
    indented_json,
    locked_folder,
    open_below,
    opened_folder,
    resolved_paths,
    set_aside,
    try_lock,
    write_bytes,
    write_text,
)
from ..files.reading import VALUES, read_bytes, typed_json
from ..package_imports import gc_paused
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
    processor: float | None = None
    """Processor time [s]; None if it was not measured."""


@dataclass(frozen=True)
class JobState:
    """State of a job."""

    status: Status = "waiting"
    steps: Mapping[str, StepState] = field(default_factory=dict)
    """Finished steps; `findings` is the summary of their results."""
    attempts: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Number of starts since the job last finished or failed; more than 1 if a worker was lost or the job was
    stopped."""
    error: str = ""
    """Reason for a failure."""
    worker: str = ""
    """Machine and process of the last run."""
    heartbeat: float = 0.0
    """Time of the last heartbeat [s since 1970]."""
    format: Literal["carts-job/1"] = "carts-job/1"


def read_state(folder: OutputPath) -> JobState:
    """State of the job in a folder; `failed` if its file is damaged."""
    return _state(lambda: _read(folder))


def _state(read: Callable[[], JobState]) -> JobState:
    try:
        return read()
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
                with suppress(OutputError):  # The disk may be full for a moment.
                    job.change()

        thread = threading.Thread(target=beat, name="heartbeat", daemon=True)
        thread.start()
        try:
            yield job
        finally:
            ended.set()
            thread.join()


FINDINGS_FILE = "findings.json"


class FrameFinding(msgspec.Struct, frozen=True, gc=False):
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


class Findings(msgspec.Struct, frozen=True, gc=False):
    """Results of a job."""

    recording: str
    frames: list[FrameFinding] = []
    corrections: dict[str, list[float]] = {}
    """`ARM.JOINT` -> corrected minus measured position of each frame [deg, mm]."""
    deviations: dict[str, list[float]] = {}
    """`ARM.JOINT` -> reported standard deviations [deg, mm] of the frames with known standard deviations."""
    base_frames: dict[str, list[list[float]]] = {}
    """`ARM in CAMERA`, or `ARM in the first frame of CAMERA` for a moving camera -> T_camera_base [4 x 4, m],
    calibrated if the job has a calibration step."""
    format: Literal["carts-findings/1"] = "carts-findings/1"


def read_findings(folder: OutputPath) -> Findings | None:
    """Read the results of the job in a folder; None if it has not finished. `OSError` or `ValueError` if the file is
    damaged."""
    path = folder / FINDINGS_FILE
    return _findings(read_bytes(path.path, VALUES)) if holds_file(path) else None


def _findings(content: bytes) -> Findings:
    found = typed_json(content, Findings)
    if any(len(rows) != 4 or {len(row) for row in rows} != {4} for rows in found.base_frames.values()):
        raise ValueError("a base frame is not a 4 x 4 matrix")
    return found


def kinematics_tables(folder: OutputPath, job: Job) -> list[Path]:
    """Tables of a job's corrected joints, one per domain and group of cameras; empty without optimization."""
    steps = [step for step in ("sequence", "optimize") if step in job.steps]
    return sorted((folder / steps[0]).path.glob("*/*/kinematics.csv")) if steps else []


BATCH_FILE = "batch.json"
_MAX_ERROR_LENGTH = 1000
"""Maximum length of a stored error [characters]."""
ORDER = ("failed", "lost", "stopped", "running", "waiting", "done")
"""Statuses, most urgent first."""
_JOINED = 256
"""Number of jobs whose values of joints are stored in one table."""
_ENDED = ("failed", "stopped", "done")
"""Statuses that change only with the file of the state."""


@dataclass(frozen=True)
class Results:
    """Summary of the results of a job."""

    verdicts: Mapping[str, int]
    """Verdict -> number of frames."""
    pictured: tuple[FrameFinding, ...]
    """Worst frames, which have preview images."""
    base_frames: Mapping[str, list[list[float]]]
    """As in `Findings`."""

    @property
    def frames(self) -> int:
        """Number of frames with a verdict."""
        return sum(self.verdicts.values())


@dataclass(frozen=True)
class KnownJob:
    """Job with its state and a summary of its results."""

    job: Job
    status: str
    """One of `ORDER`."""
    state: JobState
    results: Results | None = None
    damage: str = ""
    """Reason why the results cannot be read."""
    written: tuple[int, ...] = ()
    """Inodes, times [ns] and sizes [bytes] of the files of state and results."""

    @property
    def error(self) -> str:
        """Last line of the job's error, or reason why its results cannot be read; empty if there is neither."""
        lines = self.state.error.strip().splitlines()
        return lines[-1][:_MAX_ERROR_LENGTH] if lines else self.damage


class JointErrors:
    """Corrections and deviations of the joints of all jobs, as in `Findings`."""

    def __init__(self) -> None:
        self._tables: defaultdict[tuple[str, ...], list[np.ndarray]] = defaultdict(list)
        """Names of joints -> for each job, rows of their corrections and deviations, padded with NaN."""

    def add(self, found: Findings) -> None:
        """Add the values of a job."""
        names = tuple(found.corrections)
        rows = [*found.corrections.values(), *(found.deviations.get(name, []) for name in names)]
        longest = max(map(len, rows), default=0)
        padded = (row if len(row) == longest else row + (longest - len(row)) * [np.nan] for row in rows)
        values = np.fromiter(chain.from_iterable(padded), float, len(rows) * longest)
        self._tables[names].append(values.reshape(len(rows), longest))

    def joints(self) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
        """Name, corrections and deviations [deg, mm] of each joint with corrections."""
        for tables in self._tables.values():
            tables[:] = [np.concatenate(tables[n : n + _JOINED], axis=1) for n in range(0, len(tables), _JOINED)]
        for name in dict.fromkeys(chain.from_iterable(self._tables)):
            with_it = [(names.index(name), len(names), each) for names, each in self._tables.items() if name in names]
            corrections = np.concatenate([table[row] for row, _, tables in with_it for table in tables])
            deviations = np.concatenate([table[row + count] for row, count, tables in with_it for table in tables])
            if len(corrections := corrections[~np.isnan(corrections)]):
                yield name, corrections, deviations[~np.isnan(deviations)]


def known_jobs(
    batch: OutputPath, jobs: Rows[Job], before: Rows[KnownJob] = (), joints: JointErrors | None = None
) -> list[KnownJob]:
    """States and results of jobs, in the given order.

    Args:
        before: earlier result; its jobs that have ended are kept if their files have not changed.
        joints: to which corrections and deviations are added, except those of kept jobs.
    """
    earlier = {entry.job.name: entry for entry in before if entry.status in _ENDED}
    try:
        with opened_folder(batch / "jobs") as folder, gc_paused():
            return [_known(folder, job, earlier.get(job.name), joints) for job in jobs]
    except (OSError, OutputError):
        return [KnownJob(job, "waiting", JobState()) for job in jobs]


def _known(jobs: int, job: Job, before: KnownJob | None, joints: JointErrors | None) -> KnownJob:
    """State and results of a job in the open folder of all jobs; links in it are not followed."""
    written = _written(jobs, f"{job.name}/{JOB_FILE}"), _written(jobs, f"{job.name}/{FINDINGS_FILE}")
    if before is not None and before.written == written[0] + written[1]:
        return before
    try:
        folder = open_below(jobs, job.name)
    except OSError:
        return KnownJob(job, "waiting", JobState())
    try:
        state = _state(lambda: typed_json(read_bytes(JOB_FILE, VALUES, folder), JobState)) if written[0] else JobState()
        results, damage = _results(folder, joints) if written[1] else (None, "")
        # Checked last, since the check holds the lock until the folder is closed.
        lost = state.status == "running" and not _beats(state) and _is_free(folder)
    finally:
        os.close(folder)
    return KnownJob(job, "lost" if lost else state.status, state, results, damage, written[0] + written[1])


def _results(folder: int, joints: JointErrors | None) -> tuple[Results | None, str]:
    """Summary of the results in the open folder of a job, and the reason if they cannot be read; corrections and
    deviations are added to `joints`."""
    try:
        found = _findings(read_bytes(FINDINGS_FILE, VALUES, folder))
    except (OSError, ValueError) as error:
        why = str(error)[:_MAX_ERROR_LENGTH]
        return None, f"{FINDINGS_FILE} cannot be read: {why}. Run the batch again to recreate it."
    if joints is not None:
        joints.add(found)
    verdicts = Counter([frame.verdict for frame in found.frames])
    return Results(verdicts, tuple([frame for frame in found.frames if frame.picture]), found.base_frames), ""


def _written(folder: int, name: str) -> tuple[int, ...]:
    """Inode, time [ns] and size [bytes] of a file in an open folder; empty if it is not a regular file."""
    try:
        found = os.stat(name, dir_fd=folder, follow_symlinks=False)
    except OSError:
        return ()
    return (found.st_ino, found.st_mtime_ns, found.st_size) if stat.S_ISREG(found.st_mode) else ()


def _beats(state: JobState) -> bool:
    """Whether a job of another computer had a recent heartbeat; locks of network file systems may be local."""
    host = state.worker.rpartition(":")[0]
    return host != socket.gethostname() and abs(time.time() - state.heartbeat) < 3 * HEARTBEAT_SECONDS


def _is_free(folder: int) -> bool:
    """Whether no process holds the lock of a job, given by its open folder."""
    try:
        return try_lock(folder)
    except OSError:  # The file system does not support locks.
        return False


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
    rows = [
        {"name": job.name, "recording": recording, "camera": job.camera, "domain": job.domain, "steps": job.steps}
        for job, recording in zip(jobs, resolved_paths(job.recording for job in jobs), strict=True)
    ]
    write_bytes(batch / BATCH_FILE, indented_json({"format": "carts-batch-jobs/1", "jobs": rows}))


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
