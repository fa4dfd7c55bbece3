"""Work that takes no time, for processes of an engine: it writes a file, and dies where it is told to."""

import os
import signal
from dataclasses import dataclass

from carts_core.batch.engines import Outcome
from carts_core.batch.folder import read_state, running
from carts_core.batch.manifest import Job
from carts_core.files import OutputPath, append_line, write_text


@dataclass(frozen=True)
class LightWork:
    """Writes a line for every beginning, and the result; jobs named in `dies` kill their worker that many times."""

    folder: OutputPath
    dies: tuple[tuple[str, int], ...] = ()
    fails: tuple[str, ...] = ()

    def __call__(self, job: Job) -> Outcome:
        """Do a job."""
        folder = self.folder / job.name
        before = read_state(folder).status
        with running(folder) as state:
            assert state is not None
            if before == "done":  # Its worker died before it could say so.
                state.change(status="done")
                return Outcome(job.name, "known")
            append_line(folder / "begun.txt", b"begun")
            begun = (folder / "begun.txt").path.read_text().count("begun")
            if begun <= dict(self.dies).get(job.name, 0):
                os.kill(os.getpid(), signal.SIGKILL)
            if job.name in self.fails:
                state.change(status="failed", error="as asked for")
                return Outcome(job.name, "failed", "as asked for")
            write_text(folder / "result.txt", job.name)
            state.change(status="done", attempts=0)
        return Outcome(job.name, "done")
