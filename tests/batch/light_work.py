"""Light work for processes of an engine, which import it without torch."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path

from carts_core.batch.engines import Outcome
from carts_core.batch.manifest import Job


@dataclass(frozen=True)
class LightWork:
    """Appends a line to a file of the job; jobs named in `dies` kill their worker that many times, and those in
    `raises` raise an error."""

    folder: Path
    dies: tuple[tuple[str, int], ...] = ()
    fails: tuple[str, ...] = ()
    raises: tuple[str, ...] = ()

    def begun(self, job: str) -> int:
        """Number of times that a job was begun."""
        path = self.folder / job
        return len(path.read_text().splitlines()) if path.is_file() else 0

    def __call__(self, job: Job) -> Outcome:
        """Do a job."""
        with (self.folder / job.name).open("a") as file:
            file.write("begun\n")
        if self.begun(job.name) <= dict(self.dies).get(job.name, 0):
            os.kill(os.getpid(), signal.SIGKILL)
        if job.name in self.raises:
            raise OSError("No space left on device")
        if job.name in self.fails:
            return Outcome(job.name, "failed", "as asked for")
        return Outcome(job.name, "done")


def process_and_threads(job: Job) -> Outcome:
    """The worker's process and its number of threads."""
    return Outcome(job.name, "done", f"{os.getpid()} {os.environ['OMP_NUM_THREADS']}")
