"""What is known of a job: `job.json` in its folder, with a heartbeat while it runs."""

import json
import os
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Literal

import msgspec

from ..files import BusyError, OutputPath, holds_file, locked_folder, set_aside, write_text
from ..files.reading import VALUES, parse_json, read_bytes, typed

FILE = "job.json"
_FORMAT: Literal["carts-job/1"] = "carts-job/1"
HEARTBEAT_SECONDS = 10.0
"""A running job says so this often."""

Status = Literal["waiting", "running", "done", "failed", "stopped"]


@dataclass(frozen=True)
class StepState:
    """What is known of a step."""

    key: str
    """Of what it is made from; a step of another key is taken again."""
    seconds: float
    """It took so long [s]."""


@dataclass(frozen=True)
class JobState:
    """What is known of a job."""

    status: Status = "waiting"
    steps: Mapping[str, StepState] = field(default_factory=dict)
    """Those that are done."""
    attempts: Annotated[int, msgspec.Meta(ge=0)] = 0
    """How often it was begun since it was last done or failed; more than once where a worker was lost."""
    error: str = ""
    """Why it failed."""
    worker: str = ""
    """Machine and process that ran it last."""
    heartbeat: float = 0.0
    """When it was last known to run [s since 1970]."""


@dataclass(frozen=True)
class _Written(JobState):
    """Content of the file."""

    format: Literal["carts-job/1"] = _FORMAT


def read_state(folder: OutputPath) -> JobState:
    """What is known of the job of a folder; where its file is damaged, that it has failed by that."""
    try:
        return _read(folder)
    except (OSError, ValueError) as error:
        remedy = "Run the batch again: the job begins anew, and the damaged file is kept."
        return JobState("failed", error=f"{FILE} cannot be read: {error}. {remedy}")


def _read(folder: OutputPath) -> JobState:
    """What is known of a job.

    Raises:
        OSError, ValueError: the file is damaged.
    """
    path = folder / FILE
    if not holds_file(path):
        return JobState()
    values = vars(typed(parse_json(read_bytes(path.path, VALUES)), _Written))
    return JobState(**{name: value for name, value in values.items() if name != "format"})


def write_state(folder: OutputPath, state: JobState) -> None:
    """Replace what is known of a job."""
    write_text(folder / FILE, json.dumps({"format": _FORMAT, **asdict(state)}, indent=1))


def present_status(folder: OutputPath) -> tuple[str, JobState]:
    """The status of a job, `lost` where it should be running and nobody holds it, and all that is known of it."""
    state = read_state(folder)
    if state.status == "running":
        with suppress(BusyError), locked_folder(folder):
            return "lost", state
    return state.status, state


class RunningJob:
    """A job that this process runs; its state on disk, with a heartbeat.

    Attributes:
        state: what is known of it.
    """

    def __init__(self, folder: OutputPath) -> None:
        self._folder, self._changing = folder, threading.Lock()
        try:
            self.state = _read(folder)
        except (OSError, ValueError):
            set_aside(folder / FILE)
            self.state = JobState()

    def change(self, **values: object) -> None:
        """Change what is known."""
        with self._changing:
            self.state = replace(self.state, heartbeat=time.time(), **values)  # pyright: ignore[reportArgumentType]
            write_state(self._folder, self.state)

    def step_done(self, name: str, step: StepState) -> None:
        """A step was taken."""
        self.change(steps={**self.state.steps, name: step})


@contextmanager
def running(folder: OutputPath) -> Iterator[RunningJob | None]:
    """Hold a job and keep its heartbeat while the block runs; None where another process runs it."""
    with ExitStack() as held:
        try:
            held.enter_context(locked_folder(folder))
        except BusyError:
            yield None
            return
        job, ended = RunningJob(folder), threading.Event()
        job.change(status="running", error="", attempts=job.state.attempts + 1, worker=this_worker())

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


def this_worker() -> str:
    """Machine and process, for people."""
    return f"{socket.gethostname()}:{os.getpid()}"
