"""A batch on disk: which jobs it has, and what is known of each."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

from ..errors import SettingsError
from ..files import OutputPath, check_name, write_text
from ..files.reading import VALUES, parse_json, read_bytes
from .findings import Findings, read_findings
from .manifest import STEPS, Job
from .state import JobState, present_status

FILE = "batch.json"
_FORMAT = "carts-batch-jobs/1"
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

    @property
    def error(self) -> str:
        """The last line of why it failed; empty if it has not."""
        lines = self.state.error.strip().splitlines()
        return lines[-1] if lines else ""


def known_jobs(batch: OutputPath, jobs: Sequence[Job]) -> list[KnownJob]:
    """What is known of jobs, in their order."""
    known = []
    for job in jobs:
        place = batch / "jobs" / job.name
        there = place.path.is_dir()
        status, state = present_status(place) if there else ("waiting", JobState())
        known.append(KnownJob(job, status, state, read_findings(place) if there else None))
    return known


def most_urgent_first(known: Sequence[KnownJob]) -> list[KnownJob]:
    """Failures first, what is done last."""
    return sorted(known, key=lambda entry: ORDER.index(entry.status))


def write_jobs(batch: OutputPath, jobs: Sequence[Job]) -> None:
    """Write which jobs a batch has, so that it can be looked at without its manifest."""
    rows = [
        {
            "name": job.name,
            "recording": str(job.recording.resolve()),
            "camera": job.camera,
            "domain": job.domain,
            "steps": list(job.steps),
        }
        for job in jobs
    ]
    write_text(batch / FILE, json.dumps({"format": _FORMAT, "jobs": rows}, indent=1))


def is_batch(folder: Path) -> bool:
    """Whether a folder is that of a batch."""
    return (folder / FILE).is_file()


def read_jobs(folder: Path) -> list[Job]:
    """The jobs of a batch's folder, without their options.

    Raises:
        SettingsError: it is no batch, or its list of jobs is damaged.
    """
    try:
        content = parse_json(read_bytes(folder / FILE, VALUES))
        if content["format"] != _FORMAT:
            raise ValueError(f"its format is {content['format']!r}")
        jobs = [_job(row) for row in content["jobs"]]
        for job in jobs:
            check_name(job.name, f"a job of {folder}")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise SettingsError(
            f"{folder} is no batch that can be read: {error}. Name the folder that carts batch has written to."
        ) from error
    return jobs


def _job(row: dict) -> Job:
    name, recording, camera, domain = (str(row[key]) for key in ("name", "recording", "camera", "domain"))
    if not PurePath(recording).is_absolute():
        raise ValueError(f"the recording {recording!r} is no absolute path")
    return Job(name, Path(recording), camera, domain, tuple(step for step in STEPS if step in row["steps"]), {})
