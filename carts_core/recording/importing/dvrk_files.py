"""Files of the dVRK that say where an arm's base is: registrations, configurations and set-up joints (SUJ).

    PSM1-registration-open-cv.json   {"base-frame": {"reference-frame", "transform"}}, camera with OpenCV's axes
    PSM1-registration-dVRK.json      the same, camera with the dVRK's axes
    system-*.json, console-*.json    {"arms": [{"name", "base_frame": {"reference_frame", "transform"}}]}, dVRK's axes
    suj-fixed.json                   {"arms": [{"name", "measured_cp"}]}, dVRK's axes

Keys with hyphens (until dVRK 2.3) and with underscores (since 2.4) are read in all of them.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ...errors import SequenceError, SettingsError
from ...files.reading import VALUES, parse_json, read_text
from ...model.camera import T_DVRK_OPENCV, rigid_transform
from ...settings.importing import Axes

_KINDS = (
    'a registration ({"base-frame": {"transform"}}), a configuration ({"arms": [{"name", "base_frame"}]}) or fixed '
    'set-up joints ({"arms": [{"name", "measured_cp"}]})'
)


@dataclass(frozen=True, eq=False)
class DvrkBaseFrame:
    """Where one arm's base is."""

    arm: str
    """Name of the arm; empty where neither the file nor its name says it."""
    reference: str
    """Name of the frame that the transform is given in; empty where the file has none."""
    T_camera_base: Float[np.ndarray, "4 4"]
    """[m], with OpenCV's axes of the camera: `T_world_base` where the world is the camera."""


def read_base_frames(path: Path, axes: Axes | None = None) -> tuple[DvrkBaseFrame, ...]:
    """The base frames that a file of the dVRK holds.

    Args:
        path: a JSON file of one of the kinds above.
        axes: of the camera in the file; None takes them from the kind of file and the names it is given by the dVRK.

    Raises:
        SequenceError: it is missing, of another kind, or does not say which axes it has.
    """
    try:
        content = parse_json(read_text(path, VALUES))
    except FileNotFoundError as error:
        raise SequenceError(f"dVRK file {path} is missing. Correct the path.") from error
    except (OSError, ValueError) as error:
        raise SequenceError(f"dVRK file {path} is not readable JSON: {error}. Copy it again.") from error
    found = _entries(content, path)
    if not found:
        raise SequenceError(f"{path} has no base frame. Expected is {_KINDS}.")
    axes = axes or _axes_of(content, path)
    T = T_DVRK_OPENCV if axes == "dvrk" else np.eye(4)
    return tuple(
        DvrkBaseFrame(arm, reference, T @ _transform(value, f"{path}: {where}"))
        for arm, reference, value, where in found
    )


def _entries(content: Any, path: Path) -> list[tuple[str, str, Any, str]]:
    """Arm, reference, transform and place of every base frame."""
    if not isinstance(content, dict):
        return []
    if (frame := _either(content, "base_frame")) is not None:
        return [(_arm_in_name(path), *_base_frame(frame))]
    arms = content.get("arms")
    entries = []
    for entry in arms if isinstance(arms, list) else []:
        if not isinstance(entry, dict) or not isinstance(name := entry.get("name"), str):
            continue
        if (frame := _either(entry, "base_frame")) is not None:
            entries.append((name, *_base_frame(frame, f"arm {name!r}: ")))
        elif "measured_cp" in entry:
            entries.append((name, "", entry["measured_cp"], f"arm {name!r}: measured_cp"))
    return entries


def _base_frame(frame: Any, where: str = "") -> tuple[str, Any, str]:
    if not isinstance(frame, dict):
        return "", frame, f"{where}base_frame"
    reference = _either(frame, "reference_frame")
    return reference if isinstance(reference, str) else "", frame.get("transform"), f"{where}base_frame: transform"


def _either(table: dict[str, Any], key: str) -> Any:
    return table.get(key, table.get(key.replace("_", "-")))


def _transform(value: Any, what: str) -> np.ndarray:
    try:
        return rigid_transform(value, what)
    except SettingsError as error:
        raise SequenceError(str(error)) from error


def _axes_of(content: dict[str, Any], path: Path) -> Axes:
    if "arms" in content:
        return "dvrk"
    name = path.name.lower()
    if "open-cv" in name or "opencv" in name:
        return "opencv"
    if "dvrk" in name:
        return "dvrk"
    raise SequenceError(
        f"{path}: neither its content nor its name says which axes the camera has (names end in -open-cv.json or "
        "-dVRK.json). Say opencv (x right, y down) or dvrk (x left, y up)."
    )


def _arm_in_name(path: Path) -> str:
    match = re.match(r"(?:.*[^A-Za-z])?((?:PSM|ECM|MTM)[0-9RL]?)(?![A-Za-z0-9])", path.name)
    return match.group(1) if match else ""
