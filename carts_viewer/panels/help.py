"""Keyboard shortcuts, hints of controls, and the help panel.

`python -m carts_viewer.panels.help docs/reference/keys.md` updates the table of keys between two marks in `keys.md`.
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
"""Step sizes of `intents.Nudge` [deg or mm]."""
_GROWTH = 1.25
_BEGIN, _END = "<!-- keys: written by python -m carts_viewer.panels.help -->", "<!-- end of keys -->"

Special = Literal["perturb", "view"]
"""Shortcuts without an intent: `perturb` depends on fields of the page, and the page's script handles `view`."""


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
    """All shortcuts; they are the same in every recording.

    They use neither the letters with which viser moves the camera (W A S D Q E) nor the arrow keys, which move a
    focused slider.
    """
    return [
        Shortcut("space", "Play or stop", intents.Play()),
        Shortcut("N", "Next frame", intents.MoveFrame(1)),
        Shortcut("B", "Previous frame (back)", intents.MoveFrame(-1)),
        Shortcut("(", "Start the range at this frame", intents.MarkRange()),
        Shortcut(")", "End the range at this frame", intents.MarkRange(end=True)),
        Shortcut("R", "Run or pause the optimizer", intents.RunOrPause()),
        Shortcut("T", "One step of the optimizer", intents.Step()),
        Shortcut("X", "Reset to the start of the run", intents.Reset()),
        Shortcut("K", "Mark or unmark the frame as a keyframe", intents.SetKeyframe()),
        Shortcut("K", "Solve between the keyframes", intents.Solve(), "shift"),
        Shortcut("G", "Accept, and show the next unreviewed frame", intents.AcceptAndNext()),
        Shortcut("F", "Mark as needing work", intents.SetReview(ReviewState.NEEDS_WORK)),
        Shortcut("J", "Reject", intents.SetReview(ReviewState.REJECTED)),
        Shortcut("G", "Clear the review", intents.SetReview(ReviewState.UNTOUCHED), "shift"),
        Shortcut("Y", "Next unreviewed frame", intents.ShowUnreviewed()),
        Shortcut("Y", "Previous unreviewed frame", intents.ShowUnreviewed(-1), "shift"),
        Shortcut("L", "Next worst frame that is neither accepted nor rejected", intents.ShowWorst()),
        Shortcut("L", "Previous worst frame", intents.ShowWorst(-1), "shift"),
        Shortcut("O", f"Nudge the joint by {FINE:g}° or {FINE:g} mm", intents.Nudge(FINE)),
        Shortcut("I", f"Nudge the joint by -{FINE:g}° or -{FINE:g} mm", intents.Nudge(-FINE)),
        Shortcut("O", f"Nudge the joint by {COARSE:g}° or {COARSE:g} mm", intents.Nudge(COARSE), "shift"),
        Shortcut("I", f"Nudge the joint by -{COARSE:g}° or -{COARSE:g} mm", intents.Nudge(-COARSE), "shift"),
        Shortcut("U", "Choose the next joint to nudge", intents.ChooseJoint()),
        Shortcut("C", "Copy the correction of the previous frame", intents.CopyCorrection(-1)),
        Shortcut("C", "Copy the correction of the next frame", intents.CopyCorrection(1), "shift"),
        Shortcut("V", "All cameras side by side, or one", intents.ShowBeside(), "shift"),
        Shortcut("H", "Show or hide the keypoints", intents.ShowKeypoints()),
        Shortcut("P", "Perturb all joints", "perturb"),
        Shortcut("M", "Reset to the measured joint positions", intents.BackToMeasured()),
        Shortcut("Z", "Undo", intents.Undo(), "cmd/ctrl"),
        Shortcut("Z", "Redo", intents.Redo(), "cmd/ctrl+shift"),
        Shortcut("B", "Brush on or off", intents.ToggleTool(Tool.BRUSH), "shift"),
        Shortcut("X", "Eraser on or off", intents.ToggleTool(Tool.ERASER), "shift"),
        Shortcut("P", "Polygon on or off", intents.ToggleTool(Tool.POLYGON), "shift"),
        Shortcut("T", "Prompt (click or box) on or off", intents.ToggleTool(Tool.PROMPT), "shift"),
        Shortcut("enter", "Prompt: start the next object", intents.NextObject()),
        Shortcut("M", "Switch painting between mask and ignore region", intents.SetTarget(), "shift"),
        Shortcut("[", "Smaller brush", intents.ScaleBrush(1 / _GROWTH)),
        Shortcut("]", "Larger brush", intents.ScaleBrush(_GROWTH)),
        Shortcut("escape", "Discard the polygon, or deselect the tool", intents.SetTool(Tool.OFF)),
        Shortcut("V", "Endoscope view or 3D view", "view"),
        *(
            Shortcut(str(number % 10), f"Overlay: {layer.lower()}", intents.ShowLayer(layer))
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
"""Names of groups, and words in the labels of their keys; a key belongs to the first group that matches."""
_POINTER = (
    ("Ctrl+drag", "Drag a link of an arm; its joints follow"),
    ("Shift+click", "Place a keypoint of the arm; Shift+drag moves it"),
)
"""Actions of the pointer on the picture with a modifier key, and their descriptions."""


def key_groups() -> list[tuple[str, list[tuple[str, str]]]]:
    """Shortcuts of the key sheet: name of each group, with pairs of key and description."""
    groups: dict[str, list[tuple[str, str]]] = {name: [] for name in _GROUPS}
    groups["On the picture"] = list(_POINTER)
    order = ["Review", "Optimize", "Paint", "Frames", "View"]
    for shortcut in shortcuts():
        name = next(name for name in order if any(word in shortcut.label for word in _GROUPS[name]))
        groups[name].append((shortcut.key, shortcut.label))
    groups["View"].append((",", "Loupe: pixels, coordinates, colour; hold, or press to toggle"))
    groups["View"].append((".", "Hold: show the measured pose, or the pose to compare with"))
    groups["View"].append(("?", "Show this sheet"))
    groups["View"].append(("Ctrl+K", "Find any action by name"))
    return list(groups.items())


def key_table() -> str:
    """The shortcuts as a Markdown table."""
    rows = [f"| **{shortcut.key}** | {shortcut.label} |" for shortcut in shortcuts()]
    rows += [
        *(f"| **{key}** | {text} |" for key, text in _POINTER),
        "| **,** | Loupe: pixels, coordinates, colour; hold, or press to toggle |",
        "| **.** | Hold: show the measured pose, or the pose to compare with |",
        "| **?** | Show all keys |",
    ]
    return "\n".join(["| Key | Action |", "|---|---|", *rows])


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


HINTS = {
    "Dismiss": "Hide the message",
    "Fit to": "Target of a fit: the network's predictions, masks, or both",
    "Undo": "Undo your last step, in any frame (Ctrl+Z)",
    "Redo": "Redo the last undone step (Ctrl+Shift+Z)",
    # Sequence
    "Frame": "Number of the shown frame, from 1; N and B show the next and the previous frame",
    "Previous frame": "Previous frame (B)",
    "Next frame": "Next frame (N)",
    "Play": "Play the sequence, or the range in the timeline, in a loop (space)",
    "Frames/s": "Playback rate [frames/s]",
    "Domain": "Variant of the images to show and optimize; all variants have the same joint positions",
    "Camera": "Active camera, for painting and exports of one camera; also selected by a click on its image",
    # Overlay
    "Layer": "Layer over the image (number keys)",
    "Opacity %": "Opacity of the overlay: 0 is invisible, 100 hides the image below [%]",
    "Swipe %": "Left part of the image, which shows the other pose [% of the width]",
    # Paint
    "Off": "No tool: dragging pans the image (Esc)",
    "Brush": "Paint with a round brush; Shift erases (Shift+B)",
    "Eraser": "Erase with a round brush; Shift paints (Shift+X)",
    "Adapt the network to this recording": "Queue a job that trains the network on synthetic images for this recording",
    "Use newest network": "Use the network that was adapted last",
    "Prompt": "Segment the object at a click or in a box; hold Shift or Alt to remove it (Shift+T)",
    "Polygon": "Fill a polygon: click its corners; Enter or a double click closes it (Shift+P)",
    "Mask": "Correct the mask; Dice and exports use the corrected mask",
    "Ignore region": "Mark pixels that the optimizer ignores",
    "Size [px]": "Diameter of the brush, in pixels of the image ([ and ])",
    "Clear": "Erase everything painted in this layer, in this frame and camera",
    # Joints
    "Perturb all joints": "Offset every measured joint by the value below, with random signs (P)",
    "By [°, mm]": "Size of the offset: degrees for revolute joints, millimetres for prismatic joints",
    "Seed": "Seed of the random signs; the same number gives the same signs",
    "Back to measured": "Reset this frame's joints to the measured values (M)",
    "All back to measured": "Reset this frame's joints to the measured values (M)",
    # Optimize
    "Run": "Fit the arms to this frame's images from the current pose; clicked keypoints do not constrain the fit (R)",
    "Pause": "Pause the run; Continue resumes it (R)",
    "Step": "Perform one iteration (T)",
    "Reset": "Reset to the start of the run (X)",
    "Solver": "Solver and its objective; the default is the most accurate",
    "Cameras": "Cameras whose images are fitted",
    "Advanced settings": "Show all settings of the chosen solver, with units and descriptions",
    "Reset to preset": "Reset all settings to those of the chosen preset",
    "Close": "Close this window; settings are kept",
    "Base frames": "Allow runs and calibrations to move the bases of the arms",
    "Camera pose": "Allow runs and calibrations to move the cameras",
    "Camera intrinsics": "Allow runs and calibrations to change focal length and principal point [px]",
    # Review
    "Accept + next": "Accept this frame, and show the next unreviewed frame (G)",
    "Accept": "Accept this frame; solving does not change it",
    "Needs work": "Mark this frame for later work (F)",
    "Reject": "Mark this frame as unusable; exports can exclude it (J)",
    "Note": "Note on this frame; saved when you leave the field",
    "Previous worst": "Show the previous frame, in the order from worst to best (Shift+L)",
    "Next worst": "Show the next frame, in the order from worst to best, that is neither accepted nor rejected; frames "
    "without a verdict come last (L)",
    "Next unreviewed": "Show the next frame without a review (Y)",
    "Solve between": "Fit all frames between the nearest kept frames together (Shift+K)",
    "Solve all": "Fit all frames, or those in the timeline's range, together; kept frames do not change",
    "Begin at": "Frame from which solving starts",
    "Take solved pose": "Use the solved pose of this frame, although it fits worse",
    "Take all": "Use the solved poses of all listed frames, although they fit worse",
    "Discard all": "Keep the previous poses of the listed frames, and close the list",
    "Stop and keep": "Stop solving, and save the solved frames",
    "Keypoint": "Point of the arm that the next Shift+click places",
    "Show keypoints": "Mark the keypoints of the arms in the images, with their names (H)",
    "Clear clicks": "Remove the placed keypoints; the arm keeps its pose",
    "Import masks": "Import masks or keypoints into a layer of this project, as one undo step",
    # Find
    "Review": "Frames in this review state",
    "Corrected": "Frames in which this arm's joints were corrected",
    "Note text": "Frames whose note contains this text",
    "Previous": "Previous matching frame",
    "Next": "Next matching frame",
    "Accept all": "Accept all matching frames, as one undo step",
    "Reject all": "Reject all matching frames, as one undo step",
    "Reset all": "Clear the review of all matching frames, as one undo step",
    # Jobs
    "Run jobs": "Run the jobs queued by another user or on another computer",
    "Discard jobs": "Cancel these jobs without running them",
    "Accept network": "Use these weights now and in the future",
    "Refuse network": "Do not use these weights",
    "Which frames": "Frames of the job",
    "Optimize individually": "Run on each of these frames from its current pose; worse results are discarded",
    "Calibrate": "Fit base frames, or the parameters ticked under Free parameters, jointly to these frames. All masks "
    "change, so accepted frames become unreviewed; one undo step",
    "Job": "Job to which the buttons and the log below refer",
    "Cancel": "Stop this job, or remove it from the queue; saved results are kept",
    "Start again": "Queue this job again; a job on many frames continues where it stopped",
    "Clear ended jobs": "Remove ended jobs from the list",
    # Live
    "Start": "Show the live images in place of the recording, and track the arms in these images",
    "Stop": "Return to the recording",
    # Export
    "Format": "File format",
    "Frames": "Frames to write, by review state",
    "Only the range": "Export only frames in the timeline's range",
    "Category per": "Kind of object that gets its own category",
    "Copy images": "Copy the images beside their labels; otherwise labels refer to the recording's images",
    "Export": "Write the frames to a new folder beside the project, as a job",
    "Cancel export": "Cancel the export and remove its files",
    "Download": "Send the last export to this browser",
    "Export mask": "Download this frame's mask of the shown camera as PNG",
}
"""Hints of controls by label."""


def set_hints(page: PanelPage) -> list[str]:
    """Set the hints of all controls of a tab; returns the labels of controls without a hint.

    viser shows only hints of fields, so the page's script shows those of buttons and labels.
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


_SCRIPTS = {
    "Light or dark": ("toggleTheme",),
    "Loupe": ("toggleLoupe",),
    "Frames": ("openFrames",),
    "Keys": ("showSheet",),
    "Take the tour": ("startTour",),
    "Copy link": ("copyLink",),
    **{f"Tab: {name}": ("chooseTabs", [name]) for name in ("Optimize", "Review", "Values", "Jobs", "Live", "Export")},
}
"""Actions of the page's scripts by label, with the function and its arguments."""


class HelpPanel:
    """Registers the shortcuts and all other actions as commands, and shows the guide in a window."""

    def __init__(self, page: PanelPage, perturb: Callable[[], intents.Intent]) -> None:
        gui = page.gui
        own = {}
        for shortcut in shortcuts():
            hotkey = None if shortcut.hotkey in OWN_KEYS else shortcut.hotkey
            # viser adds the keys that it handles itself to its list of commands.
            described = shortcut.key if hotkey is None else None
            command = gui.add_command(shortcut.label, description=described, hotkey=hotkey, modifier=shortcut.modifier)  # type: ignore[arg-type]
            _listen(page, command, shortcut, perturb)
            if hotkey is None and isinstance(shortcut.action, intents.Intent):
                own[shortcut.hotkey] = shortcut.action
        page.on_pressed(lambda key: page.emit(own[key]) if key in own else None)
        _add_actions(page)
        self._add_guide(page)

    @staticmethod
    def _add_guide(page: PanelPage) -> None:
        window = page.gui.add_panel(visible=False)
        with window.add_tab("Guide"):
            close = page.gui.add_button("Close", icon=viser.Icon.X, color="gray")
            text = (static_dir() / "help.md").read_text(encoding="utf-8")
            page.gui.add_markdown(text.replace("{shortcuts}", key_table()))
        window.float(x=40, y=60, width=480, height=620)

        def show(on: bool) -> None:
            window.visible = on

        @close.on_click
        async def _(_: viser.GuiEvent) -> None:
            show(False)

        @page.gui.add_command("Guide", description="Explains the page").on_trigger
        async def _(_: viser.CommandEvent) -> None:
            show(True)

        page.on_pressed(lambda key: show(True) if key == "guide" else None)


def _add_actions(page: PanelPage) -> None:
    """Add a command for each button without a shortcut, and for each function of the page's scripts."""
    known = [shortcut.action for shortcut in shortcuts()]
    for handle, intent in page.buttons:
        if intent in known:
            continue
        command = page.gui.add_command(handle.label, description=handle.hint or HINTS.get(handle.label))

        @command.on_trigger
        async def _(
            event: viser.CommandEvent, intent: intents.Intent | Callable[[int], intents.Intent] = intent
        ) -> None:
            if isinstance(intent, intents.Intent):
                page.emit(intent)
            elif event.client_id is not None:
                page.emit(intent(event.client_id))

    for label, (name, *arguments) in _SCRIPTS.items():

        @page.gui.add_command(label).on_trigger
        async def _(_: viser.CommandEvent, name: str = name, arguments: list = arguments) -> None:
            page.call(name, *arguments)


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
