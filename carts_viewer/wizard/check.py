"""The Check step of New recording: content of the files, previews, problems, and corrections of guesses."""

import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import get_args

import numpy as np

from carts_core.errors import CartsError
from carts_core.model.psm_kinematics import JOINT_NAMES
from carts_core.recording import Sequence, TimeOffsetEstimate, estimate_time_offset
from carts_core.recording.importing.cameras import find_images
from carts_core.recording.importing.columns import ColumnMeanings, guess_columns, sample
from carts_core.recording.importing.foreign_tables import ForeignTable
from carts_core.recording.importing.found import FoundArm, FoundCamera, FoundRecording, Note
from carts_core.recording.importing.importer import detect, find
from carts_core.recording.importing.writing import write_sequence
from carts_core.recording.sources.datasets import JIGSAWS, jigsaws_trials
from carts_core.recording.sources.folder import kinematics_table
from carts_core.settings.interchange import NO_TABLE, AngleUnit, ImportOptions, LengthUnit
from carts_viewer.picture.layers import small_jpeg
from carts_viewer.transport.document import alert, button, check_box, choices, escaped, text_field
from carts_viewer.wizard.draft import Draft

COLORS = ("#2dd4a7", "#60a5fa", "#facc15", "#e879f9", "#fb923c", "#f87171", "#a3a3a3")
_WIDTH, _HEIGHT = 600, 150
_MOST_POINTS = 400
_PREVIEW_WIDTH = 360
_JPEG_QUALITY = 75


def joints_plot(arm: FoundArm) -> str:
    """All joints of an arm over time as SVG, each from its smallest to its largest value, with these in a legend."""
    if arm.values is None or not len(arm.values):
        return ""
    rows = np.unique(np.linspace(0, len(arm.values) - 1, min(len(arm.values), _MOST_POINTS)).astype(int))
    x = rows.astype(float) if arm.times is None else arm.times[rows]
    x = (x - x[0]) / max(float(x[-1] - x[0]), 1e-9) * (_WIDTH - 8) + 4
    lines, legend = [], []
    for column, (name, color) in enumerate(zip(arm.columns, COLORS, strict=False)):
        values = arm.values[rows, column]
        low, high = float(np.nanmin(arm.values[:, column])), float(np.nanmax(arm.values[:, column]))
        y = _HEIGHT - 6 - (values - low) / max(high - low, 1e-9) * (_HEIGHT - 12)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True) if np.isfinite(b))
        lines.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="1.6"/>')
        scale, unit = (1e3, "mm") if name == JOINT_NAMES[2] else (180 / np.pi, "°")
        legend.append(
            f'<span style="white-space: nowrap; margin-right: 12px"><span class="key" style="background: {color}">'
            f"</span>{escaped(name.replace('_', ' '))} {scale * low:.0f} to {scale * high:.0f} {unit}</span>"
        )
    picture = f'<svg class="plot" viewBox="0 0 {_WIDTH} {_HEIGHT}" preserveAspectRatio="none">{"".join(lines)}</svg>'
    return f"<figure style='margin: 0'>{picture}<figcaption>{''.join(legend)}</figcaption></figure>"


def opened(recording: FoundRecording) -> tuple[Sequence, TemporaryDirectory[str]]:
    """The recording as a sequence, with the folder that its tables are in meanwhile.

    Raises:
        CartsError: what was found does not make a sequence.
    """
    folder = TemporaryDirectory(prefix="carts-import-")
    try:
        return Sequence.open(write_sequence(recording, Path(folder.name) / "sequence")), folder
    except BaseException:
        folder.cleanup()
        raise


def previews(sequence: Sequence, camera: str) -> list[tuple[str, bytes]]:
    """First, middle and last image of a camera: name of the frame and JPEG file.

    Raises:
        CartsError: an image is missing or damaged.
    """
    found = []
    for index in dict.fromkeys((0, len(sequence) // 2, len(sequence) - 1)):
        frame = sequence.frame(index, cameras=[camera])
        found.append((frame.frame_id, small_jpeg(frame.images[camera], width=_PREVIEW_WIDTH, quality=_JPEG_QUALITY)))
    return found


FOLDER = "folder"


@dataclass(frozen=True)
class Guess:
    """Content of a draft's files, with the problems of each part."""

    kind: str
    """Name of the source."""
    recording: FoundRecording | None
    """None while something is wrong."""
    problems: Mapping[str, str] = field(default_factory=dict)
    """"images NAME", "calibration NAME", "kinematics", "columns" or "recording" -> problem of that part."""
    table: ForeignTable | None = None
    """Table of the kinematics, where its columns have names."""
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
    """Problems of the files that the user has chosen."""
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


def estimated_delay(recording: FoundRecording) -> TimeOffsetEstimate:
    """Time offset estimated from the motion in images and table.

    Raises:
        CartsError: what was found does not make a sequence whose rows have times.
    """
    sequence, folder = opened(recording)
    with folder:
        return estimate_time_offset(sequence)


def delay_note(found: TimeOffsetEstimate | None) -> str:
    """The button that asks, or what was found and, where it is another offset, the button that takes it."""
    if found is None:
        return f"<div class='bar'>{button('estimate-delay', 'Estimate from the motion', kind='quiet')}</div>"
    if found.proposed is None:
        kind = "" if found.problem else " good"
        return f'<div class="note{kind}">{escaped(found.sentence())}</div>'
    share, now = 100 * found.explained, max(100 * found.explained_now, 0.0)
    text = (
        f"The motion gives {found.seconds:.3f} s ± {found.deviation:.3f} s; now it is {found.present:.3f} s. "
        f"It explains {share:.0f} % of the motion in the images instead of {now:.0f} %."
    )
    take = button("accept-delay", f"Use {found.proposed:.3f} s", kind="main")
    return f'<div class="note guessed"><b>Proposed.</b> {escaped(text)}<div class="bar">{take}</div></div>'


_KINDS = {"found": "found", "guessed": "guessed", "missing": "missing", "warning": ""}
_WORDS = {"found": "Found", "guessed": "Guessed", "missing": "Missing", "warning": "Please check"}
_NONE = "none"
_AS_GUESSED = "as guessed"


def check_form(
    draft: Draft, guess: Guess, pictures: dict[str, list[tuple[str, str]]], delay: TimeOffsetEstimate | None = None
) -> str:
    """All that was found, part by part, with its problems and with what can be changed.

    Args:
        draft: choices of the user.
        guess: what follows from it.
        pictures: camera -> name and address of its previews.
        delay: between images and table, where it was estimated.
    """
    recording = guess.recording
    cameras = () if recording is None else recording.cameras
    head = _problem(guess, "recording") + _trials(guess) + _notes(guess, None)
    if guess.trials:
        return head
    left = "".join(_camera(draft, guess, camera, pictures.get(camera.name, [])) for camera in cameras)
    if not cameras:
        left = "".join(_named_images(draft, guess, camera) for camera in draft.options.images)
        wrong_lenses = [part.partition(" ")[2] for part in guess.problems if part.startswith("calibration ")]
        left += "".join(_wrong_lens(draft, guess, camera) for camera in wrong_lenses)
    wrong = _problem(guess, "images") + _problem(guess, "calibration")
    left = f"<section><h2>Cameras</h2>{wrong}{left}{_add_camera(guess)}</section>"
    return f'{head}<div class="columns">{left}{_kinematics(draft, guess, delay)}</div>'


def _trials(guess: Guess) -> str:
    """A list of the recordings in the folder."""
    if len(guess.trials) < 2:
        return ""
    options = {"": "Trial …", **{str(trial): trial.stem for trial in guess.trials}}
    return f"<div class='bar'>{choices('trial', options, '', label='Trial')}</div>"


def _camera(draft: Draft, guess: Guess, camera: FoundCamera, pictures: list[tuple[str, str]]) -> str:
    name = camera.name
    images = "".join(
        f'<figure><img src="{address}" alt="Frame {escaped(frame)} of {escaped(name)}">'
        f"<figcaption>{escaped(frame)}</figcaption></figure>"
        for frame, address in pictures
    )
    file = draft.options.calibration.get(name)
    lens = _lens(camera) if camera.intrinsics is not None else "a stand-in; the focal length can be solved for later"
    change = _change(f"images {name}", "Other images …", guess) + _change(
        f"calibration {name}", "Calibration file …", guess
    )
    return (
        f"<h3>{escaped(name)}</h3><div class='previews'>{images}</div>"
        f"<p class='quiet-text'><code>{escaped(camera.images)}</code> · {camera.size[0]} × {camera.size[1]}<br>"
        f"Lens: {escaped(lens)}{'' if file is None else f' ({escaped(file.name)})'}</p>"
        f"<div class='bar'>{change}{_remove(draft, name)}</div>"
        f"{_lens_size(draft, name) if name in draft.options.calibration_size else ''}"
        f"{_problem(guess, f'images {name}')}{_problem(guess, f'calibration {name}')}{_notes(guess, name)}"
    )


def _lens(camera: FoundCamera) -> str:
    assert camera.intrinsics is not None
    fx, fy, cx, cy = camera.intrinsics
    distorted = "with distortion" if any(camera.distortion) else "without distortion"
    return f"focal length {fx:.0f}, {fy:.0f} px, centre {cx:.0f}, {cy:.0f} px, {distorted}"


def _named_images(draft: Draft, guess: Guess, camera: str) -> str:
    """A camera whose images cannot be used yet."""
    place = draft.options.images[camera]
    return (
        f"<h3>{escaped(camera)}</h3><p class='quiet-text'><code>{escaped(place)}</code></p>"
        f"<div class='bar'>{_change(f'images {camera}', 'Other images …', guess)}{_remove(draft, camera)}</div>"
        f"{_problem(guess, f'images {camera}')}"
    )


def _wrong_lens(draft: Draft, guess: Guess, camera: str) -> str:
    """A camera whose calibration cannot be used: another file, or the size of the images that it is for."""
    part = f"calibration {camera}"
    change = f"<div class='bar'>{_change(part, 'Calibration file …', guess)}</div>"
    return f"<h3>{escaped(camera)}</h3>{_problem(guess, part)}{change}{_lens_size(draft, camera)}"


def _lens_size(draft: Draft, camera: str) -> str:
    size = draft.options.calibration_size.get(camera, "")
    field = text_field(f"calibration_size {camera}", size, hint="640x480")
    return f"<div class='bar'>Size of the calibrated images, width x height [px] {field}</div>"


def _remove(draft: Draft, camera: str) -> str:
    return button("remove-camera", "Remove", camera, kind="quiet") if camera in draft.options.images else ""


def _add_camera(guess: Guess) -> str:
    return f"<div class='bar'>{_change('images', 'Add a camera …', guess)}</div>" if guess.kind == FOLDER else ""


def _change(part: str, label: str, guess: Guess) -> str:
    """A button that opens the file browser for a part; only folders are put together by hand."""
    possible = guess.kind == FOLDER or part.startswith("calibration")
    return button("change", label, part, kind="quiet") if possible else ""


def _kinematics(draft: Draft, guess: Guess, delay: TimeOffsetEstimate | None) -> str:
    arms = () if guess.recording is None else guess.recording.arms
    table = "" if guess.table is None else f"<code>{escaped(guess.table.path)}</code>, {len(guess.table)} rows"
    change = _change("kinematics", "Other table …", guess) + _no_table(draft, guess)
    parts = [
        "<section><h2>Arms and joints</h2>",
        f"<p class='quiet-text'>{table}</p><div class='bar'>{change}</div>",
        _problem(guess, "kinematics"),
        *(_arm(draft, guess, arm) for arm in arms),
        _problem(guess, "columns"),
        _columns(draft, guess),
        _times(draft, guess, delay),
        "</section>",
    ]
    return "".join(parts)


def _no_table(draft: Draft, guess: Guess) -> str:
    """A button that leaves the kinematics out."""
    if guess.kind != FOLDER or draft.options.kinematics == NO_TABLE:
        return ""
    return button("no-table", "No table", kind="quiet")


def _arm(draft: Draft, guess: Guess, arm: FoundArm) -> str:
    robot = draft.options.robot.get(arm.name, "builtin:psm_lnd")
    change = button("change", "Other instrument …", f"robot {arm.name}", kind="quiet")
    label = "Large Needle Driver on a classic PSM" if robot.startswith("builtin:") else Path(robot).name
    return (
        f"<h3>{escaped(arm.name)}</h3>{joints_plot(arm)}"
        f"<p class='quiet-text'>Instrument: {escaped(label)} {change}"
        f"</p>{_notes(guess, arm.name)}"
    )


def _columns(draft: Draft, guess: Guess) -> str:
    """Which column is which joint, with units and signs."""
    if guess.table is None:
        return ""
    chosen = draft.options.columns
    samples = {column: f"{column} ({sample(values[0])})" for column, values in guess.table.columns.items()}
    guessed: dict[str, str] = {}
    if guess.meanings is not None:
        guessed = next(iter(guess.meanings.arms.values()), {})
    columns = {"": _AS_GUESSED, **samples}
    rows = []
    for joint in (*JOINT_NAMES, "jaw"):
        now = guessed.get(joint, "")
        options = {**columns, "": _unchosen(guess, "" if joint in chosen else now)}
        flip = check_box(f"flip {joint}", joint in draft.options.flip, "other sign") if joint != "jaw" else ""
        known = get_args(LengthUnit if joint == "insertion" else AngleUnit)
        units = {"": "unit of the rest", **{unit: unit for unit in known}}
        flip += choices(f"unit {joint}", units, draft.options.units.get(joint, ""))
        field = choices(f"column {joint}", options, chosen.get(joint, ""), label=joint.replace("_", " "))
        rows.append(f"<tr><td>{escaped(joint.replace('_', ' '))}</td><td>{field}</td><td>{flip}</td></tr>")
    for role, text in (("time", "time"), ("frame", "image")):
        now = "" if guess.meanings is None else getattr(guess.meanings, role) or ""
        options = {**columns, "": _unchosen(guess, "" if role in chosen else now)}
        field = choices(f"column {role}", options, chosen.get(role, ""), label=text)
        rows.append(f"<tr><td>{text}</td><td>{field}</td><td></td></tr>")
    wrong = "columns" in guess.problems
    opened = " open" if wrong or chosen or draft.options.flip or draft.options.units else ""
    body = f"<table><tr><th>meaning</th><th>column</th><th></th></tr>{''.join(rows)}</table>{_units(draft)}"
    return f"<details{opened}><summary>Columns, units and signs</summary>{body}</details>"


def _unchosen(guess: Guess, column: str) -> str:
    """The label of a column that was not chosen."""
    if not column:
        return _NONE
    assert guess.meanings is not None
    return f"{column} ({'by name' if column in guess.meanings.stated else 'guessed'})"


def _units(draft: Draft) -> str:
    options = draft.options
    angles = {"": _AS_GUESSED, "rad": "rad", "deg": "degrees", "percent": "-100 to 100 of the range"}
    lengths = {"": _AS_GUESSED, **{unit: unit for unit in get_args(LengthUnit)}}
    return (
        "<div class='bar'>Angles "
        + choices("angle_unit", angles, options.angle_unit or "")
        + " lengths "
        + choices("length_unit", lengths, options.length_unit or "")
        + " poses are beyond the tip by [m] "
        + text_field("tool_point", "" if options.tool_point is None else f"{options.tool_point:g}", hint="as guessed")
        + "</div>"
    )


def _times(draft: Draft, guess: Guess, delay: TimeOffsetEstimate | None) -> str:
    """The clock of the table, the time between its rows and the images, and a rate for images without times."""
    options = draft.options
    by_row = guess.recording is not None and guess.recording.frame_times is None
    rate = "" if options.frame_rate is None else f"{options.frame_rate:g}"
    rates = (
        "<div class='bar'>Images per second, if they have no times "
        + text_field("frame_rate", rate, hint="from the images")
        + "</div>"
    )
    if by_row and options.time_offset is None:
        return f"<p class='quiet-text'>Each row belongs to one image.</p>{rates}"
    clocks = {"": _AS_GUESSED, "s": "s", "ms": "ms", "us": "µs", "ns": "ns"}
    offset = "" if options.time_offset is None else f"{options.time_offset:g}"
    return (
        "<div class='bar'>Clock of the table " + choices("clock", clocks, options.clock or "") + "</div>"
        "<div class='bar'>Time in the table minus time of the image [s] "
        + text_field("time_offset", offset, hint="as guessed")
        + "</div>"
        + (delay_note(delay) if guess.recording is not None and not by_row else "")
        + rates
    )


def _problem(guess: Guess, part: str) -> str:
    text = guess.problems.get(part)
    return "" if text is None else alert(_for_page(text))


def _notes(guess: Guess, about: str | None) -> str:
    """Remarks, those that need a look first; guesses behind a heading that opens."""
    urgent = "".join(
        f'<div class="note {_KINDS[note.kind]}"><b>{_WORDS[note.kind]}.</b> {escaped(_for_page(note.text))}</div>'
        for note in guess.notes(about=about, kinds=("warning", "missing"))
    )
    quiet = guess.notes(about=about, kinds=("guessed",))
    if not quiet:
        return urgent
    lines = "".join(f'<div class="note guessed">{escaped(_for_page(note.text))}</div>' for note in quiet)
    return f"{urgent}<details><summary>{len(quiet)} guessed</summary>{lines}</details>"


def _for_page(text: str) -> str:
    """A remark without the options of the command line, which are of no use here."""
    before, found, _ = text.partition(" (change: --")
    text = before + "." if found else text
    sentences = re.split(r"(?<=[.:;]) ", text)
    return " ".join(sentence for sentence in sentences if " --" not in f" {sentence}") or text
