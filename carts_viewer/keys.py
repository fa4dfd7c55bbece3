"""Every key, in one table: the page's shortcuts and palette, its help and the page of keys are made from it.

    python -m carts_viewer.keys docs/reference/keys.md

brings the table in a text file up to date, between the lines that say where it begins and ends.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from carts_core.files import write_text
from carts_core.project import ReviewState
from carts_viewer import intents
from carts_viewer.layers import Layer
from carts_viewer.strokes import Tool

FINE, COARSE = 0.1, 1.0
"""Steps of nudging [deg or mm]."""
_GROWTH = 1.25
_BEGIN, _END = "<!-- keys: written by python -m carts_viewer.keys -->", "<!-- end of keys -->"

Special = Literal["perturb", "view"]
"""What is more than an intent: `perturb` depends on fields of the page, `view` happens in the tab alone."""


@dataclass(frozen=True)
class Shortcut:
    """A key and what it does."""

    hotkey: str
    label: str
    action: intents.Intent | Special
    modifier: str | None = None

    @property
    def key(self) -> str:
        """As people read it."""
        held = {None: "", "cmd/ctrl": "Ctrl+", "shift": "Shift+", "cmd/ctrl+shift": "Ctrl+Shift+"}[self.modifier]
        return held + self.hotkey.capitalize()


def shortcuts() -> list[Shortcut]:
    """All of them, the same in every recording.

    Letters that viser uses to fly the camera (W A S D Q E) are left alone, and so are the arrow keys, which move a
    slider that has the focus.
    """
    return [
        Shortcut("space", "Play or stop", intents.Play()),
        Shortcut("N", "Next frame", intents.MoveFrame(1)),
        Shortcut("B", "Previous frame (back)", intents.MoveFrame(-1)),
        Shortcut("(", "Begin the range at this frame", intents.MarkRange()),
        Shortcut(")", "End the range at this frame", intents.MarkRange(end=True)),
        Shortcut("R", "Run or pause the optimizer", intents.RunOrPause()),
        Shortcut("T", "One step of the optimizer", intents.Step()),
        Shortcut("X", "Reset to the start of the run", intents.Reset()),
        Shortcut("K", "Make the frame a keyframe, or none", intents.HoldKeyframe()),
        Shortcut("K", "Solve between the keyframes", intents.Solve(), "shift"),
        Shortcut("G", "Accept, and go to the next unreviewed frame", intents.AcceptAndNext()),
        Shortcut("F", "Mark as needing work", intents.SetReview(ReviewState.NEEDS_WORK)),
        Shortcut("J", "Reject", intents.SetReview(ReviewState.REJECTED)),
        Shortcut("G", "Clear the review", intents.SetReview(ReviewState.UNTOUCHED), "shift"),
        Shortcut("Y", "Next unreviewed frame", intents.ShowUnreviewed()),
        Shortcut("Y", "Previous unreviewed frame", intents.ShowUnreviewed(-1), "shift"),
        Shortcut("L", "Next worst frame that is neither accepted nor rejected", intents.ShowWorse()),
        Shortcut("L", "Previous worst frame", intents.ShowWorse(-1), "shift"),
        Shortcut("O", f"Nudge the joint by {FINE:g}° or mm", intents.Nudge(FINE)),
        Shortcut("I", f"Nudge the joint by -{FINE:g}° or mm", intents.Nudge(-FINE)),
        Shortcut("O", f"Nudge the joint by {COARSE:g}° or mm", intents.Nudge(COARSE), "shift"),
        Shortcut("I", f"Nudge the joint by -{COARSE:g}° or mm", intents.Nudge(-COARSE), "shift"),
        Shortcut("U", "Choose the next joint to nudge", intents.ChooseJoint()),
        Shortcut("C", "Copy the correction of the previous frame", intents.CopyCorrection(-1)),
        Shortcut("C", "Copy the correction of the next frame", intents.CopyCorrection(1), "shift"),
        Shortcut("V", "Cameras side by side, or one", intents.ShowBeside(), "shift"),
        Shortcut("H", "Show or hide the keypoints", intents.ShowKeypoints()),
        Shortcut("P", "Perturb all joints", "perturb"),
        Shortcut("M", "Back to measured joints", intents.BackToMeasured()),
        Shortcut("Z", "Undo", intents.Undo(), "cmd/ctrl"),
        Shortcut("Z", "Redo", intents.Redo(), "cmd/ctrl+shift"),
        Shortcut("B", "Brush, or put it away", intents.ToggleTool(Tool.BRUSH), "shift"),
        Shortcut("X", "Eraser, or put it away", intents.ToggleTool(Tool.ERASER), "shift"),
        Shortcut("P", "Polygon, or put it away", intents.ToggleTool(Tool.POLYGON), "shift"),
        Shortcut("T", "Prompt (click or box), or put it away", intents.ToggleTool(Tool.PROMPT), "shift"),
        Shortcut("enter", "Prompt: go on with the next object", intents.NextObject()),
        Shortcut("M", "Paint on the mask or on the ignore region", intents.SetTarget(), "shift"),
        Shortcut("[", "Smaller brush", intents.ScaleBrush(1 / _GROWTH)),
        Shortcut("]", "Larger brush", intents.ScaleBrush(_GROWTH)),
        Shortcut("escape", "Drop the polygon, or put the tool away", intents.SetTool(Tool.OFF)),
        Shortcut("V", "Endoscope view or 3D view", "view"),
        *(
            Shortcut(str(number), f"Overlay: {layer.lower()}", intents.ShowLayer(layer))
            for number, layer in enumerate(Layer, start=1)
        ),
    ]


_GROUPS = {
    "Frames": ("frame", "Play", "worst"),
    "Optimize": ("optimizer", "run", "keyframe", "Perturb", "measured", "correction", "joint"),
    "Review": ("Accept", "Mark as", "Reject", "review", "Undo", "Redo"),
    "Paint": ("Brush", "brush", "Eraser", "Polygon", "polygon", "Prompt", "Paint"),
    "View": ("",),
}
"""Names of groups, and words by which the keys of a group are known; the first group that fits has the key."""
_POINTER = (
    ("Ctrl+drag", "Drag a link of an arm; its joints follow"),
    ("Shift+click", "Say where a keypoint of the arm is; Shift+drag takes it along"),
)
"""What the pointer does on the picture while a key is held."""


def key_groups() -> list[tuple[str, list[tuple[str, str]]]]:
    """The shortcuts for the sheet of keys: group by group, each key with what it does."""
    groups: dict[str, list[tuple[str, str]]] = {name: [] for name in _GROUPS}
    groups["On the picture"] = list(_POINTER)
    order = ["Review", "Optimize", "Paint", "Frames", "View"]
    for shortcut in shortcuts():
        name = next(name for name in order if any(word in shortcut.label for word in _GROUPS[name]))
        groups[name].append((shortcut.key, shortcut.label))
    groups["View"].append((",", "Loupe: pixels, coordinates, colour; hold it, or press it to keep it"))
    groups["View"].append((".", "Hold: the measured pose, or the one compared with"))
    groups["View"].append(("?", "This sheet"))
    groups["View"].append(("Ctrl+K", "Find anything by name"))
    return list(groups.items())


def key_table() -> str:
    """The shortcuts as a Markdown table."""
    rows = [f"| **{shortcut.key}** | {shortcut.label} |" for shortcut in shortcuts()]
    rows += [
        *(f"| **{key}** | {text} |" for key, text in _POINTER),
        "| **,** | Loupe: pixels, coordinates, colour; hold it, or press it to keep it |",
        "| **.** (held) | The measured pose, or the one compared with |",
        "| **?** | All keys on one sheet |",
    ]
    return "\n".join(["| Key | What it does |", "|---|---|", *rows])


def with_keys(text: str) -> str:
    """A text with the table of keys between its two marks.

    Raises:
        ValueError: the text has no such marks.
    """
    before, begin, rest = text.partition(_BEGIN)
    _, end, after = rest.partition(_END)
    if not (begin and end):
        raise ValueError(f"the text has no lines {_BEGIN!r} and {_END!r} that say where the table of keys belongs.")
    return f"{before}{begin}\n{key_table()}\n{end}{after}"


if __name__ == "__main__":
    for name in sys.argv[1:]:
        write_text(Path(name), with_keys(Path(name).read_text(encoding="utf-8")))
