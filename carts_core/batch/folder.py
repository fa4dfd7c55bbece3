"""A batch on disk: which jobs it has, and what is known of each."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path, PurePath
from typing import Literal

from ..errors import SettingsError
from ..files import OutputPath, check_name, write_text
from ..files.reading import VALUES, parse_json, read_bytes, typed
from .findings import FILE as FINDINGS
from .findings import Findings, read_findings
from .manifest import STEPS, Job, Step
from .state import JobState, present_status

FILE = "batch.json"
_LONGEST_ERROR = 1000
"""Characters."""
ORDER = ("failed", "lost", "stopped", "running", "waiting", "done")
"""Statuses, those that need somebody first."""


@dataclass(frozen=True)
class KnownJob:
    """What is known of a job."""

    job: Job
    status: str
    """One of `ORDER`."""
    state: JobState
    findings: Findings | None
    damage: str = ""
    """Why its findings cannot be read, for people."""

    @property
    def error(self) -> str:
        """The last line of why it failed, or why its findings cannot be read; empty otherwise."""
        lines = self.state.error.strip().splitlines()
        return lines[-1][:_LONGEST_ERROR] if lines else self.damage


def known_jobs(batch: OutputPath, jobs: Sequence[Job]) -> list[KnownJob]:
    """What is known of jobs, in their order."""
    return [_known(batch / "jobs" / job.name, job) for job in jobs]


def _known(folder: OutputPath, job: Job) -> KnownJob:
    if not folder.path.is_dir():
        return KnownJob(job, "waiting", JobState(), None)
    status, state = present_status(folder)
    try:
        return KnownJob(job, status, state, read_findings(folder))
    except (OSError, ValueError) as error:
        damage = f"{FINDINGS} cannot be read: {str(error)[:_LONGEST_ERROR]}. Run the batch again to make it anew."
        return KnownJob(job, status, state, None, damage)


def most_urgent_first(known: Sequence[KnownJob]) -> list[KnownJob]:
    """Failures first, what is done last."""
    return sorted(known, key=lambda entry: ORDER.index(entry.status))


@dataclass(frozen=True)
class _Row:
    """A job in the file."""

    name: str
    recording: str
    camera: str
    domain: str
    steps: tuple[Step, ...]


@dataclass(frozen=True)
class _Batch:
    """Content of the file."""

    format: Literal["carts-batch-jobs/1"]
    jobs: list[_Row]


def write_jobs(batch: OutputPath, jobs: Sequence[Job]) -> None:
    """Write which jobs a batch has, so that it can be looked at without its manifest."""
    rows = [_Row(job.name, str(job.recording.resolve()), job.camera, job.domain, job.steps) for job in jobs]
    write_text(batch / FILE, json.dumps(asdict(_Batch("carts-batch-jobs/1", rows)), indent=1))


def is_batch(folder: Path) -> bool:
    """Whether a folder is that of a batch."""
    return (folder / FILE).is_file()


def read_jobs(folder: Path) -> list[Job]:
    """The jobs of a batch's folder, without their options.

    Raises:
        SettingsError: it is no batch, or its list of jobs is damaged.
    """
    try:
        content = typed(parse_json(read_bytes(folder / FILE, VALUES)), _Batch)
        jobs = [_job(row) for row in content.jobs]
        for job in jobs:
            check_name(job.name, f"a job of {folder}")
    except (OSError, ValueError) as error:
        raise SettingsError(
            f"{folder} is no batch that can be read: {error}. Name the folder that carts batch has written to."
        ) from error
    return jobs


def _job(row: _Row) -> Job:
    if not PurePath(row.recording).is_absolute():
        raise ValueError(f"the recording {row.recording!r} is no absolute path")
    steps: tuple[Step, ...] = tuple(step for step in STEPS if step in row.steps)
    return Job(row.name, Path(row.recording), row.camera, row.domain, steps, {})
