"""The Hand-eye step of New recording: clicked points, calibration, and saving."""

import json
import math
import threading
from collections import deque
from collections.abc import Callable
from collections.abc import Sequence as Rows
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from carts_core.errors import SettingsError
from carts_core.model.scene import Scene
from carts_core.optimization import StopReason
from carts_core.optimization.hand_eye import RESULT_FILE, HandEyeResult
from carts_core.recording import Sequence, evenly_spaced
from carts_core.recording.importing.delays import open_recording
from carts_core.recording.importing.found import FoundRecording
from carts_core.recording.importing.writing import write_sequence
from carts_core.settings import CALIBRATION
from carts_core.wording import counted
from carts_viewer.jobs.solver import Calibrated, Calibration, CalibrationTask
from carts_viewer.picture import layers
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.picture.scene_view import SceneView
from carts_viewer.start.host import Host
from carts_viewer.state import NETWORK
from carts_viewer.transport.document import position, render
from carts_viewer.transport.page import Page
from carts_viewer.wizard.calibration import (
    CALIBRATION_FRAMES,
    STOPPED,
    CalibrationJob,
    CalibrationProgress,
    as_plain,
    calibrated_recording,
    calibrated_scene,
    report_of,
    target_folder,
)
from carts_viewer.wizard.draft import ClickedPoint, Draft, Step
from carts_viewer.wizard.drawing import Drawing, drawing_of
from carts_viewer.wizard.points import Clicking, ClickPrompt, unknown_cameras

_OPACITY = 0.9
_AWAY = 1e6
"""Distance at which an arm is smaller than a pixel [m]."""


class FramePicture:
    """Picture beside the document: image and overlay."""

    def __init__(self, page: Page, sequence: Sequence) -> None:
        self._page = page
        self._sequence = sequence
        self._renderer = OverlayRenderer(sequence)
        self._shown: tuple[int, str] | None = None
        frame = sequence.frame(0)
        state = sequence.scene.state(frame.measured, None, frame.mounts)
        self._view = SceneView(page.server.scene, sequence.scene, state, sequence.scene.cameras[0].name)

    def show(self, index: int, camera: str, scene: Scene | None, placeholders: Rows[str]) -> None:
        """Show a frame of a camera, with the contours of a calibrated scene but not of arms with a placeholder pose."""
        frame = self._sequence.frame(index, cameras=[camera])
        own = self._sequence.scene.camera(camera)
        if scene is None:
            picture = layers.transparent(own.height, own.width)
        else:
            state = scene.state(frame.measured, None, frame.mounts)
            T_world_base = np.array(state.T_world_base)
            T_world_base[[arm.name in placeholders for arm in scene.arms], :3, 3] = _AWAY
            ids = self._renderer.arm_ids(replace(state, T_world_base=T_world_base), camera)
            picture = layers.contour(ids, _OPACITY)
        with self._page.server.atomic():
            if self._shown != (index, camera):
                self._view.show_frame(frame.images[camera], own)
            self._view.show_overlay(picture, own)
        self._page.server.flush()
        self._shown = (index, camera)


def hand_eye_panel(
    draft: Draft,
    clicking: Clicking,
    prompt: ClickPrompt | None,
    shown: ClickPrompt,
    drawing: Drawing | None,
    progress: CalibrationProgress | None,
    problem: str,
    folder: str,
    placeholders: Rows[str],
    undoable: bool,
) -> str:
    """HTML of the panel of the Hand-eye step.

    Args:
        shown: frame and camera of the image.
        placeholders: arms with a placeholder pose.
    """
    report, result = draft.report, clicking.result
    camera = clicking.sequence.scene.camera(shown.camera)
    clicked = {point.frame for point in draft.points if point.camera == shown.camera}
    planned = {entry.frame for entry in clicking.plan if entry.camera == shown.camera}
    deviations = {} if result is None else result.deviations
    if report is not None:
        deviations = {(pose.arm, pose.camera): pose.deviation for pose in report.poses}
    return render(
        "hand_eye.html",
        steps=Step,
        draft=draft,
        clicking=clicking,
        prompt=prompt,
        progress=progress,
        running=progress is not None and not progress.ended,
        problem=problem,
        folder=folder,
        placeholders=placeholders,
        undoable=undoable,
        calibration_frames=CALIBRATION_FRAMES,
        keys=[ClickPrompt.of(point).key for point in draft.points],
        done=len({(p.camera, p.frame, p.arm, p.landmark) for p in draft.points}),
        at=prompt or clicking.plan[-1],
        shown=shown,
        size=(camera.width, camera.height),
        drawing=drawing,
        dots={frame: frame in clicked for frame in sorted(clicked | planned)},
        residuals=_residuals(draft, result),
        wrong=frozenset(report.disagreeing if report else () if result is None else result.contradicting),
        deviations=deviations,
        rms=None if result is None else result.error if report is None else _rms(report.after, result),
        rms_before=None if result is None or report is None else _rms(report.before, result),
        counted=counted,
    )


def _residuals(draft: Draft, result: HandEyeResult | None) -> list[tuple[float | None, float | None]]:
    """Residual of each point before a calibration, and now [px]; None if not known."""
    if draft.report is not None:
        return list(zip(draft.report.before, draft.report.after, strict=True))
    now = [None] * len(draft.points) if result is None else result.distances.tolist()
    return [(None, None if value is None or math.isnan(value) else value) for value in now]


def _rms(residuals: Rows[float | None], result: HandEyeResult) -> float:
    """RMS residual of the consistent points [px]."""
    values = [value for row, value in enumerate(residuals) if row not in result.contradicting and value is not None]
    return math.sqrt(sum(value**2 for value in values) / max(len(values), 1))


_WIDTH = 360.0
"""Width of the panel below the document [px]; the document is as wide as the panel (`static/document.js`)."""

ChangeDraft = Callable[[Callable[[Draft], Draft]], None]
"""Receives, on the site's thread, a function that changes the draft after a calibration."""


class HandEyeStep:
    """Clicked points in the images of a recording, and calibration from them.

    Attributes:
        problem: the last error; empty if there is none.
    """

    def __init__(self, host: Host, recording: FoundRecording, draft: Draft, report: ChangeDraft) -> None:
        """Open the recording; `CartsError` if it is not a valid sequence. `report` receives calibration results."""
        self._host, self._recording, self._report = host, recording, report
        self.problem = ""
        self._sequence, self._folder = open_recording(recording)
        self._clicking = Clicking(self._sequence, focal_length=draft.focal_length)
        self._solved: tuple[object, ...] | None = None
        self._skipped: frozenset[ClickPrompt] = frozenset()
        self._wanted: ClickPrompt | None = None
        self._job: CalibrationJob | None = None
        self._progress: CalibrationProgress | None = None
        self._drawings = {arm.name: drawing_of(arm) for arm in self._sequence.scene.arms}
        panel = host.page.server.gui.main_panel
        panel.dock_left()
        panel.set_width(_WIDTH)
        self._picture = FramePicture(host.page, self._sequence)

    def close(self) -> None:
        """Stop a calibration and remove the picture."""
        if self._job is not None:
            self._job.cancel()
            self._job.join()
        self._host.page.server.scene.reset()
        self._folder.cleanup()

    def show(self, draft: Draft, *, undoable: bool) -> None:
        """Update picture and panel."""
        self._solve(draft)
        prompt = self.prompt(draft)
        at = prompt or (self._clicking.plan[0] if not draft.points else ClickPrompt.of(draft.points[-1]))
        placeholders = self._placeholders(draft)
        self._picture.show(at.frame, at.camera, self.shown_scene(draft), placeholders)
        content = hand_eye_panel(
            draft,
            self._clicking,
            prompt,
            at,
            self._drawings[at.arm],
            self._progress,
            self.problem,
            self._target(draft),
            placeholders,
            undoable,
        )
        self._host.document.show(content, "side")

    def matched(self, draft: Draft) -> Draft:
        """The draft with the current frame indices of its points; points without a frame, camera or arm are removed,
        with a `problem`."""
        scene, ids = self._sequence.scene, self._sequence.frame_ids
        rows = {frame_id: row for row, frame_id in enumerate(ids)}
        marks = {arm.name: self._clicking.names(arm.name) for arm in scene.arms}
        cameras = {camera.name for camera in scene.cameras}
        points = []
        for point in draft.points:
            frame_id = point.frame_id or (ids[point.frame] if 0 <= point.frame < len(ids) else "")
            if frame_id in rows and point.camera in cameras and point.landmark in marks.get(point.arm, ()):
                points.append(replace(point, frame=rows[frame_id], frame_id=frame_id))
        if removed := len(draft.points) - len(points):
            self.problem = (
                f"{counted(removed, 'point')} {'was' if removed == 1 else 'were'} removed, since the frame, camera or "
                "arm is no longer part of the recording. Click other points."
            )
            return draft.uncalibrated(points=tuple(points))
        return replace(draft, points=tuple(points))

    def _clicked(self, draft: Draft, prompt: ClickPrompt, value: str) -> Draft:
        """The draft with the prompted point at a position."""
        if (at := position(value)) is None:
            return draft
        camera = self._sequence.scene.camera(prompt.camera)
        point = ClickedPoint(
            prompt.frame,
            prompt.camera,
            prompt.arm,
            prompt.landmark,
            (at[0] * camera.width, at[1] * camera.height),
            self._sequence.frame_ids[prompt.frame],
        )
        if self._wanted == prompt:
            self._wanted = None
        kept = tuple(each for each in draft.points if ClickPrompt.of(each) != prompt)
        self._progress = None
        return draft.uncalibrated(points=(*kept, point))

    def chosen(self, draft: Draft, name: str, value: str) -> Draft:
        """The draft after a choice in the panel; `SettingsError` if the choice is not possible now."""
        self.problem = ""
        kind, _, which = name.partition(" ")
        prompt = self.prompt(draft)
        if name == "cancel" and self._job is not None:
            self._job.cancel()
            if self._running():
                self._progress = CalibrationProgress("Stopping …", 1.0)
        if self._running():
            return draft
        if name == "skip" and prompt is not None:
            self._skipped |= {prompt}
            self._wanted = None
        elif name == "skip-frame" and prompt is not None:
            self._skip_frame(draft, prompt)
        elif kind == "click":
            # A click on an earlier document is not one of the current prompt.
            return self._clicked(draft, prompt, value) if prompt is not None and prompt.key == which else draft
        elif kind == "look":
            self._look(prompt or self._clicking.plan[-1], which, value)
        elif name == "show-point" and (row := _row_of(value, draft)) is not None:
            self._wanted = ClickPrompt.of(draft.points[row])
        elif name == "calibrate":
            self._calibrate()
        else:
            return self._changed(draft, name, value)
        return draft

    def _changed(self, draft: Draft, name: str, value: str) -> Draft:
        """The draft after a choice that may change it."""
        kind, _, which = name.partition(" ")
        if name == "focal_length":
            draft = draft.uncalibrated(focal_length=value == "1")
        elif name == "name":
            draft = replace(draft, name=value.strip())
        elif name == "keep" and draft.offered is not None:
            draft = replace(draft, calibration=draft.offered, offered=None)
        elif name == "discard" and draft.offered is not None:
            draft = draft.uncalibrated()
        elif kind == "move-point" and (row := _row_of(which, draft)) is not None:
            draft = self._moved(draft, row, value)
        elif kind == "shift-point" and (row := _row_of(which, draft)) is not None:
            draft = self._moved(draft, row, value, relative=True)
        elif name == "remove-point" and (row := _row_of(value, draft)) is not None:
            self._wanted = ClickPrompt.of(draft.points[row])
            draft = draft.uncalibrated(points=(*draft.points[:row], *draft.points[row + 1 :]))
        return draft

    def _moved(self, draft: Draft, row: int, value: str, *, relative: bool = False) -> Draft:
        """The draft with a point at another position, or displaced if `relative`."""
        point = draft.points[row]
        camera = self._sequence.scene.camera(point.camera)
        before = (point.pixel[0] / camera.width, point.pixel[1] / camera.height)
        if (at := position(value, before if relative else (0.0, 0.0))) is None:
            return draft
        self._progress = None
        moved = replace(point, pixel=(at[0] * camera.width, at[1] * camera.height))
        return draft.uncalibrated(points=(*draft.points[:row], moved, *draft.points[row + 1 :]))

    def write(self, draft: Draft) -> Path:
        """Write the sequence and return its file; `CartsError` if this fails."""
        if self._running():
            raise SettingsError("the calibration is still running. Stop it, or wait until it ends.")
        folder = target_folder(self._host.roots, Path(draft.source), draft.name)
        count, files = len(draft.points), {}
        if draft.calibration is not None:
            text = f"{count} points clicked in carts view, and a calibration on {CALIBRATION_FRAMES} frames"
            calibration = draft.calibration
        elif self._clicking.result is not None:
            text, calibration = f"{count} points clicked in carts view", self._plain(self._clicking.scene)
            files[RESULT_FILE] = json.dumps(self._clicking.content, indent=1)
        else:
            return write_sequence(replace(self._recording, name=draft.name), folder)
        recording = calibrated_recording(self._recording, self._sequence.scene, calibration, text)
        return write_sequence(replace(recording, name=draft.name), folder, files=files)

    def _solve(self, draft: Draft) -> None:
        wanted = (draft.points, draft.focal_length)
        if self._solved != wanted:
            self._clicking.free_focal_length(draft.focal_length)
            self._clicking.solve(draft.points)
            self._solved = wanted

    def prompt(self, draft: Draft) -> ClickPrompt | None:
        """The next prompt; None if there is none."""
        return self._wanted or self._clicking.next_prompt(draft.points, self._skipped)

    def _skip_frame(self, draft: Draft, prompt: ClickPrompt) -> None:
        """Move the prompts to the nearest unused frame."""
        used = {(entry.camera, entry.frame) for entry in self._clicking.plan}
        used |= {(point.camera, point.frame) for point in draft.points}
        free = [
            frame
            for frame in self._sequence.frames_of(prompt.camera)
            if frame in self._clicking.frames and (prompt.camera, frame) not in used
        ]
        if not free:
            raise SettingsError(
                "all frames with this camera pose are in use. Choose a frame below the image, or skip landmarks that "
                "are not visible."
            )
        other = min(free, key=lambda frame: abs(frame - prompt.frame))
        self._clicking.move_frame(prompt.camera, prompt.frame, other)
        self._wanted = None

    def _look(self, at: ClickPrompt, which: str, value: str) -> None:
        """Prompt for the chosen point."""
        names = {
            "camera": [camera.name for camera in self._sequence.scene.cameras],
            "frame": [str(index) for index in range(len(self._sequence))],
            "arm": [arm.name for arm in self._sequence.scene.arms],
            "landmark": self._clicking.names(at.arm),
        }
        if value in names.get(which, ()):
            prompt = replace(at, **{which: int(value) if which == "frame" else value})
            known = self._clicking.names(prompt.arm)
            self._wanted = prompt if prompt.landmark in known else replace(prompt, landmark=known[0])

    def _running(self) -> bool:
        return self._progress is not None and not self._progress.ended

    def shown_scene(self, draft: Draft) -> Scene | None:
        """The scene shown by the overlay; None if there is no overlay."""
        if self._running() and self._progress is not None and self._progress.scene is not None:
            return self._progress.scene
        if (calibration := draft.calibration or draft.offered) is not None:
            return calibrated_scene(self._sequence.scene, calibration)
        return None if self._clicking.result is None else self._clicking.result.scene

    def _calibrate(self) -> None:
        if self._clicking.result is None:
            raise SettingsError(self._clicking.problem or "Click points first.")
        self._progress = CalibrationProgress("Starting", 0.0)
        scene, known = self._clicking.scene, self._clicking.result.base_covariances
        unknown = unknown_cameras(self._sequence.scene)
        fixed = tuple(camera.name for camera in scene.cameras if camera.name not in unknown)
        usable = self._sequence.with_image(range(len(self._sequence)), [camera.name for camera in scene.cameras])
        task = CalibrationTask(
            self._sequence,
            tuple(usable[place] for place in evenly_spaced(len(usable), min(len(usable), CALIBRATION_FRAMES))),
            self._sequence.domains[0],
            Calibration.of(scene),
            replace(CALIBRATION, arms=tuple(known), locked_cameras=fixed),
            NETWORK,
            backgrounds=False,
            known_base_frames=known,
        )

        newest: deque[CalibrationProgress] = deque(maxlen=1)
        posted = threading.Event()

        def report(progress: CalibrationProgress) -> None:
            newest.append(progress)
            if not posted.is_set():
                posted.set()
                self._host.post(proceed)

        def proceed() -> None:
            # Cleared first: progress that is reported from here on is posted again.
            posted.clear()
            if newest:
                self._proceed(newest.pop())

        self._job = CalibrationJob(self._host.optimizers.calibration(task), scene, report)

    def _proceed(self, progress: CalibrationProgress) -> None:
        if self._job is not None and self._job.cancelled:
            if not progress.ended:
                return
            # The calibration may end before the stop takes effect; its result is discarded.
            progress = STOPPED if progress.result is not None else progress
        self._progress = progress
        self._report(lambda draft: draft if progress.result is None else self._calibrated(draft, progress.result))

    def _calibrated(self, draft: Draft, result: Calibrated) -> Draft:
        """The draft with the result of a calibration: applied if it agrees with the clicked points, else offered."""
        report = report_of(result, self._clicking, draft.points)
        if result.stop_reason in (StopReason.FAILED, StopReason.START_KEPT):
            text = f"The calibration from your points is unchanged, with a loss of {report.loss_before:.4f}."
            verdict = f" {report.verdict.capitalize()}: {report.reason}" if report.verdict else ""
            self._progress = CalibrationProgress("", 0.0, error=text + verdict, ended=True)
            return draft
        self._progress, found = None, self._plain(result.calibration.applied_to(self._clicking.scene))
        draft = draft.uncalibrated(report=report)
        return replace(draft, offered=found) if report.objection else replace(draft, calibration=found)

    def _plain(self, scene: Scene) -> dict[str, Any]:
        """A calibration as stored in a draft, with the base frames of the arms with points."""
        result = self._clicking.result
        return as_plain(scene, () if result is None else result.base_covariances)

    def _placeholders(self, draft: Draft) -> list[str]:
        """Arms that keep a placeholder pose."""
        calibrated = (draft.calibration or self._plain(self._clicking.scene))["arms"]
        notes = self._recording.notes
        return [each.about for each in notes if each.placeholder == "T_world_base" and each.about not in calibrated]

    def _target(self, draft: Draft) -> str:
        try:
            return str(target_folder(self._host.roots, Path(draft.source), draft.name))
        except SettingsError as error:
            return str(error)


def _row_of(key: str, draft: Draft) -> int | None:
    """Index of the clicked point whose prompt has this key; None if there is no such point.

    A choice on an earlier document may be one of a point that has been removed since.
    """
    return next((row for row, point in enumerate(draft.points) if ClickPrompt.of(point).key == key), None)
