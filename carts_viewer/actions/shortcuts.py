"""Keyboard shortcuts: the actions of keys, and the keys that a user has changed.

`python -m carts_viewer.actions.shortcuts docs/reference/keys.md` updates the table of keys between two marks in
`keys.md`.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Literal

import msgspec

from carts_core.errors import CartsError
from carts_core.files import write_text
from carts_core.project import ReviewState
from carts_viewer.actions import intents
from carts_viewer.picture.layers import Layer
from carts_viewer.picture.strokes import Tool

FINE, COARSE = 0.1, 1.0
"""Step sizes of `intents.Nudge` [deg or mm]."""
_GROWTH = 1.25
_END_OF_SEQUENCE = 1_000_000
_BEGIN, _END = "<!-- keys: written by python -m carts_viewer.actions.shortcuts -->", "<!-- end of keys -->"

Local = Literal["perturb", "view", "loupe", "peek", "sheet"]
"""Actions that are not intents: `perturb` depends on fields of the page, and the page's scripts handle the others."""


@dataclass(frozen=True)
class Shortcut:
    """A key and its action."""

    key: str
    """The default key, as `static/keys.js` names it: `N`, `Shift+N`, `Ctrl+Z`, `ArrowLeft`, `(`."""
    label: str
    action: intents.Intent | Local

    @property
    def name(self) -> str:
        """Identifier of the action, such as `MoveFrame 1`; of two keys for one action the second adds its key."""
        if isinstance(self.action, str):
            return self.action
        values = (value.value if isinstance(value, Enum) else value for value in msgspec.structs.astuple(self.action))
        name = " ".join([type(self.action).__name__, *map(str, values)])
        return f"{name} {self.key}" if self.key.startswith("Arrow") else name


@cache
def groups() -> dict[str, tuple[Shortcut, ...]]:
    """All shortcuts by group; they are the same in every recording.

    They do not use the letters with which viser moves the camera (W A S D Q E).
    """
    return {
        "Frames": (
            Shortcut("Space", "Play or stop", intents.Play()),
            Shortcut("N", "Next frame", intents.MoveFrame(1)),
            Shortcut("B", "Previous frame (back)", intents.MoveFrame(-1)),
            Shortcut("ArrowRight", "Next frame", intents.MoveFrame(1)),
            Shortcut("ArrowLeft", "Previous frame", intents.MoveFrame(-1)),
            Shortcut("Home", "First frame", intents.MoveFrame(-_END_OF_SEQUENCE)),
            Shortcut("End", "Last frame", intents.MoveFrame(_END_OF_SEQUENCE)),
            Shortcut("(", "Start the range at this frame", intents.MarkRange()),
            Shortcut(")", "End the range at this frame", intents.MarkRange(end=True)),
            Shortcut("L", "Next worst frame that is neither accepted nor rejected", intents.ShowWorst()),
            Shortcut("Shift+L", "Previous worst frame", intents.ShowWorst(-1)),
            Shortcut("Y", "Next unreviewed frame", intents.ShowUnreviewed()),
            Shortcut("Shift+Y", "Previous unreviewed frame", intents.ShowUnreviewed(-1)),
        ),
        "Optimize": (
            Shortcut("R", "Run or pause the optimizer", intents.RunOrPause()),
            Shortcut("T", "One step of the optimizer", intents.Step()),
            Shortcut("X", "Reset to the start of the run", intents.Reset()),
            Shortcut("K", "Mark or unmark the frame as a keyframe", intents.SetKeyframe()),
            Shortcut("Shift+K", "Solve between the keyframes", intents.Solve()),
            Shortcut("O", f"Nudge the joint by {FINE:g}° or {FINE:g} mm", intents.Nudge(FINE)),
            Shortcut("I", f"Nudge the joint by -{FINE:g}° or -{FINE:g} mm", intents.Nudge(-FINE)),
            Shortcut("Shift+O", f"Nudge the joint by {COARSE:g}° or {COARSE:g} mm", intents.Nudge(COARSE)),
            Shortcut("Shift+I", f"Nudge the joint by -{COARSE:g}° or -{COARSE:g} mm", intents.Nudge(-COARSE)),
            Shortcut("U", "Choose the next joint to nudge", intents.ChooseJoint()),
            Shortcut("C", "Copy the correction of the previous frame", intents.CopyCorrection(-1)),
            Shortcut("Shift+C", "Copy the correction of the next frame", intents.CopyCorrection(1)),
            Shortcut("P", "Perturb all joints", "perturb"),
            Shortcut("M", "Reset to the measured joint positions", intents.BackToMeasured()),
        ),
        "Review": (
            Shortcut("G", "Accept, and show the next unreviewed frame", intents.AcceptAndNext()),
            Shortcut("F", "Mark as needing work", intents.SetReview(ReviewState.NEEDS_WORK)),
            Shortcut("J", "Reject", intents.SetReview(ReviewState.REJECTED)),
            Shortcut("Shift+G", "Clear the review", intents.SetReview(ReviewState.UNTOUCHED)),
            Shortcut("Ctrl+Z", "Undo", intents.Undo()),
            Shortcut("Ctrl+Shift+Z", "Redo", intents.Redo()),
        ),
        "Tools": (
            Shortcut("Escape", "Close the open panel, or return to Select", intents.SetTool(Tool.SELECT)),
            Shortcut("Shift+H", "Drag link: on or off", intents.ToggleTool(Tool.DRAG)),
            Shortcut("Shift+N", "Keypoint: on or off", intents.ToggleTool(Tool.KEYPOINT)),
            Shortcut("H", "Show or hide the keypoints", intents.ShowKeypoints()),
            Shortcut("Shift+B", "Brush: on or off", intents.ToggleTool(Tool.BRUSH)),
            Shortcut("Shift+P", "Polygon: on or off", intents.ToggleTool(Tool.POLYGON)),
            Shortcut("Shift+X", "Eraser: on or off", intents.ToggleTool(Tool.ERASER)),
            Shortcut("Shift+T", "Prompt (click or box): on or off", intents.ToggleTool(Tool.PROMPT)),
            Shortcut("Enter", "Prompt: start the next object", intents.NextObject()),
            Shortcut("Shift+M", "Ignore region instead of the mask", intents.SetTarget()),
            Shortcut("[", "Smaller brush", intents.ScaleBrush(1 / _GROWTH)),
            Shortcut("]", "Larger brush", intents.ScaleBrush(_GROWTH)),
            Shortcut(",", "Loupe: pixels, coordinates, colour; hold, or press to toggle", "loupe"),
        ),
        "View": (
            Shortcut("V", "Endoscope view or 3D view", "view"),
            Shortcut("Shift+V", "All cameras side by side, or one", intents.ShowBeside()),
            *(
                Shortcut(str(number % 10), f"Overlay: {layer.lower()}", intents.ShowLayer(layer))
                for number, layer in enumerate(Layer, start=1)
            ),
            Shortcut(".", "Hold: show the measured pose, or the pose to compare with", "peek"),
            Shortcut("?", "Show all keys", "sheet"),
        ),
    }


_FIXED = (
    ("Ctrl+drag", "Drag a link of an arm; its joints follow"),
    ("Shift+click", "Place a keypoint of the arm; Shift+drag moves it"),
    ("Right-drag", "Pan, with any tool"),
    ("Ctrl+K", "Find any action by name"),
)
"""Keys that cannot be changed, and their descriptions."""
_TAKEN = {
    **dict.fromkeys("WASDQE", "moves the camera of the 3D view"),
    "Ctrl+K": "finds actions",
    **dict.fromkeys(("Tab", "Shift+Tab"), "moves the focus"),
    **dict.fromkeys(("F5", "Ctrl+R", "Ctrl+W", "Ctrl+T", "Ctrl+N", "Ctrl+L"), "belongs to the browser"),
}
"""Keys that no action can have, and their functions."""

Keys = Mapping[str, str]
"""Name of an action -> its key."""


@cache
def shortcuts() -> dict[str, Shortcut]:
    """All shortcuts by the names of their actions."""
    return {shortcut.name: shortcut for group in groups().values() for shortcut in group}


def keys_of(changed: Keys) -> dict[str, str]:
    """The key of every action."""
    return {name: changed.get(name, shortcut.key) for name, shortcut in shortcuts().items()}


def checked_keys(changed: Keys) -> dict[str, str]:
    """The changed keys, without those that equal the defaults.

    Raises:
        CartsError: an action is unknown, or a key is empty or has another function.
    """
    known, holders = shortcuts(), {}
    for name in changed:
        if name not in known:
            raise CartsError(f"{name[:64]!r} is not an action with a key. Choose an action of the list of keys.")
    for name, key in keys_of(changed).items():
        other = f"is the key of {holders[key]!r}" if key in holders else _TAKEN.get(key)
        if other is not None or not 0 < len(key) <= 24:
            raise CartsError(f"{key[:24] or 'No key'} {other or 'is not a key'}. Press another key.")
        holders[key] = known[name].label
    return {name: key for name, key in changed.items() if key != known[name].key}


def key_sheet() -> dict[str, object]:
    """Content of the list of keys in the page: groups of [name, key, label], and fixed and unavailable keys."""
    return {
        "groups": [
            (name, [(one.name, one.key, one.label) for one in shortcuts]) for name, shortcuts in groups().items()
        ],
        "fixed": _FIXED,
        "taken": _TAKEN,
    }


def key_table(changed: Keys | None = None) -> str:
    """The keys as a Markdown table."""
    keys = keys_of(changed or {})
    rows = [(keys[name], shortcut.label) for name, shortcut in shortcuts().items()]
    return "\n".join(["| Key | Action |", "|---|---|", *(f"| **{key}** | {text} |" for key, text in (*rows, *_FIXED))])


def with_keys(text: str) -> str:
    """Insert the table of keys between the two marks of a text.

    Raises:
        ValueError: the text has no such marks.
    """
    before, begin, rest = text.partition(_BEGIN)
    _, end, after = rest.partition(_END)
    if not (begin and end):
        raise ValueError(f"the text lacks the lines {_BEGIN!r} and {_END!r} around the table of keys.")
    return f"{before}{begin}\n{key_table()}\n{end}{after}"


if __name__ == "__main__":
    for name in sys.argv[1:]:
        write_text(Path(name), with_keys(Path(name).read_text(encoding="utf-8")))
