"""What controls say when the pointer rests on them: meaning and unit, for those that were made without such a text."""

from carts_viewer.transport.tab_page import TabPage
from carts_viewer.transport.viser_private import element_id

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
    "Accept + next": "Accept this frame, and go to the next one that nobody has judged (G)",
    "Accept": "Accept this frame: solving leaves it as it is",
    "Needs work": "Mark this frame for later (F)",
    "Reject": "Mark this frame as unusable; exports leave it out if you say so (J)",
    "Note": "Anything worth remembering about this frame; saved when you leave the field",
    "Previous worst": "Go to the frame that fits next better than this one (Shift+L)",
    "Next worst": "Go to the frame that fits worst of those that are neither accepted nor rejected; frames that nobody "
    "has solved or checked come last, in order (L)",
    "Next unreviewed": "Go to the next frame that nobody has judged (Y)",
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


def explain(page: TabPage) -> list[str]:
    """Give all controls of a tab their hints; gives the labels of those that have none, now or before.

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
