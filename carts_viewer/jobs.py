"""The list of jobs: what waits, what runs, what came of it. Kept in a file beside the project, whatever happens."""

import json
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from carts_core.errors import CartsError
from carts_core.files import output_path, write_text
from carts_core.files.reading import Kind, read_text

_KEPT = 50
"""Jobs that are remembered when they have ended."""
_LONGEST_LOG = 200
"""Lines."""
_FILE = Kind("list of jobs", 8 * 2**20)


class JobState(StrEnum):
    """Where a job is."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


@dataclass(frozen=True)
class Job:
    """Something that takes long."""

    number: int
    kind: str
    title: str
    """For people."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """What JSON can hold; with the kind, all that is needed to do it again."""
    state: JobState = JobState.WAITING
    done: int = 0
    total: int = 0
    """Steps; 0 until it is known."""
    began: float = 0.0
    """[s since 1970]; 0 before."""
    ended: float = 0.0
    text: str = ""
    """How it goes, or what came of it, for people."""
    log: tuple[str, ...] = ()

    @property
    def over(self) -> bool:
        """Whether nothing more will come of it."""
        return self.state not in (JobState.WAITING, JobState.RUNNING)

    @property
    def frames(self) -> range | None:
        """The part of the sequence that it is about; None for all of it."""
        ends = self.options.get("range")
        return None if ends is None else range(int(ends[0]), int(ends[1]) + 1)

    def seconds_left(self, now: float) -> float | None:
        """How long it will go on if it goes on like that [s]; None where nobody knows."""
        if self.state is not JobState.RUNNING or not self.done or not self.total:
            return None
        return max(0.0, (now - self.began) / self.done * (self.total - self.done))


class JobList:
    """All jobs, oldest first; every change of a state is on disk before the next thing is done."""

    def __init__(self, project: Path, *, kept: bool) -> None:
        """
        Args:
            project: The project's file, beside which the list lies.
            kept: Whether the list may be written.
        """
        self._file = project.with_name(f"{project.stem}_jobs.json")
        self._path = output_path(project.parent, f"{project.stem}_jobs.json") if kept else None
        self.jobs: tuple[Job, ...] = tuple(_interrupted(job) for job in self._read())

    def add(self, kind: str, title: str, options: Mapping[str, Any]) -> Job:
        """Queue a job."""
        number = max((job.number for job in self.jobs), default=0) + 1
        job = Job(number, kind, title, dict(options))
        ended = [job for job in self.jobs if job.over]
        dropped = ended[: max(len(ended) - _KEPT, 0)]
        self.jobs = (*(job for job in self.jobs if job not in dropped), job)
        self._write()
        return job

    def change(self, number: int, line: str | None = None, **changes: Any) -> None:
        """Change a job; a line is added to its log."""
        before = self.jobs
        self.jobs = tuple(_changed(job, line, changes) if job.number == number else job for job in self.jobs)
        if [job.state for job in before] != [job.state for job in self.jobs]:
            self._write()

    def save(self) -> None:
        """Write how far jobs are."""
        self._write()

    def forget(self) -> None:
        """Take what is over off the list."""
        self.jobs = tuple(job for job in self.jobs if not job.over)
        self._write()

    def find(self, number: int) -> Job:
        """A job by its number.

        Raises:
            CartsError: there is none.
        """
        job = next((job for job in self.jobs if job.number == number), None)
        if job is None:
            raise CartsError(f"There is no job {number} any more.")
        return job

    def _write(self) -> None:
        if self._path is not None:
            write_text(self._path, json.dumps([asdict(job) for job in self.jobs], indent=1))

    def _read(self) -> list[Job]:
        """What was written; a list that cannot be read is begun anew, for it holds nothing that is not elsewhere."""
        try:
            if self._path is None:
                return []
            rows = json.loads(read_text(self._file, _FILE))
            return [Job(**{**row, "state": JobState(row["state"]), "log": tuple(map(str, row["log"]))}) for row in rows]
        except (OSError, ValueError, TypeError, KeyError, RecursionError):
            return []


def _changed(job: Job, line: str | None, changes: Mapping[str, Any]) -> Job:
    if line is not None:
        changes = {**changes, "log": (*job.log, f"{time.strftime('%H:%M:%S')} {line}")[-_LONGEST_LOG:]}
    return replace(job, **changes)


def _interrupted(job: Job) -> Job:
    """A job of a viewer that has ended: what waited waits, what ran has failed and can be done again."""
    if job.state is not JobState.RUNNING:
        return job
    text = "The viewer ended while it ran. What it had saved is there; start it again for the rest."
    return _changed(job, text, {"state": JobState.FAILED, "text": text, "ended": time.time()})
