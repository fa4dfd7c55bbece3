"""The form in which a person sees and corrects what was guessed about a recording."""

import re
from pathlib import Path
from typing import get_args

from carts_core.model.psm_kinematics import JOINT_NAMES
from carts_core.recording import TimeOffsetEstimate
from carts_core.recording.importing.columns import sample
from carts_core.recording.importing.found import FoundArm, FoundCamera
from carts_core.settings.interchange import NO_TABLE, AngleUnit, LengthUnit
from carts_viewer.recording.delay import delay_note
from carts_viewer.recording.draft import Draft
from carts_viewer.recording.guess import FOLDER, Guess
from carts_viewer.recording.plots import joints_plot
from carts_viewer.transport.document import button, check_box, choices, escaped, text_field

_KINDS = {"found": "found", "guessed": "guessed", "missing": "missing", "warning": ""}
_WORDS = {"found": "Found", "guessed": "Guessed", "missing": "Missing", "warning": "Please check"}
_NONE = "none"
_AS_GUESSED = "as guessed"


def check_form(
    draft: Draft, guess: Guess, pictures: dict[str, list[tuple[str, str]]], delay: TimeOffsetEstimate | None = None
) -> str:
    """All that was found, part by part, with its problems and with what can be changed.

    Args:
        draft: what a person has said.
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
    return "" if text is None else f'<div class="problem" role="alert">{escaped(_for_page(text))}</div>'


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
