"""The Check step of New recording: content of the files, previews, problems, and corrections of guesses."""

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import get_args

import numpy as np

from carts_core.errors import CartsError, SettingsError
from carts_core.model.psm_kinematics import JOINT_NAMES
from carts_core.recording import Sequence, TimeOffsetEstimate
from carts_core.recording.importing.cameras import find_images
from carts_core.recording.importing.columns import ColumnMeanings, guess_columns, sample
from carts_core.recording.importing.delays import estimated_delays, is_timed, with_delays, with_times
from carts_core.recording.importing.foreign_tables import ForeignTable
from carts_core.recording.importing.found import FoundArm, FoundRecording, Note, NoteKind, Part, PartError
from carts_core.recording.importing.importer import detect, find
from carts_core.recording.sources.datasets import JIGSAWS, jigsaws_trials
from carts_core.recording.sources.folder import kinematics_table
from carts_core.settings.interchange import NO_TABLE, AngleUnit, ImportOptions, LengthUnit
from carts_viewer.picture.layers import small_jpeg
from carts_viewer.transport.document import render
from carts_viewer.wizard.draft import MEANINGS, Draft

_COLORS = ("#2dd4a7", "#60a5fa", "#facc15", "#e879f9", "#fb923c", "#f87171", "#a3a3a3")
_WIDTH, _HEIGHT = 600, 150
_MAX_POINTS = 400
_PREVIEW_WIDTH = 360
_JPEG_QUALITY = 75
_SHARE_STEP = 0.02
"""Minimum increase of a reported share [1]."""


@dataclass(frozen=True)
class Curve:
    """Values of a joint over time, scaled to their range."""

    points: str
    """Points of an SVG polyline."""
    color: str
    label: str
    """Name and range."""


def curves(arm: FoundArm) -> list[Curve]:
    """Curves of all joints of an arm."""
    if arm.values is None or not len(arm.values):
        return []
    rows = np.unique(np.linspace(0, len(arm.values) - 1, min(len(arm.values), _MAX_POINTS)).astype(int))
    x = rows.astype(float) if arm.times is None else arm.times[rows]
    x = (x - x[0]) / max(float(x[-1] - x[0]), 1e-9) * (_WIDTH - 8) + 4
    found = []
    for column, (name, color) in enumerate(zip(arm.columns, _COLORS, strict=False)):
        values = arm.values[rows, column]
        low, high = float(np.nanmin(arm.values[:, column])), float(np.nanmax(arm.values[:, column]))
        y = _HEIGHT - 6 - (values - low) / max(high - low, 1e-9) * (_HEIGHT - 12)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True) if np.isfinite(b))
        scale, unit = (1e3, "mm") if name == JOINT_NAMES[2] else (180 / np.pi, "°")
        least, most = np.round([scale * low, scale * high]) + 0.0  # no minus before 0
        label = f"{name.replace('_', ' ')} {least:.0f} to {most:.0f} {unit}"
        found.append(Curve(points, color, label))
    return found


def previews(sequence: Sequence, camera: str) -> list[tuple[str, bytes]]:
    """First, middle and last image of a camera: id of the frame and JPEG content."""
    found = []
    present = sequence.frames_of(camera)
    for index in dict.fromkeys((present[0], present[len(present) // 2], present[-1])):
        frame = sequence.frame(index, cameras=[camera])
        found.append((frame.frame_id, small_jpeg(frame.images[camera], width=_PREVIEW_WIDTH, quality=_JPEG_QUALITY)))
    return found


FOLDER = "folder"
_WHOLE: tuple[Part, str] = ("recording", "")
"""Key of problems of the recording as a whole."""


def _label(role: str) -> str:
    """Meaning of a column, as text."""
    return "image" if role == "frame" else role.replace("_", " ")


@dataclass(frozen=True)
class Column:
    """A column of the table in the form."""

    name: str
    samples: tuple[str, ...]
    """First, middle and last value."""
    chosen: str
    """Meaning chosen by the user; empty if there is none."""
    guess: str
    """Label of the guessed meaning; empty if there is none, or another was chosen."""
    role: str
    """Meaning in use: a joint, time or frame; empty for all others."""


@dataclass(frozen=True)
class Guess:
    """Content of the files of a draft, and the problems of each part."""

    kind: str
    """Name of the source format."""
    recording: FoundRecording | None
    """The recording; None if it cannot be read."""
    problems: Mapping[tuple[Part, str], str] = field(default_factory=dict)
    """Part and its camera (empty for all) -> problem."""
    table: ForeignTable | None = None
    """Kinematics table, if its columns have names."""
    meanings: ColumnMeanings | None = None
    trials: tuple[Path, ...] = ()
    """Recordings in the folder, if there are several to choose from."""

    @property
    def columns(self) -> dict[str, str]:
        """Joint -> guessed column."""
        return {} if self.meanings is None else next(iter(self.meanings.arms.values()), {})

    @property
    def in_order(self) -> dict[str, str]:
        """Joint -> column, if the numeric columns may be the joints in order; empty for another number of columns."""
        if self.table is None or self.meanings is None or self.meanings.arms:
            return {}
        taken = (self.meanings.time, self.meanings.frame)
        numbers = [name for name, values in self.table.columns.items() if values.dtype.kind in "iuf"]
        free = [name for name in numbers if name not in taken]
        return dict(zip(MEANINGS, free, strict=False)) if len(free) in (len(JOINT_NAMES), len(JOINT_NAMES) + 1) else {}

    def described(self, options: ImportOptions) -> list["Column"]:
        """The columns of the table, those with a meaning first."""
        if self.table is None:
            return []
        chosen = {column: role for role, column in options.columns.items()}
        found: dict[str, str] = {}
        if self.meanings is not None:
            several = len(self.meanings.arms) > 1
            for arm, columns in self.meanings.arms.items():
                found |= {column: f"{arm} {role}" if several and arm else role for role, column in columns.items()}
            found |= {self.meanings.frame: "frame"} if self.meanings.frame else {}
            found |= {self.meanings.time: "time"} if self.meanings.time else {}
        rows = []
        for name, values in self.table.columns.items():
            origin = "by name" if self.meanings is not None and name in self.meanings.stated else "guessed"
            guess = "" if name in chosen or name not in found else f"{_label(found[name])} ({origin})"
            places = dict.fromkeys((0, len(values) // 2, len(values) - 1))
            role = chosen.get(name) or (found.get(name) if found.get(name) in MEANINGS else None) or ""
            rows.append(Column(name, tuple(sample(values[row]) for row in places), chosen.get(name, ""), guess, role))
        return sorted(rows, key=lambda row: not (row.chosen or row.guess))

    def notes(self, about: str, *kinds: NoteKind) -> list[Note]:
        """Notes of some kinds about a camera or arm, or about neither if `about` is empty."""
        notes = () if self.recording is None else self.recording.notes
        return [note for note in notes if note.kind in kinds and note.about == about]


def problem_of(error: CartsError) -> str:
    """Message of an error, without advice on command-line options, which do not exist in the page."""
    return error.problem if isinstance(error, PartError) else str(error)


def guess(draft: Draft) -> Guess:
    """Read the files of a draft; errors become problems of the result."""
    source = Path(draft.source)
    try:
        kind = detect(source, draft.options.source).name
    except CartsError as error:
        if not source.is_dir():
            return Guess("", None, {_WHOLE: problem_of(error)})
        # In a folder, the user can assign the files by hand.
        kind = FOLDER
    options = replace(draft.options, source=kind)
    problems = _problems_of_images(source, options) if kind == FOLDER else {}
    table, meanings = (None, None)
    try:
        recording = find(source, options)
    except CartsError as error:
        if not problems:
            place = (error.part, error.about) if isinstance(error, PartError) else _WHOLE
            problems[place] = problem_of(error)
        about_table = not any(part in ("calibration", "images") for part, _ in problems)
        recording = _images_only(source, options) if kind == FOLDER and about_table else None
    if kind == FOLDER:
        try:
            table = kinematics_table(source, options)
            meanings = None if table is None else guess_columns(table, options)
        except CartsError as error:
            problems.setdefault(("kinematics" if table is None else "columns", ""), problem_of(error))
    if table is not None and meanings is not None and not meanings.arms:
        problems["columns", ""] = (
            "The columns contain neither six recognizable joints nor a tip pose. Choose a column for each joint."
        )
    trials = jigsaws_trials(source) if kind == JIGSAWS.name and recording is None else ()
    if len(trials) > 1:
        problems = {_WHOLE: f"The folder contains {len(trials)} JIGSAWS trials. Choose a trial."}
    return Guess(kind, recording, problems, table, meanings, trials)


def _images_only(source: Path, options: ImportOptions) -> FoundRecording | None:
    """The recording without its kinematics table, if the images can be read."""
    plain = ImportOptions(source=options.source, images=options.images, kinematics=NO_TABLE)
    with suppress(CartsError):
        return find(source, plain)
    return None


def _problems_of_images(source: Path, options: ImportOptions) -> dict[tuple[Part, str], str]:
    """Problems of the images that the user has chosen, by camera."""
    found: dict[tuple[Part, str], str] = {}
    for camera, place in options.images.items():
        try:
            find_images(source / place)
        except CartsError as error:
            found["images", camera] = problem_of(error)
    return found


@dataclass(frozen=True)
class Delays:
    """Time offsets estimated from the motion in images and table."""

    found: tuple[TimeOffsetEstimate, ...]
    options: ImportOptions
    """Options of the import with which they were estimated."""
    shared: float
    """Time offset of all tables with which they were estimated [s]."""
    offsets: dict[str, float]
    """Proposed offsets as in `offsets_to_write`; empty to keep all."""

    def accepted(self) -> ImportOptions:
        """Options with the proposed offsets."""
        return with_delays(self.options, self.offsets) if self.offsets else self.options

    def chosen(self, arm: str, value: str) -> ImportOptions:
        """Options with one of the equally good offsets, of an arm or, if empty, of all tables; `SettingsError` for
        another value."""
        listed = [seconds for each in self.found for seconds in each.choices.get(arm, ()) if f"{seconds:.4f}" == value]
        if listed:
            seconds = round(listed[0], 4)
            chosen = {arm: round(seconds - self.shared, 4), "": self.shared} if arm else {"": seconds}
            return with_delays(self.options, {**self.options.arm_time_offset, **chosen})
        raise SettingsError(f"{value!r} is not one of the estimated offsets. Estimate them again.")


def delays_of(draft: Draft, guess: Guess, progress: Callable[[int, int], None] | None = None) -> Delays | None:
    """Estimate time offsets; None without a recording or times of rows, `CartsError` if an image cannot be read."""
    source = Path(draft.source)
    if guess.recording is None or "time_offset" not in detect(source, guess.kind).uses:
        return None

    def again(options: ImportOptions) -> FoundRecording:
        return find(source, replace(options, source=guess.kind))

    recording, options = with_times(guess.recording, draft.options, again)
    if not is_timed(recording):
        return None
    found, offsets = estimated_delays(recording, progress)
    return Delays(found, options, recording.time_offset, offsets)


class _CancelledError(Exception):
    pass


class DelayJob:
    """Estimation of time offsets on a separate thread.

    Attributes:
        share: share of the images that have been read, in [0, 1].
    """

    def __init__(
        self, draft: Draft, guess: Guess, advanced: Callable[[], None], ended: Callable[[Delays | str | None], None]
    ) -> None:
        """Start the estimation.

        Args:
            advanced: called on the thread when `share` has grown.
            ended: called on the thread with the result of `delays_of`, or the text of an error; not called after
                `cancel`.
        """
        self.share = 0.0
        self._draft, self._guess, self._advanced, self._ended = draft, guess, advanced, ended
        self._cancelled = threading.Event()
        threading.Thread(target=self._run, name="carts-delay", daemon=True).start()

    def cancel(self) -> None:
        """Stop without a result; the thread ends soon after."""
        self._cancelled.set()

    def _run(self) -> None:
        found: Delays | str | None
        try:
            found = delays_of(self._draft, self._guess, self._progress)
        except _CancelledError:
            return
        except Exception as error:
            found = problem_of(error) if isinstance(error, CartsError) else f"The estimation failed: {error!r}"
        if not self._cancelled.is_set():
            self._ended(found)

    def _progress(self, done: int, total: int) -> None:
        if self._cancelled.is_set():
            raise _CancelledError
        if done / total >= self.share + _SHARE_STEP or done == total:
            self.share = done / total
            self._advanced()


def check_form(
    draft: Draft,
    guess: Guess,
    pictures: dict[str, list[tuple[str, str]]],
    delay: Delays | None = None,
    estimating: DelayJob | None = None,
) -> str:
    """HTML of the form: contents of the files by part, problems, and controls."""
    return render(
        "check.html",
        draft=draft,
        guess=guess,
        pictures=pictures,
        delay=delay,
        estimating=estimating,
        trials={str(trial): trial.stem for trial in guess.trials},
        curves=curves,
        roles={role: _label(role) for role in MEANINGS},
        joints=(*JOINT_NAMES, "jaw"),
        angles=get_args(AngleUnit),
        lengths=get_args(LengthUnit),
        no_table=NO_TABLE,
        number=lambda value: "" if value is None else f"{value:g}",
        basename=lambda path: Path(path).name,
    )
