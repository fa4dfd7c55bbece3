"""What a draft's files hold, as far as they can be read, with each problem where it is."""

import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from carts_core.errors import CartsError
from carts_core.recording.importing.cameras import find_images
from carts_core.recording.importing.columns import ColumnMeanings, guess_columns
from carts_core.recording.importing.foreign_tables import ForeignTable
from carts_core.recording.importing.found import FoundRecording, Note
from carts_core.recording.importing.importer import detect, find
from carts_core.recording.sources.datasets import JIGSAWS, jigsaws_trials
from carts_core.recording.sources.folder import kinematics_table
from carts_core.settings.interchange import NO_TABLE, ImportOptions
from carts_viewer.recording.draft import Draft

FOLDER = "folder"


@dataclass(frozen=True)
class Guess:
    """What was found, or why not."""

    kind: str
    """Name of the source."""
    recording: FoundRecording | None
    """None while something is wrong."""
    problems: Mapping[str, str] = field(default_factory=dict)
    """"images NAME", "calibration NAME", "kinematics", "columns" or "recording" -> what is wrong there, for people."""
    table: ForeignTable | None = None
    """Of the kinematics, where they are a table of named columns."""
    meanings: ColumnMeanings | None = None
    trials: tuple[Path, ...] = ()
    """Recordings in the folder, of which one has to be chosen."""

    def notes(
        self, *, about: str | None = None, kinds: tuple[str, ...] = ("warning", "missing", "guessed")
    ) -> list[Note]:
        """Remarks about a camera or arm, or for None about none of them."""
        if self.recording is None:
            return []
        names = [each.name for each in (*self.recording.cameras, *self.recording.arms)]

        def of(note: Note) -> str | None:
            return next((name for name in names if note.text.startswith((f"{name}:", f"{name} "))), None)

        return [note for note in self.recording.notes if note.kind in kinds and of(note) == about]


def guess(draft: Draft) -> Guess:
    """Read what a draft names; never raises for what is wrong with the files."""
    source = Path(draft.source)
    try:
        kind = detect(source, draft.options.source).name
    except CartsError as error:
        if not source.is_dir():
            return Guess("", None, {"recording": str(error)})
        # Whatever is in a folder, a person may say what is what.
        kind = FOLDER
    options = replace(draft.options, source=kind)
    problems = _problems_of_parts(source, options) if kind == FOLDER else {}
    table, meanings = (None, None)
    try:
        recording = find(source, options)
    except CartsError as error:
        if not problems:
            problems[_place_of(str(error), options)] = str(error)
        about_table = not any(place.startswith(("calibration", "images")) for place in problems)
        recording = _images_alone(source, options) if kind == FOLDER and about_table else None
    if kind == FOLDER:
        try:
            table = kinematics_table(source, options)
            meanings = None if table is None else guess_columns(table, options)
        except CartsError as error:
            problems.setdefault("kinematics" if table is None else "columns", str(error))
    if table is not None and meanings is not None and not meanings.arms:
        problems["columns"] = (
            "Six joints are not recognized among the columns, nor a tip's pose. Choose a column for each joint."
        )
    trials = jigsaws_trials(source) if kind == JIGSAWS.name and recording is None else ()
    if len(trials) > 1:
        problems = {"recording": f"The folder has {len(trials)} trials of JIGSAWS. Choose one."}
    return Guess(kind, recording, problems, table, meanings, trials)


def _images_alone(source: Path, options: ImportOptions) -> FoundRecording | None:
    """The cameras, to be seen while something is wrong with the kinematics."""
    plain = ImportOptions(source=options.source, images=options.images, kinematics=NO_TABLE)
    with suppress(CartsError):
        return find(source, plain)
    return None


def _problems_of_parts(source: Path, options: ImportOptions) -> dict[str, str]:
    """What is wrong with each file that a person has named."""
    found: dict[str, str] = {}

    def attempt(place: str, work: Callable[[], object]) -> None:
        try:
            work()
        except CartsError as error:
            found[place] = str(error)

    for camera, place in options.images.items():
        attempt(f"images {camera}", lambda place=place: find_images(source / place))
    return found


def _place_of(message: str, options: ImportOptions) -> str:
    """Which part of the form an error is about, by the files that it names."""
    for camera, path in options.calibration.items():
        if str(path) in message:
            return f"calibration {camera}"
    if (camera := re.search(r"--calibration (.+?) FILE", message)) is not None:
        return f"calibration {camera[1]}"
    if options.kinematics is not None and options.kinematics.name in message:
        return "columns" if "column" in message else "kinematics"
    for word, place in (
        ("--images", "images"),
        ("camera_matrix", "calibration"),
        ("column", "columns"),
        ("-unit", "columns"),
        ("--clock", "columns"),
        ("--frame-rate", "columns"),
    ):
        if word in message:
            return place
    return "recording"


def joint_table(recording: FoundRecording) -> Mapping[str, np.ndarray]:
    """Arm -> joint positions that are known [rows, joints], as they were recorded."""
    return {arm.name: arm.values for arm in recording.arms if arm.values is not None}
