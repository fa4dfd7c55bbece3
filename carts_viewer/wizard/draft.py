"""Drafts of New recording: choices of the user, saved after each change."""

import json
import math
import secrets
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, get_args

from carts_core.errors import CartsError, SettingsError
from carts_core.files import remove_file, write_text
from carts_core.files.reading import SETTINGS, VALUES, check_path, is_regular, parse_json, read_text, typed
from carts_core.model.psm_kinematics import JOINT_NAMES
from carts_core.optimization.hand_eye import ImagePoint
from carts_core.project.identity import data_dir
from carts_core.recording.importing.found import recording_name
from carts_core.settings.interchange import NO_TABLE, AngleUnit, ImportOptions, LengthUnit
from carts_viewer.wizard.calibration import CalibrationReport

_FORMAT = "carts-draft/1"
_MAX_NAME = 200
"""Maximum length of a sequence's name [characters]."""


class Step(StrEnum):
    """Step of New recording."""

    FILES = "Files"
    CHECK = "Check"
    HAND_EYE = "Hand-eye"
    SAVE = "Save"


@dataclass(frozen=True)
class ClickedPoint(ImagePoint):
    """A clicked point; its frame is identified by the id, since indices change with the options of the import."""

    frame_id: str = ""
    """Id of the frame; empty in drafts of earlier versions, whose index is used."""


@dataclass(frozen=True)
class Draft:
    """Choices of the user in New recording; immutable."""

    step: Step = Step.FILES
    source: str = ""
    """Folder or file of the recording; empty until it is chosen."""
    name: str = ""
    """Name of the sequence; by default that of the source."""
    options: ImportOptions = field(default_factory=ImportOptions)
    points: tuple[ClickedPoint, ...] = ()
    """Clicked points, in order."""
    focal_length: bool = False
    """Whether the focal length is also estimated."""
    calibration: Mapping[str, Any] | None = None
    """Refined calibration (`as_plain`); None if there is none."""
    offered: Mapping[str, Any] | None = None
    """A calibration that contradicts the clicked points, until it is kept or discarded."""
    report: CalibrationReport | None = None
    """Report of `calibration` or `offered`."""

    def to_json(self) -> str:
        """The draft in JSON format."""
        plain = asdict(self)
        plain["options"] = {
            name: _plain(value) for name, value in plain["options"].items() if value not in (None, {}, ())
        }
        return json.dumps({"format": _FORMAT, **plain}, indent=1)

    @staticmethod
    def from_json(text: str) -> "Draft":
        """Parse a draft in JSON format; `SettingsError` if the text is not a draft."""
        try:
            plain = parse_json(text)
            if plain.pop("format") != _FORMAT:
                raise ValueError("it was saved by another version")
            draft = typed(plain, Draft)
            for named in _texts([plain["source"], plain["options"]]):
                check_path(named)
            return draft
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise SettingsError(
                f"this import cannot be continued ({error}). Delete it and start a new import."
            ) from error

    def uncalibrated(self, **changes: Any) -> "Draft":
        """The draft with changed fields and without its calibration, which the changes invalidate."""
        return replace(self, **{"calibration": None, "offered": None, "report": None, **changes})

    def with_options(self, **changes: Any) -> "Draft":
        """The draft with changed options and without its calibration; points of cameras with other images or another
        calibration are removed."""
        options = replace(self.options, **changes)

        def unchanged(camera: str) -> bool:
            return all(
                getattr(options, part).get(camera) == getattr(self.options, part).get(camera) for part in _CAMERA_PARTS
            )

        points = tuple(point for point in self.points if unchanged(point.camera))
        return self.uncalibrated(options=options, points=points)


@dataclass(frozen=True)
class DraftSummary:
    """List entry of a draft."""

    key: str
    name: str
    source: str
    """Folder or file that is imported."""
    changed: float
    """Time of the last change [s since 1970]."""


class DraftFile:
    """The file of one draft."""

    def __init__(self, key: str | None = None) -> None:
        """File of an existing draft, or of a new one if `key` is None; `SettingsError` if the draft does not exist."""
        if key is not None and key not in {draft.key for draft in drafts()}:
            raise SettingsError("this import no longer exists. Start a new import.")
        self.key = key or secrets.token_hex(8)

    def read(self) -> Draft:
        """The draft, empty if none was saved; `SettingsError` if it is damaged."""
        path = _path(self.key)
        if not is_regular(path):
            return Draft()
        try:
            text = read_text(path, VALUES)
        except (OSError, ValueError) as error:
            raise SettingsError(f"{path} cannot be read ({error}). Delete this import and start another.") from error
        return Draft.from_json(text)

    def write(self, draft: Draft) -> None:
        """Save a draft, unless it has no source."""
        if draft.source:
            write_text(_path(self.key), draft.to_json())

    def delete(self) -> None:
        """Delete the draft."""
        delete_draft(self.key)


def drafts() -> list[DraftSummary]:
    """All drafts, the newest first."""
    found = []
    for path in _folder().glob("*.json"):
        try:
            plain = parse_json(read_text(path, SETTINGS))
            source = str(plain.get("source", ""))
            name = str(plain.get("name") or Path(source).name)[:_MAX_NAME]
            found.append(DraftSummary(path.stem, name, source, path.stat().st_mtime))
        except (CartsError, OSError, ValueError, AttributeError):
            found.append(DraftSummary(path.stem, "damaged import", "", time.time()))
    return sorted(found, key=lambda draft: -draft.changed)


def delete_draft(key: str) -> None:
    """Delete a draft, if it exists."""
    if key in {draft.key for draft in drafts()}:
        remove_file(_path(key))


def _texts(value: Any) -> Iterator[str]:
    """All strings in a JSON value."""
    if isinstance(value, str):
        yield value
    for part in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _texts(part)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    return str(value) if isinstance(value, Path) else value


def _folder() -> Path:
    return data_dir() / "drafts"


def _path(key: str) -> Path:
    return _folder() / f"{key}.json"


_CHOICES = {
    "angle_unit": get_args(AngleUnit),
    "length_unit": get_args(LengthUnit),
    "clock": ("s", "ms", "us", "ns"),
}
_OF_TABLES = (
    *("columns", "flip", "units", "angle_unit", "length_unit", "clock"),
    *("time_offset", "arm_time_offset", "row_rate", "frame_rate"),
)
"""Options that only a table of kinematics has."""
_CAMERA_PARTS = ("images", "calibration", "calibration_size")
"""Options of each camera, which determine its undistorted images."""
_NUMBERS = ("time_offset", "frame_rate", "row_rate", "tool_point")
MEANINGS = (*JOINT_NAMES, "jaw", "time", "frame")
"""Meanings that a column of a table can be given."""


def changed(draft: Draft, name: str, value: str, guessed: Mapping[str, str]) -> Draft | None:
    """The draft after a choice in the form; None for an unknown choice, `SettingsError` for an invalid value.

    Args:
        value: the chosen value; empty to restore the guess.
        guessed: joint -> guessed column.
    """
    kind, _, which = name.partition(" ")
    options: dict[str, Any] = {}
    if name in _CHOICES:
        if value and value not in _CHOICES[name]:
            raise SettingsError(f"{name} is {value!r}; allowed: {', '.join(_CHOICES[name])}.")
        options[name] = value or None
    elif name in _NUMBERS:
        options[name] = _number(value)
    elif kind == "arm_time_offset" and which:
        own = {arm: seconds for arm, seconds in draft.options.arm_time_offset.items() if arm != which}
        seconds = _number(value)
        options[kind] = own if seconds is None else {**own, which: seconds}
    elif kind == "calibration_size" and which:
        options[kind] = _with(draft.options.calibration_size, which, value.replace(" ", "").replace("×", "x"))
    elif kind == "flip" and which in JOINT_NAMES:
        without = tuple(joint for joint in draft.options.flip if joint != which)
        options[kind] = (*without, which) if value == "1" else without
    elif kind == "unit" and which in (*JOINT_NAMES, "jaw"):
        options["units"] = _with(draft.options.units, which, value)
    elif name == "no-table":
        defaults = ImportOptions()
        options |= {name: getattr(defaults, name) for name in _OF_TABLES} | {"kinematics": NO_TABLE}
    elif kind == "meaning" and (not value or value in MEANINGS):
        chosen = {role: column for role, column in draft.options.columns.items() if column != which}
        options["columns"] = _columns(draft.with_options(columns=chosen), value, which, guessed) if value else chosen
    elif name == "remove-camera":
        options |= {part: _with(getattr(draft.options, part), value, "") for part in _CAMERA_PARTS}
    return draft.with_options(**options) if options else None


def picked(draft: Draft, part: str, path: Path, found: Mapping[str, Path]) -> Draft:
    """The draft after a file or folder was picked for one of its parts.

    Args:
        part: "source", "images", "images CAMERA", "calibration CAMERA", "kinematics" or "robot ARM".
        found: camera -> its images, which are kept when another camera is added.
    """
    kind, _, which = part.partition(" ")
    options = draft.options
    match kind:
        case "source":
            return replace(Draft(), source=str(path), name=recording_name(path), step=Step.CHECK)
        case "images":
            images = options.images or {name: str(place) for name, place in found.items()}
            named = replace(draft, options=replace(options, images=images))
            return named.with_options(images={**images, which or _new_name(images, path): str(path)})
        case "calibration":
            return draft.with_options(calibration={**options.calibration, which: path})
        case "kinematics":
            return draft.with_options(kinematics=path, columns={}, flip=(), units={})
        case "robot":
            return draft.with_options(robot={**options.robot, which: str(path)})
    return draft


def _columns(draft: Draft, which: str, value: str, guessed: Mapping[str, str]) -> dict[str, str]:
    """Chosen columns; the first choice of a joint also stores the guessed columns of the other joints."""
    chosen = dict(draft.options.columns)
    joints = which in (*JOINT_NAMES, "jaw")
    if joints and not any(name in chosen for name in JOINT_NAMES):
        chosen = {**chosen, **{name: guessed[name] for name in (*JOINT_NAMES, "jaw") if name in guessed}}
    return _with(chosen, which, value)


def _with(entries: Mapping[str, str], key: str, value: str) -> dict[str, str]:
    """Entries with one value replaced, or removed if the new value is empty."""
    others = {name: entry for name, entry in entries.items() if name != key}
    return {**others, key: value} if value else others


def _number(value: str) -> float | None:
    if not value.strip():
        return None
    try:
        number = float(value.replace(",", "."))
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise SettingsError(f"{value!r} is not a number. Enter a number, such as 0.12, or leave the field empty.")
    return number


def _new_name(images: Mapping[str, Any], path: Path) -> str:
    """Name of a new camera: the name of its folder, with a number if needed."""
    name, number = path.stem, 2
    while name in images:
        name, number = f"{path.stem} {number}", number + 1
    return name
