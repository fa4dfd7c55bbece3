"""Keyboard shortcuts, hints of controls, and the help panel.

`python -m carts_viewer.panels.help docs/reference/keys.md` updates the table of keys in a Markdown file, between two
marks.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import viser

from carts_core.files import write_text
from carts_core.project import ReviewState
from carts_core.resources import static_dir
from carts_viewer.actions import intents
from carts_viewer.panels.inputs import PanelPage
from carts_viewer.picture.layers import Layer
from carts_viewer.picture.strokes import Tool
from carts_viewer.transport.page import OWN_KEYS
from carts_viewer.transport.viser_private import element_id

FINE, COARSE = 0.1, 1.0
"""Steps of nudging [deg or mm]."""
_GROWTH = 1.25
_BEGIN, _END = "<!-- keys: written by python -m carts_viewer.panels.help -->", "<!-- end of keys -->"

Special = Literal["perturb", "view"]
"""Shortcuts that are no intent: `perturb` depends on fields of the page, `view` happens in the tab alone."""


@dataclass(frozen=True)
class Shortcut:
    """A keyboard shortcut."""

    hotkey: str
    label: str
    action: intents.Intent | Special
    modifier: str | None = None

    @property
    def key(self) -> str:
        """Label of the key."""
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
"""Actions of the pointer on the picture with a modifier key."""


def key_groups() -> list[tuple[str, list[tuple[str, str]]]]:
    """Shortcuts for the sheet of keys: name of each group, with pairs of key and meaning."""
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


HINTS = {
    "Dismiss": "Take the message away; what it is about stays as it is",
    "Fit to": "What the arms are fitted to: the network's predictions, or masks",
    "Undo": "Take back your last step, in whatever frame it was (Ctrl+Z)",
    "Redo": "Do again what was taken back last (Ctrl+Shift+Z)",
    # Sequence
    "Frame": "Number of the shown frame, from 1; N and B go to the next and the previous one",
    "Play": "Play the sequence, or the range chosen in the timeline, round and round (space)",
    "Frames/s": "How fast to play [frames/s]",
    "Domain": "Which variant of the images is shown and optimized; joint positions are the same in all",
    "Camera": "The camera that is painted on and exported alone; a click on its image chooses it, too",
    # Overlay
    "Layer": "What is drawn over the image (the number keys)",
    "Opacity %": "Of the overlay: 0 is invisible, 100 hides what is below it [%]",
    "Swipe %": "Up to where the other pose is shown, from the left [% of the image's width]",
    # Paint
    "Off": "No tool: drag moves the picture again (Esc)",
    "Brush": "Paint with a round brush; Shift erases (Shift+B)",
    "Eraser": "Erase with a round brush; Shift paints (Shift+X)",
    "Adapt the network to this recording": "Train the network further on images made for this recording; a job",
    "Use the newest network": "Go on with the network that was adapted last",
    "Prompt": "Segment what is at a click or in a box; Shift or Alt takes away (Shift+T)",
    "Polygon": "Fill an area: click its corners, Enter or a double click ends it (Shift+P)",
    "Mask": "Correct the mask: what is added or removed counts for Dice and exports",
    "Ignore region": "Mark pixels that the optimizer leaves out",
    "Size [px]": "Diameter of the brush, in pixels of the image ([ and ])",
    "Clear": "Remove all that was painted on this layer of this frame and camera",
    # Joints
    "Perturb all joints": "Move every measured joint by the amount below, up or down at random (P)",
    "By [°, mm]": "How far: degrees for joints that turn, millimetres for those that slide",
    "Seed": "Which of the random directions; the same number gives the same ones",
    "Back to measured": "Forget all corrections of this frame's joints (M)",
    "All back to measured": "Forget all corrections of this frame's joints (M)",
    # Optimize
    "Run": "Fit the arms to this frame's images from where they are; clicked keypoints do not pull on it (R)",
    "Pause": "Hold the run; Continue goes on with it (R)",
    "Step": "A single iteration (T)",
    "Reset": "Back to where the run began (X)",
    "Solver": "What compares the rendered arm with the image; the default is the most accurate",
    "Cameras": "Which cameras' images count",
    "Advanced settings": "Every number of the chosen solver, with its unit and meaning",
    "Reset all to the preset": "Bring all settings back to those of the chosen preset",
    "Close": "Close this window; settings stay",
    "Base frames": "Let runs and calibrations move where the arms stand",
    "Camera pose": "Let runs and calibrations move the cameras",
    "Camera intrinsics": "Let runs and calibrations change focal length and principal point [px]",
    # Review
    "Accept + next": "Accept this frame, and go to the next unreviewed one (G)",
    "Accept": "Accept this frame: solving leaves it as it is",
    "Needs work": "Mark this frame for later (F)",
    "Reject": "Mark this frame as unusable; exports leave it out if you say so (J)",
    "Note": "Anything worth remembering about this frame; saved when you leave the field",
    "Previous worst": "Go to the frame that fits next better than this one (Shift+L)",
    "Next worst": "Go to the frame that fits worst of those that are neither accepted nor rejected; frames "
    "without a verdict come last, in order (L)",
    "Next unreviewed": "Go to the next frame without a review (Y)",
    "Solve between": "Fit the frames between the kept ones around this frame together (Shift+K)",
    "Solve all": "Fit all frames, or those in the timeline's range, together; kept frames stay as they are",
    "Begin at": "From which end of the sequence solving goes on",
    "Take it as solved": "Use what was solved for this frame, although it fits worse",
    "Take all": "Use what was solved for all listed frames, although they fit worse",
    "Leave them, close the list": "Keep the listed frames as they are",
    "Stop and keep": "Stop solving, and keep the frames that are done",
    "Keypoint": "Which point of the arm the next Shift+click is about",
    "Show keypoints": "Mark the keypoints of the arms in the images, with their names (H)",
    "Forget the clicks": "Remove the clicked points; the arm stays where it is",
    "Import masks": "Read masks or keypoints into a layer of this project; one step of undo",
    # Find
    "Review": "Frames in this review state",
    "Corrected": "Frames in which this arm's joints were corrected",
    "Note has": "Frames whose note contains this text",
    "Previous": "The frame before this one that was found",
    "Next": "The frame after this one that was found",
    "Accept all": "Accept every frame that was found, as one step of undo",
    "Reject all": "Reject every frame that was found, as one step of undo",
    "Reset all": "Make every frame that was found unreviewed, as one step of undo",
    # Jobs
    "Run jobs": "Run the jobs that another user, or another computer, has queued",
    "Discard jobs": "Cancel these jobs; nothing of them runs",
    "Accept network": "Use these weights now, and whenever they are chosen again",
    "Refuse network": "Do not use these weights",
    "Which frames": "What the job works on",
    "Optimize each alone": "Run on each of these frames from where it is; what would fit worse is not taken",
    "Calibrate": "Fit base frames, or what is ticked under Free parameters, to these frames together. All masks "
    "move with it, so accepted frames become unreviewed; one step of undo",
    "Job": "The job that the buttons and the log below are about",
    "Cancel": "Stop this job, or take it out of the queue; what it has saved stays",
    "Start again": "Queue this job once more; one on many frames goes on where it stopped",
    "Clear ended": "Take all jobs that have ended off the list",
    # Live
    "Start": "Follow the source in the place of the recording",
    "Stop": "Go back to the recording",
    # Export
    "Format": "What other tools will read",
    "Frames": "Which frames are written, by their review state",
    "Only the range": "Of these, only frames in the timeline's range",
    "Category per": "What gets a class of its own",
    "Copy images": "Copy the images beside their labels; otherwise labels name those of the recording",
    "Export": "Write into a new folder beside the project, as a job",
    "Cancel export": "Stop; nothing of it is left",
    "Download it": "Send what was written last to this browser",
    "Export mask": "Download this frame's mask of the shown camera as PNG",
}
"""By label."""


def explain(page: PanelPage) -> list[str]:
    """Set the hints of all controls of a tab; returns the labels of those without one.

    viser shows hints over fields alone, so the page's script shows those of buttons and over labels.
    """
    missing, shown = [], {}
    for handle in page.widgets():
        label = getattr(handle, "label", None)
        if label is None or not hasattr(handle, "hint"):
            continue
        if not handle.hint and label not in HINTS:
            missing.append(label)
            continue
        handle.hint = handle.hint or HINTS[label]
        shown[element_id(handle)] = handle.hint
    page.call("setHints", shown)
    return missing


class HelpPanel:
    """Registers the shortcuts and explains everything in a few words."""

    def __init__(self, page: PanelPage, perturb: Callable[[], intents.Intent]) -> None:
        gui = page.gui
        own = {}
        for shortcut in shortcuts():
            hotkey = None if shortcut.hotkey in OWN_KEYS else shortcut.hotkey
            # viser shows the keys that it listens to itself.
            described = shortcut.key if hotkey is None else None
            command = gui.add_command(shortcut.label, description=described, hotkey=hotkey, modifier=shortcut.modifier)  # type: ignore[arg-type]
            _listen(page, command, shortcut, perturb)
            if hotkey is None and isinstance(shortcut.action, intents.Intent):
                own[shortcut.hotkey] = shortcut.action
        page.on_pressed(lambda key: page.emit(own[key]) if key in own else None)
        text = (static_dir() / "help.md").read_text(encoding="utf-8")
        gui.add_markdown(text.replace("{shortcuts}", key_table()))


def _listen(
    page: PanelPage, command: viser.CommandHandle, shortcut: Shortcut, perturb: Callable[[], intents.Intent]
) -> None:
    @command.on_trigger
    async def _(event: viser.CommandEvent) -> None:
        if isinstance(shortcut.action, intents.Intent):
            page.emit(shortcut.action)
        elif shortcut.action == "perturb":
            page.emit(perturb())
        else:
            page.call("toggleView")
