"""Hints of controls, the list of actions, and the guide."""

import re
from collections.abc import Callable
from typing import Any

import viser

from carts_core.resources import static_dir
from carts_viewer.actions import intents
from carts_viewer.actions.shortcuts import Keys, Shortcut, key_table, keys_of, shortcuts
from carts_viewer.panels.inputs import PanelPage
from carts_viewer.state import ViewState
from carts_viewer.transport.viser_private import element_id

HINTS = {
    "Dismiss": "Hide the message",
    "Fit to": "Target of a fit: the network's predictions, masks, or both",
    "Undo": "Undo your last step, in any frame ({Undo})",
    "Redo": "Redo the last undone step ({Redo})",
    # Sequence
    "Frame": "Number of the shown frame, from 1 ({MoveFrame 1}, {MoveFrame -1})",
    "Previous frame": "Previous frame ({MoveFrame -1})",
    "Next frame": "Next frame ({MoveFrame 1})",
    "Play": "Play the sequence, or the range in the timeline, in a loop ({Play None})",
    "Frames/s": "Playback rate [frames/s]",
    "Domain": "Variant of the images to show and optimize; all variants have the same joint positions",
    "Camera": "Active camera, for painting and exports of one camera; also selected by a click on its image",
    # Overlay
    "Layer": "Layer over the image (number keys)",
    "Opacity %": "Opacity of the overlay: 0 is invisible, 100 hides the image below [%]",
    "Adapt the network to this recording": "Queue a job that trains the network on synthetic images for this recording",
    "Use newest network": "Use the network that was adapted last",
    # Joints
    "Perturb all joints": "Offset every measured joint by the value below, with random signs ({perturb})",
    "By [°, mm]": "Size of the offset: degrees for revolute joints, millimetres for prismatic joints",
    "Seed": "Seed of the random signs; the same number gives the same signs",
    "Back to measured": "Reset this frame's joints to the measured values ({BackToMeasured None})",
    "All back to measured": "Reset this frame's joints to the measured values ({BackToMeasured None})",
    # Optimize
    "Run": "Fit the arms to this frame's images from the current pose; clicked keypoints do not constrain the fit "
    "({RunOrPause})",
    "Pause": "Pause the run; Continue resumes it ({RunOrPause})",
    "Step": "Perform one iteration ({Step})",
    "Reset": "Reset to the start of the run ({Reset})",
    "Solver": "Solver and its objective; the default is the most accurate",
    "Cameras": "Cameras whose images are fitted",
    "Advanced settings": "Show all settings of the chosen solver, with units and descriptions",
    "Reset to preset": "Reset all settings to those of the chosen preset",
    "Close": "Close this window; settings are kept",
    "Base frames": "Allow runs and calibrations to move the bases of the arms",
    "Camera pose": "Allow runs and calibrations to move the cameras",
    "Camera intrinsics": "Allow runs and calibrations to change focal length and principal point [px]",
    # Review
    "Accept + next": "Accept this frame, and show the next unreviewed frame ({AcceptAndNext})",
    "Accept": "Accept this frame; solving does not change it",
    "Needs work": "Mark this frame for later work ({SetReview needs work})",
    "Reject": "Mark this frame as unusable; exports can exclude it ({SetReview rejected})",
    "Note": "Note on this frame; saved when you leave the field",
    "Previous worst": "Show the previous frame, in the order from worst to best ({ShowWorst -1})",
    "Next worst": "Show the next frame, in the order from worst to best, that is neither accepted nor rejected; frames "
    "of unknown fit come last ({ShowWorst 1})",
    "Next unreviewed": "Show the next frame without a review ({ShowUnreviewed 1})",
    "Solve between": "Fit all frames between the nearest kept frames together; kept frames (accepted, moved by "
    "hand, or keyframes) do not change ({Solve False})",
    "Solve all": "Fit all frames, or those in the timeline's range, together; kept frames do not change",
    "Begin at": "Frame from which solving starts",
    "Take solved pose": "Use the solved pose of this frame, although it fits worse",
    "Take all": "Use the solved poses of all listed frames, although they fit worse",
    "Discard all": "Keep the previous poses of the listed frames, and close the list",
    "Stop and keep": "Stop solving, and save the solved frames",
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
    "Which frames": "Frames to optimize individually",
    "Optimize individually": "Run on each of these frames separately, from its current pose; worse results are "
    "discarded. Solve all (Review) fits neighbouring frames together",
    "Calibrate": "Fit base frames, or the parameters ticked under Free parameters, jointly to evenly spaced frames. "
    "All masks change, so accepted frames become unreviewed; one undo step",
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
    "Export": "Write the frames to a new file or folder beside the project, as a job",
    "Cancel export": "Cancel the export and remove its files",
    "Cancel import": "Cancel the import; the project is unchanged",
    "Download": "Send the last export to this browser",
    "Export mask": "Download this frame's mask of the shown camera as PNG (255 is arm), refined if the layer "
    "Refined mask is shown",
}
"""Hints of controls by label; {NAME} is the key of an action (`Shortcut.name`)."""


def hint_with_keys(text: str, keys: Keys) -> str:
    """Replace each name of an action in braces by the key of the action."""
    return re.sub(r"\{([^}]+)\}", lambda found: keys.get(found[1], found[0]), text)


def set_hints(page: PanelPage, changed: Keys) -> list[str]:
    """Set the hints of all controls of a tab; returns the labels of controls without a hint.

    viser shows only hints of fields, so the page's script shows those of buttons and labels.
    """
    missing, shown, keys = [], {}, keys_of(changed)
    for handle in page.widgets():
        label = getattr(handle, "label", None)
        if label is None or not hasattr(handle, "hint"):
            continue
        text = page.hints.setdefault(element_id(handle), handle.hint or HINTS.get(label, ""))
        if not text:
            missing.append(label)
            continue
        hint = shown[element_id(handle)] = hint_with_keys(text, keys)
        if handle.hint != hint:
            handle.hint = hint
    page.call("setHints", shown)
    return missing


_SCRIPTS = {
    "Light or dark": ("toggleTheme",),
    "Frames": ("openFrames",),
    "Take the tour": ("startTour",),
    "Copy link": ("copyLink",),
    **{f"Tab: {name}": ("chooseTabs", [name]) for name in ("Optimize", "Review", "Values", "Jobs", "Live", "Export")},
}
"""Actions of the page's scripts by label, with the function and its arguments."""
_CALLS = {"view": "toggleView", "sheet": "showSheet"}
"""Functions of the page's scripts for local actions."""


class HelpPanel:
    """The list of actions, the keys, the hints of all controls, and the guide."""

    def __init__(self, page: PanelPage, perturb: Callable[[], intents.Intent]) -> None:
        self._page, self._perturb = page, perturb
        self._keys: Keys | None = None
        self._commands: dict[str, viser.CommandHandle] = {}
        self._of_buttons: dict[str, tuple[viser.CommandHandle, list[viser.GuiButtonHandle]]] = {}
        for name, shortcut in shortcuts().items():
            if shortcut.action == "peek":  # lasts while its key is held
                continue
            self._commands[name] = command = page.gui.add_command(shortcut.label)
            self._listen(command, lambda _, shortcut=shortcut: self._act(shortcut))
        known = [shortcut.action for shortcut in shortcuts().values()]
        for handle, intent in page.buttons:
            if handle.label in self._of_buttons:
                self._of_buttons[handle.label][1].append(handle)
            elif intent not in known:
                command = page.gui.add_command(handle.label)
                self._commands[element_id(handle)] = command
                self._of_buttons[handle.label] = (command, [handle])
                self._listen(command, lambda client, intent=intent: page.emit_from(intent, client))
        for label, (name, *arguments) in _SCRIPTS.items():
            self._listen(page.gui.add_command(label), lambda _, call=(name, *arguments): page.call(*call))
        page.on_pressed(self._pressed)
        self._add_guide(page)

    def show(self, state: ViewState) -> None:
        """Name the current keys in the list of actions and in the hints, and disable impossible actions."""
        for command, buttons in self._of_buttons.values():
            if command.disabled != (impossible := all(one.disabled or not one.visible for one in buttons)):
                command.disabled = impossible
        if state.keys == self._keys:
            return
        self._keys, keys = state.keys, keys_of(state.keys)
        set_hints(self._page, state.keys)
        for name, command in self._commands.items():
            description = keys.get(name) or hint_with_keys(self._page.hints.get(name, ""), keys)
            if description and command.description != description:
                command.description = description

    def _pressed(self, name: str) -> None:
        if name == "SetTool Select" and self._page.close_window():
            return
        if name in shortcuts():
            self._act(shortcuts()[name])

    def _act(self, shortcut: Shortcut) -> None:
        if isinstance(shortcut.action, intents.Intent):
            self._page.emit(shortcut.action)
        elif shortcut.action == "perturb":
            self._page.emit(self._perturb())
        elif shortcut.action == "loupe":
            self._page.emit(intents.ShowLoupe())
        elif shortcut.action in _CALLS:
            self._page.call(_CALLS[shortcut.action])

    @staticmethod
    def _listen(command: viser.CommandHandle, act: Callable[[int], Any]) -> None:
        @command.on_trigger
        async def _(event: viser.CommandEvent) -> None:
            if event.client_id is not None:
                act(event.client_id)

    def _add_guide(self, page: PanelPage) -> None:
        window = page.gui.add_panel(visible=False)
        source = (static_dir() / "help.md").read_text(encoding="utf-8")
        with window.add_tab("Guide"):
            close = page.gui.add_button("Close", icon=viser.Icon.X, color="gray")
            text = page.gui.add_markdown("")
        window.float(x=40, y=60, width=480, height=620)

        def show() -> None:
            keys = self._keys or {}
            text.content = hint_with_keys(source, {**keys_of(keys), "shortcuts": key_table(keys)})
            page.open_window(window)

        @close.on_click
        async def _(_: viser.GuiEvent) -> None:
            window.visible = False

        @page.gui.add_command("Guide", description="Explains the page").on_trigger
        async def _(_: viser.CommandEvent) -> None:
            show()

        page.on_pressed(lambda key: show() if key == "guide" else None)
