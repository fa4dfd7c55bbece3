"""What a choice in the form makes of a draft."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

from carts_core.errors import SettingsError
from carts_core.model.psm_kinematics import JOINT_NAMES
from carts_core.recording.importing.found import recording_name
from carts_core.settings.interchange import NO_TABLE, AngleUnit, LengthUnit
from carts_viewer.recording.draft import Draft, Step

_CHOICES = {
    "angle_unit": get_args(AngleUnit),
    "length_unit": get_args(LengthUnit),
    "clock": ("s", "ms", "us", "ns"),
}
_NUMBERS = ("time_offset", "frame_rate", "tool_point")
_MEANINGS = (*JOINT_NAMES, "jaw", "time", "frame")


def changed(draft: Draft, name: str, value: str, guessed: Mapping[str, str]) -> Draft | None:
    """The draft after a choice; None if the choice is none of the form's.

    Args:
        draft: before.
        name: of the choice, as in `form`.
        value: what was chosen; "" leaves it to the guess.
        guessed: joint -> column, as guessed.

    Raises:
        SettingsError: the value is not possible.
    """
    kind, _, which = name.partition(" ")
    options: dict[str, Any] = {}
    if name in _CHOICES:
        if value and value not in _CHOICES[name]:
            raise SettingsError(f"{name} is {value!r}; allowed is {', '.join(_CHOICES[name])}.")
        options[name] = value or None
    elif name in _NUMBERS:
        options[name] = _number(value)
    elif kind == "calibration_size" and which:
        others = {camera: size for camera, size in draft.options.calibration_size.items() if camera != which}
        given = value.replace(" ", "").replace("×", "x")
        options[kind] = {**others, which: given} if given else others
    elif kind == "flip" and which in JOINT_NAMES:
        without = tuple(joint for joint in draft.options.flip if joint != which)
        options[kind] = (*without, which) if value == "1" else without
    elif kind == "unit" and which in (*JOINT_NAMES, "jaw"):
        rest = {joint: unit for joint, unit in draft.options.units.items() if joint != which}
        options["units"] = {**rest, which: value} if value else rest
    elif name == "no-table":
        options |= {"kinematics": NO_TABLE, "columns": {}, "flip": (), "units": {}}
    elif kind == "column" and which in _MEANINGS:
        options["columns"] = _columns(draft, which, value, guessed)
    elif name == "remove-camera":
        options["images"] = {camera: place for camera, place in draft.options.images.items() if camera != value}
    return _new_import(draft.with_options(**options)) if options else None


def picked(draft: Draft, part: str, path: Path, found: Mapping[str, Path]) -> Draft:
    """The draft after a file or folder was picked for one of its parts.

    Args:
        draft: before.
        part: "source", "images", "images CAMERA", "calibration CAMERA", "kinematics" or "robot ARM".
        path: what was picked.
        found: camera -> where its images were found, which are kept when another camera is added.
    """
    kind, _, which = part.partition(" ")
    options = draft.options
    match kind:
        case "source":
            return replace(Draft(), source=str(path), name=recording_name(path), step=Step.CHECK)
        case "images":
            images = options.images or {name: str(place) for name, place in found.items()}
            return _new_import(draft.with_options(images={**images, which or _new_name(images, path): str(path)}))
        case "calibration":
            return _new_import(draft.with_options(calibration={**options.calibration, which: path}))
        case "kinematics":
            return _new_import(draft.with_options(kinematics=path, columns={}, flip=(), units={}))
        case "robot":
            return _new_import(draft.with_options(robot={**options.robot, which: str(path)}))
    return draft


def _new_import(draft: Draft) -> Draft:
    """What was calibrated before does not hold for other files; points in images stay."""
    return draft.uncalibrated()


def _columns(draft: Draft, which: str, value: str, guessed: Mapping[str, str]) -> dict[str, str]:
    """Chosen columns. The first choice of a joint keeps the others as they were guessed."""
    chosen = dict(draft.options.columns)
    joints = which in (*JOINT_NAMES, "jaw")
    if joints and not any(name in chosen for name in JOINT_NAMES):
        chosen = {**chosen, **{name: guessed[name] for name in (*JOINT_NAMES, "jaw") if name in guessed}}
    chosen.pop(which, None)
    return {**chosen, which: value} if value else chosen


def _number(value: str) -> float | None:
    if not value.strip():
        return None
    try:
        number = float(value.replace(",", "."))
    except ValueError as error:
        raise SettingsError(
            f"{value!r} is no number. Type one, such as 0.12, or nothing to have it guessed."
        ) from error
    if not math.isfinite(number):
        raise SettingsError(f"{value!r} is no finite number.")
    return number


def _new_name(images: Mapping[str, Any], path: Path) -> str:
    """A name for one more camera: that of its folder, or with a number."""
    name, number = path.stem, 2
    while name in images:
        name, number = f"{path.stem} {number}", number + 1
    return name
