"""Jobs of `carts batch`: subcommands run in sequence, with outputs in the job's folder."""

import contextlib
import io
import time
import traceback
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from ..batch.engines import Outcome
from ..batch.folder import (
    FINDINGS_FILE,
    RunningJob,
    StepState,
    kinematics_tables,
    read_findings,
    running,
)
from ..batch.manifest import Job, Step
from ..console import Terminal, log_to_stderr
from ..errors import CartsError, SettingsError
from ..files import OutputPath, remove_file, set_aside, write_text
from ..process import processor_time, tune_process
from ..settings.optimization import Inference
from .calibrate import Calibrate
from .export import Export
from .importing import Import
from .optimize import Evaluate, Optimize
from .options import NO_PROJECT, ProjectOption

_COMMANDS: dict[Step, type] = {
    "import": Import,
    "calibrate": Calibrate,
    "optimize": Optimize,
    "sequence": Optimize,
    "evaluate": Evaluate,
    "export": Export,
}
_GIVEN = ("--output", "-o", "--overwrite", "--json", "--kinematics", "--mode", "--camera", "--domain")
"""Options that a job sets itself."""
_CORRECTING: tuple[Step, ...] = ("import", "calibrate", "optimize", "sequence")
"""Steps whose results the job evaluates and exports, in place of the project beside the recording."""
_CODE = ("**/*.py",)


@dataclass(frozen=True)
class BatchWork:
    """Runs jobs in worker processes.

    Args:
        folder: folder of the batch.
        again: whether finished steps are repeated.
        inference: inference engine of the surface network on all machines, unless the options of a step select another
            engine.
        project: whether the project beside a recording is applied; see `with_project`.
    """

    folder: OutputPath
    again: bool = False
    inference: Inference = "auto"
    project: Literal["beside", "none"] = "beside"

    def __call__(self, job: Job) -> Outcome:
        """Run the unfinished steps of a job."""
        began, before = time.perf_counter(), processor_time()
        folder = self.folder / "jobs" / job.name
        with running(folder) as state:
            if state is None:
                return Outcome(job.name, "busy")
            try:
                done, frames = _steps(job, folder, state, self)
            except KeyboardInterrupt:
                state.change(status="stopped")
                raise
            except CartsError as error:
                return _failed(job, state, str(error), began)
            except Exception as error:  # A failed job does not stop the others.
                return _failed(job, state, "".join(traceback.format_exception(error)), began)
            state.change(status="done", attempts=0)
        seconds, processor = time.perf_counter() - began, processor_time() - before
        return Outcome(job.name, "done" if done else "known", "", seconds, processor, frames)


def with_project(job: Job) -> Path | None:
    """Project beside the recording, for a job that only evaluates or exports; None for other jobs."""
    used = {"evaluate", "export"} & set(job.steps) and not set(_CORRECTING) & set(job.steps)
    return ProjectOption().path(job.recording) if used else None


def check_options(jobs: Sequence[Job]) -> None:
    """Check the options of all steps before the first job; `SettingsError` for options that a command does not have or
    that the job sets itself."""
    called: set[tuple[Step, tuple[str, ...]]] = set()
    for job in jobs:
        called |= {(step, job.options.get(step, ())) for step in job.steps}
    for step, options in sorted(called):
        for option in options:
            if option.partition("=")[0] in _GIVEN:
                raise SettingsError(f"options of {step}: {option} is set by the batch. Leave it out.")
        _parsed(step, ["recording", *(["output"] if step == "export" else []), *options])


def _parsed(step: Step, arguments: list[str]) -> Any:
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            return tyro.cli(_COMMANDS[step], prog=f"carts {step}", args=arguments)
    except SystemExit as end:
        raise SettingsError(
            f"options of {step}: `carts {step} {' '.join(arguments)}` is not a valid command.\n{said.getvalue()}"
        ) from end


def _failed(job: Job, state: RunningJob, error: str, began: float) -> Outcome:
    state.change(status="failed", attempts=0, error=error)
    return Outcome(job.name, "failed", error, time.perf_counter() - began)


def _steps(job: Job, folder: OutputPath, state: RunningJob, work: BatchWork) -> tuple[int, int]:
    """Run the unfinished steps; returns their number, and the number of frames with a verdict."""
    # Imported here, because the process that starts the workers needs neither recordings nor robots.
    from ..batch.results import write_findings
    from ..provenance import code_fingerprint, fingerprint

    tune_process()
    log_to_stderr()
    done, key = 0, fingerprint(code_fingerprint(_CODE), *map(str, _inputs(job.recording)))
    project = with_project(job) if work.project == "beside" else None
    sequence = job.recording
    for step in job.steps:
        options = (*job.options.get(step, ()), *_inference(step, job, work.inference))
        if project is None and step in ("evaluate", "export") and not _given(options, "--project"):
            options = (*options, "--project", NO_PROJECT)
        inputs = [_inputs(Path(text)) for text in options]
        corrections = [] if project is None else [_inputs(project), _inputs(project.with_name(f"{project.name}-wal"))]
        key = fingerprint(key, step, job.camera, job.domain, options, inputs, *corrections)
        known = state.state.steps.get(step)
        if work.again or known is None or known.key != key:
            # The findings describe earlier results. After a kill, they are written again when the job resumes.
            remove_file(folder / FINDINGS_FILE)
            with _measured(state, step, key), _logged(folder / f"{step}.log"):
                _parsed(step, [*_arguments(job, step, sequence, folder), *options]).run()
            done += 1
        if step in ("import", "calibrate"):
            sequence = (folder / _FOLDERS[step] / "sequence.toml").path
    try:
        found = read_findings(folder)
    except (OSError, ValueError):
        set_aside(folder / FINDINGS_FILE)
        found = None
    if found is None:
        with _measured(state, "findings", key):
            found = write_findings(job, folder, sequence)
    return done, len(found.frames)


@contextlib.contextmanager
def _measured(state: RunningJob, step: str, key: str) -> Iterator[None]:
    """Add the block to the finished steps, with its duration and processor time."""
    began, before = time.perf_counter(), processor_time()
    yield
    seconds, processor = round(time.perf_counter() - began, 3), round(processor_time() - before, 3)
    state.change(steps={**state.state.steps, step: StepState(key, seconds, processor)})


def _inference(step: Step, job: Job, inference: Inference) -> tuple[str, ...]:
    """Options that select the same inference engine on every machine, for steps that run the network on a CPU."""
    if step in ("import", "export") or _given(job.options.get(step, ()), "--device"):
        return ()
    return ("--device", "cpu" if inference == "auto" else f"cpu:{inference}")


def _given(options: Iterable[str], name: str) -> bool:
    return any(option.partition("=")[0] == name for option in options)


_FOLDERS: dict[Step, str] = {"import": "recording", "calibrate": "calibration"}


def _arguments(job: Job, step: Step, sequence: Path, folder: OutputPath) -> list[str]:
    """Arguments of a step's command that precede its options."""
    chosen = ["--camera", job.camera, *(["--domain", job.domain] if job.domain else [])]
    output = str(folder / _FOLDERS.get(step, step))
    match step:
        case "import":
            arguments = ["--output", output, "--overwrite"]
        case "calibrate":
            arguments = ["--output", output, "--overwrite", *chosen]
        case "optimize":
            arguments = ["--output", output, *chosen]
        case "sequence":
            arguments = ["--output", output, "--mode", "sequence", *chosen]
        case "evaluate":
            arguments = ["--json", str(folder / "evaluation.json"), *chosen]
        case "export":
            table = _table(job, folder)
            arguments = [output, "--overwrite", *(["--kinematics", str(table)] if table else []), *chosen]
    return [str(sequence), *arguments]


def _table(job: Job, folder: OutputPath) -> Path | None:
    """Kinematics table of an earlier step; None without optimization. `SettingsError` if each camera has its own
    table."""
    found = kinematics_tables(folder, job)
    if len(found) > 1:
        raise SettingsError(
            f"job {job.name}: {len(found)} cameras were solved separately, but an export uses one table. Give one "
            "camera per job, or add --together to the options."
        )
    return found[0] if found else None


def _inputs(path: Path) -> list[str | int]:
    """Path, size and modification time of a file; empty if it does not exist."""
    try:
        found = path.stat()
    except (OSError, ValueError):
        return []
    return [str(path), found.st_size, found.st_mtime_ns]


@contextlib.contextmanager
def _logged(path: OutputPath) -> Iterator[None]:
    """Redirect the output of the block to a file."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            try:
                yield
            except CartsError as error:
                Terminal().print_error(error)
                raise
    finally:
        write_text(path, printed.getvalue())
