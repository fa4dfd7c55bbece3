"""Jobs of the viewer, their options, and the list of jobs in `PROJECT_jobs.json` beside the project."""

import json
import secrets
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import msgspec

from carts_core.errors import CartsError
from carts_core.export import FORMATS, FormatName, Parts
from carts_core.files import output_path, write_text
from carts_core.files.reading import Kind, parse_json, read_text, typed
from carts_core.settings import Masks
from carts_core.settings.serialization import to_plain
from carts_viewer.jobs.choices import Choices, read_choices
from carts_viewer.jobs.companions import Decisions, set_aside_damaged

_MAX_ENDED = 50
"""Maximum number of ended jobs in the list."""
_MAX_JOBS = 1000
"""Maximum number of jobs in the file."""
_MAX_LOG = 200
"""Maximum number of lines of a log."""
_MAX_TEXT = 2000
"""Maximum length of a title, text or line [characters]."""
_FILE = Kind("list of jobs", 8 * 2**20)
MAX_CALIBRATION_FRAMES = 500
"""Maximum number of frames of a calibration."""
MAX_TRAINING_TIME = 240
"""Maximum training time [min]."""
_MAX_NETWORK_NUMBER = 999_999
"""Maximum number of an adapted network."""


# ---- Options ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SolveOptions:
    """Options for solving frames together."""

    whole: bool = False
    at: int = 0
    """Index of a frame; the frames between the nearest kept frames are solved."""
    range: tuple[int, int] | None = None
    """First and last frame; None for the whole sequence."""


@dataclass(frozen=True)
class OptimizeOptions:
    """Options for optimizing frames individually."""

    frames: tuple[int, ...]
    """Frame indices."""
    first: int = 0
    """Index in `frames` of the first frame to optimize."""


@dataclass(frozen=True)
class CalibrateOptions:
    """Options of a calibration."""

    frames: int
    """Number of frames."""


@dataclass(frozen=True)
class AdaptOptions:
    """Options of the adaptation of the network."""

    minutes: int
    """Processor time limit [min]."""
    folder: int
    """Number of the folder of the network."""


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export, as in `intents.Export`."""

    format: FormatName
    frames: str
    parts: Parts = "arms"
    images: bool = False
    shown_camera: bool = False
    range: tuple[int, int] | None = None
    masks: Masks = "auto"


Options = SolveOptions | OptimizeOptions | CalibrateOptions | AdaptOptions | ExportOptions
_KINDS: dict[str, type[Options]] = {
    "solve": SolveOptions,
    "optimize": OptimizeOptions,
    "calibrate": CalibrateOptions,
    "adapt": AdaptOptions,
    "export": ExportOptions,
}


def read_options(kind: str, values: Mapping[str, Any], frames: int) -> Options:
    """Options of a job with checked types, clamped to the ranges of the page.

    Raises:
        ValueError: the kind of job is unknown, or a value is missing or of the wrong type.
    """
    if kind not in _KINDS:
        raise ValueError(f"unknown kind of job: {kind!r}")
    options, last = typed(values, _KINDS[kind]), frames - 1
    match options:
        case SolveOptions():
            return replace(options, at=_within(options.at, 0, last), range=_range(options.range, last))
        case OptimizeOptions():
            indices = tuple(dict.fromkeys(index for index in options.frames if 0 <= index <= last))
            return OptimizeOptions(indices, _within(options.first, 0, len(indices)))
        case CalibrateOptions():
            return CalibrateOptions(_within(options.frames, 1, MAX_CALIBRATION_FRAMES))
        case AdaptOptions():
            minutes = _within(options.minutes, 1, MAX_TRAINING_TIME)
            return AdaptOptions(minutes, _within(options.folder, 1, _MAX_NETWORK_NUMBER))
        case ExportOptions():
            return replace(options, range=_range(options.range, last))


def _range(ends: tuple[int, int] | None, last: int) -> tuple[int, int] | None:
    if ends is None:
        return None
    first, second = sorted(_within(end, 0, last) for end in ends)
    return first, second


def _within(value: int, low: int, high: int) -> int:
    return min(max(value, low), high)


def job_title(options: Options, frame_ids: Sequence[str]) -> str:
    """Title of a job with these options."""
    part = getattr(options, "range", None)
    between = None if part is None else f"frames {frame_ids[part[0]]} to {frame_ids[part[1]]}"
    match options:
        case SolveOptions(whole=True):
            return f"Solve {between or 'all frames'}"
        case SolveOptions():
            return "Solve between keyframes" + (f", {between}" if between else "")
        case OptimizeOptions(frames=frames):
            return f"Optimize {len(frames)} frames individually"
        case CalibrateOptions(frames=frames):
            return f"Calibrate on {frames} frames"
        case AdaptOptions(minutes=minutes):
            return f"Adapt the network to this recording, at most {minutes} minutes of processor time"
        case ExportOptions():
            label = FORMATS[options.format].label if options.format in FORMATS else options.format
            return f"Export {options.frames.lower()[:40]} as {label}" + (f", {between}" if between else "")


# ---- The list --------------------------------------------------------------------------------------------------------


class JobState(StrEnum):
    """State of a job."""

    ASKED = "asked"
    """Queued by another user or on another computer, and needs confirmation."""
    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


@dataclass(frozen=True)
class Job:
    """A long-running task."""

    number: Annotated[int, msgspec.Meta(ge=1)]
    kind: str
    title: str
    """Title, as text for the user."""
    options: Options
    """All data to repeat the job, together with its kind and choices."""
    state: JobState = JobState.WAITING
    done: Annotated[int, msgspec.Meta(ge=0)] = 0
    total: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Number of steps; 0 if unknown."""
    began: float = 0.0
    """Time of the start [s since 1970]; 0 until then."""
    ended: float = 0.0
    text: str = ""
    """Progress or result, as text for the user."""
    log: tuple[str, ...] = ()
    token: str = ""
    """Random token; with kind, options, choices and recording it identifies the jobs that this user has queued."""
    choices: Choices | None = None
    """Choices of the tab that queued the job; None in lists of earlier versions, for those of a new tab."""

    @property
    def over(self) -> bool:
        """Whether the job has ended."""
        return self.state in (JobState.DONE, JobState.FAILED, JobState.CANCELLED)

    @property
    def frames(self) -> range | None:
        """Range of frames of a solve or an export; None for the whole sequence and for other jobs."""
        ends = getattr(self.options, "range", None)
        return None if ends is None else range(ends[0], ends[1] + 1)

    def seconds_left(self, now: float) -> float | None:
        """Estimated remaining time [s]; None if unknown."""
        if self.state is not JobState.RUNNING or not self.done or not self.total:
            return None
        return max(0.0, (now - self.began) / self.done * (self.total - self.done))


@dataclass(frozen=True)
class _Row(Job):
    """A job in the format of the file."""

    options: dict[str, Any] = field(default_factory=dict)  # pyright: ignore[reportIncompatibleVariableOverride]
    choices: dict[str, Any] | None = None  # pyright: ignore[reportIncompatibleVariableOverride]


class JobList:
    """All jobs, oldest first; every change of a state is saved before work continues, if the file can be written.

    Attributes:
        jobs: the list.
        problem: message about a damaged file; empty if the file was not damaged.
        unsaved: message about the last write, if it failed; otherwise empty.
    """

    def __init__(
        self, project: Path, *, kept: bool, frame_ids: Sequence[str], recording: str = "", decisions: Decisions
    ) -> None:
        """`recording`: digest of the recording; jobs in a list of another recording do not count as this user's."""
        self._path = output_path(project.parent, f"{project.stem}_jobs.json") if kept else None
        self._frame_ids, self._recording, self._decisions = frame_ids, recording, decisions
        self.problem = self.unsaved = ""
        self.jobs: tuple[Job, ...] = tuple(map(self._resumed, self._read()))

    def add(self, kind: str, values: Mapping[str, Any], choices: Choices | None = None) -> Job:
        """Queue a job with the choices of a tab.

        Raises:
            CartsError: the kind or an option is invalid, or the list cannot be written.
        """
        try:
            options = read_options(kind, values, len(self._frame_ids))
            # The same values as after a restart, since they identify the job.
            choices = None if choices is None else read_choices(to_plain(choices))
        except ValueError as error:
            raise CartsError(f"This job cannot be queued: {error}. Choose its options again.") from error
        number = max((job.number for job in self.jobs), default=0) + 1
        job = self._own(Job(number, kind, job_title(options, self._frame_ids), options, choices=choices))
        ended = [job for job in self.jobs if job.over]
        self._drop(ended[: max(len(ended) - _MAX_ENDED, 0)])
        self.jobs = (*self.jobs, job)
        try:
            self._write()
        except CartsError:
            self._drop([job])
            raise
        return job

    def change(self, number: int, line: str | None = None, **changes: Any) -> None:
        """Change fields of a job, and append a line to its log."""
        before = self.jobs
        self.jobs = tuple(_changed(job, line, changes) if job.number == number else job for job in self.jobs)
        if [job.state for job in before] != [job.state for job in self.jobs]:
            self.save()

    def accept(self, number: int, options: Options) -> None:
        """Queue a job of another user, with these options, as a job of this user."""
        job = replace(self.find(number), state=JobState.WAITING, options=options)
        job = self._own(job)
        self.jobs = tuple(job if each.number == number else each for each in self.jobs)
        self.save()

    def is_own(self, job: Job) -> bool:
        """Whether this user has queued or accepted a job on this machine."""
        return bool(job.token) and self._decisions.find(self._identity(job)) is True

    def save(self) -> None:
        """Write the list; a failure is kept in `unsaved`, since jobs continue without the file."""
        self.unsaved = ""
        try:
            self._write()
        except CartsError as error:
            self.unsaved = f"Jobs would be lost if the viewer was closed now: {error}"

    def forget(self) -> None:
        """Remove ended jobs from the list."""
        self._drop([job for job in self.jobs if job.over])
        self.save()

    def find(self, number: int) -> Job:
        """A job by its number.

        Raises:
            CartsError: there is no job with this number.
        """
        job = next((job for job in self.jobs if job.number == number), None)
        if job is None:
            raise CartsError(f"Job {number} no longer exists.")
        return job

    def _own(self, job: Job) -> Job:
        """Give a job a new token, and record that this user approved it."""
        job = replace(job, token=secrets.token_hex(16))
        self._decisions.make(self._identity(job), True)
        return job

    def _identity(self, job: Job) -> bytes:
        chosen = [] if job.choices is None else [to_plain(job.choices)]
        values = [self._recording, job.token, job.kind, asdict(job.options), *chosen]
        return json.dumps(values, sort_keys=True).encode()

    def _drop(self, dropped: Sequence[Job]) -> None:
        for job in dropped:
            if job.token:
                self._decisions.forget(self._identity(job))
        self.jobs = tuple(job for job in self.jobs if job not in dropped)

    def _write(self) -> None:
        if self._path is not None:
            write_text(self._path, json.dumps([to_plain(job) for job in self.jobs], indent=1))

    def _read(self) -> list[Job]:
        """The jobs of the file; a damaged file is set aside and a new list started."""
        if self._path is None:
            return []
        try:
            rows = typed(parse_json(read_text(self._path.path, _FILE)), list[_Row])
            numbers = [row.number for row in rows]
            if len(set(numbers)) < len(numbers) or len(numbers) > _MAX_JOBS:
                raise ValueError(f"it has more than {_MAX_JOBS} jobs, or duplicate numbers")
            return [self._job(row) for row in rows]
        except FileNotFoundError:
            return []
        except (OSError, ValueError) as error:
            self.problem = set_aside_damaged(
                self._path.path, "list of jobs", error, "A new list was started; no job is running"
            )
            return []

    def _job(self, row: _Row) -> Job:
        options = read_options(row.kind, row.options, len(self._frame_ids))
        choices = None if row.choices is None else read_choices(row.choices)
        texts = {
            "text": row.text[:_MAX_TEXT],
            "log": tuple(line[:_MAX_TEXT] for line in row.log[-_MAX_LOG:]),
        }
        title = job_title(options, self._frame_ids)
        return Job(**{**vars(row), **texts, "options": options, "choices": choices, "title": title})

    def _resumed(self, job: Job) -> Job:
        """A job after a restart: a waiting job of another user needs confirmation, and a running job has failed."""
        if job.state in (JobState.WAITING, JobState.ASKED):
            return replace(job, state=JobState.WAITING if self.is_own(job) else JobState.ASKED)
        if job.state is not JobState.RUNNING:
            return job
        text = "The viewer was closed during the job. Saved results are kept; start the job again to continue."
        return _changed(job, text, {"state": JobState.FAILED, "text": text, "ended": time.time()})


def _changed(job: Job, line: str | None, changes: Mapping[str, Any]) -> Job:
    if line is not None:
        changes = {**changes, "log": (*job.log, f"{time.strftime('%H:%M:%S')} {line}")[-_MAX_LOG:]}
    return replace(job, **changes)
