"""The last step of New recording: points in the picture, calibration over the recording, and saving."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from carts_core.errors import SettingsError
from carts_core.model.scene import Scene
from carts_core.optimization import CalibrationResult, StopReason
from carts_core.optimization.hand_eye import HandEyePrior, ImagePoint
from carts_core.recording.importing.found import FoundRecording
from carts_viewer.recording import plots
from carts_viewer.recording.calibrating import FRAMES, STOPPED, CalibrationJob, Progress, as_plain
from carts_viewer.recording.clicking import Clicking, Wish, unknown_cameras
from carts_viewer.recording.draft import Draft
from carts_viewer.recording.panel import hand_eye_panel
from carts_viewer.recording.picture import FramePicture
from carts_viewer.recording.report import report_of
from carts_viewer.recording.saving import calibrated_recording, target_folder, write_saved
from carts_viewer.recording.scenes import calibrated_scene
from carts_viewer.start.host import Host

_WIDTH = 340.0
"""Of the document at the side [px]; `static/document.css` has it, too."""

Report = Callable[[Callable[[Draft], Draft]], None]
"""Called on the site's thread with what a calibration makes of the draft."""


class HandEyeStep:
    """The recording opened, with what was clicked in it.

    Attributes:
        problem: what went wrong last, for people; empty if nothing did.
    """

    def __init__(self, host: Host, recording: FoundRecording, draft: Draft, report: Report) -> None:
        """
        Args:
            host: where it is shown.
            recording: as found.
            draft: with points from before, if there are some.
            report: called when a calibration ends.

        Raises:
            CartsError: the recording does not make a sequence.
        """
        self._host, self._recording, self._report = host, recording, report
        self.problem = ""
        self._sequence, self._folder = plots.opened(recording)
        self._clicking = Clicking(self._sequence, focal_length=draft.focal_length)
        self._solved: tuple[object, ...] | None = None
        self._skipped: frozenset[Wish] = frozenset()
        self._wanted: Wish | None = None
        self._job: CalibrationJob | None = None
        self._progress: Progress | None = None
        panel = host.page.server.gui.main_panel
        panel.dock_left()
        panel.set_width(_WIDTH)
        self._picture = FramePicture(host.page, self._sequence)

    def close(self) -> None:
        """Stop a calibration, and take the picture away."""
        if self._job is not None:
            self._job.cancel()
            self._job.join()
        self._host.page.server.scene.reset()
        self._folder.cleanup()

    def show(self, draft: Draft, *, undoable: bool) -> None:
        """Bring picture and panel up to date."""
        self._solve(draft)
        wish = self.wish(draft)
        at = wish or (self._clicking.plan[0] if not draft.points else _wish_of(draft.points[-1]))
        wrong = frozenset(() if self._clicking.result is None else self._clicking.result.contradicting)
        self._picture.show(at.frame, at.camera, self.shown_scene(draft), draft.points, wrong)
        folder = self._target(draft)
        content = hand_eye_panel(draft, self._clicking, wish, self._progress, self.problem, folder, undoable)
        self._host.document.show(content, "side")

    def clicked(self, draft: Draft, u: float, v: float) -> Draft:
        """The draft with what was asked for at this place; a click where nothing is asked for changes nothing."""
        wish, self.problem = self.wish(draft), ""
        if wish is None or self._running() or not (0.0 <= u <= 1.0 and 0.0 <= v <= 1.0):
            return draft
        camera = self._sequence.scene.camera(wish.camera)
        point = ImagePoint(wish.frame, wish.camera, wish.arm, wish.landmark, (u * camera.width, v * camera.height))
        if self._wanted == wish:
            self._wanted = None
        kept = tuple(each for each in draft.points if _wish_of(each) != wish)
        self._progress = None
        return draft.uncalibrated(points=(*kept, point))

    def chosen(self, draft: Draft, name: str, value: str) -> Draft:
        """The draft after a choice in the panel; anything else changes nothing.

        Raises:
            SettingsError: the choice is not possible now.
        """
        self.problem = ""
        kind, _, which = name.partition(" ")
        wish = self.wish(draft)
        if name == "cancel" and self._job is not None:
            self._job.cancel()
            if self._running():
                self._progress = Progress("Stopping …", 1.0)
        if self._running():
            return draft
        if name == "skip" and wish is not None:
            self._skip({wish})
        elif name == "skip-frame" and wish is not None:
            self._skip_frame(draft, wish)
        elif kind == "look":
            self._look(wish or self._clicking.plan[-1], which, value)
        elif name == "calibrate":
            self._calibrate()
        else:
            return self._changed(draft, name, value)
        return draft

    def _changed(self, draft: Draft, name: str, value: str) -> Draft:
        """The draft after a choice that changes it."""
        if name == "focal_length":
            draft = draft.uncalibrated(focal_length=value == "1")
        elif name == "name":
            draft = replace(draft, name=value.strip())
        elif name == "keep" and draft.offered is not None:
            draft = replace(draft, calibration=draft.offered, offered=None)
        elif name == "discard" and draft.offered is not None:
            draft = draft.uncalibrated()
        elif name == "remove-point" and value.isdecimal() and int(value) < len(draft.points):
            row = int(value)
            self._wanted = _wish_of(draft.points[row])
            draft = draft.uncalibrated(points=(*draft.points[:row], *draft.points[row + 1 :]))
        return draft

    def write(self, draft: Draft) -> Path:
        """Write the sequence; gives its file.

        Raises:
            CartsError: it cannot be written.
        """
        if self._running():
            raise SettingsError("the calibration still runs. Stop it, or wait for it.")
        folder = target_folder(self._host.roots, Path(draft.source), draft.name)
        count = len(draft.points)
        if draft.calibration is not None:
            text = f"{count} points clicked in carts view, and a calibration over {FRAMES} frames"
            calibration = draft.calibration
        elif self._clicking.result is not None:
            text, calibration = f"{count} points clicked in carts view", as_plain(self._clicking.result.scene)
        else:
            return write_saved(self._recording, folder, draft.name)
        recording = calibrated_recording(self._recording, self._sequence.scene, calibration, text)
        return write_saved(recording, folder, draft.name)

    def _solve(self, draft: Draft) -> None:
        wanted = (draft.points, draft.focal_length)
        if self._solved != wanted:
            self._clicking.free_focal_length(draft.focal_length)
            self._clicking.solve(draft.points)
            self._solved = wanted

    def wish(self, draft: Draft) -> Wish | None:
        """What is to be clicked now; None if nothing is."""
        return self._wanted or self._clicking.next_wish(draft.points, self._skipped)

    def _skip(self, wishes: set[Wish]) -> None:
        self._skipped |= wishes
        self._wanted = None

    def _skip_frame(self, draft: Draft, wish: Wish) -> None:
        """Ask for the same in a frame that nothing is asked about yet, next to this one."""
        used = {(entry.camera, entry.frame) for entry in self._clicking.plan}
        used |= {(point.camera, point.frame) for point in draft.points}
        frames = range(len(self._sequence))
        free = [frame for frame in frames if (wish.camera, frame) not in used]
        if not free:
            raise SettingsError("there is no other frame. Use the list below, or leave out what is not visible.")
        other = min(free, key=lambda frame: abs(frame - wish.frame))
        self._clicking.move_frame(wish.camera, wish.frame, other)
        self._wanted = None

    def _look(self, at: Wish, which: str, value: str) -> None:
        """Ask for what a person has chosen."""
        names = {
            "camera": [camera.name for camera in self._sequence.scene.cameras],
            "frame": [str(index) for index in range(len(self._sequence))],
            "arm": [arm.name for arm in self._sequence.scene.arms],
            "landmark": self._clicking.names(at.arm),
        }
        if value in names.get(which, ()):
            wish = replace(at, **{which: int(value) if which == "frame" else value})
            known = self._clicking.names(wish.arm)
            self._wanted = wish if wish.landmark in known else replace(wish, landmark=known[0])

    def _running(self) -> bool:
        return self._progress is not None and not self._progress.ended

    def shown_scene(self, draft: Draft) -> Scene | None:
        """Arms and cameras as the overlay shows them; None without an overlay."""
        if self._running() and self._progress is not None and self._progress.scene is not None:
            return self._progress.scene
        if (calibration := draft.calibration or draft.offered) is not None:
            return calibrated_scene(self._sequence.scene, calibration)
        return None if self._clicking.result is None else self._clicking.result.scene

    def _calibrate(self) -> None:
        if self._clicking.result is None:
            raise SettingsError(self._clicking.problem or "Click points first.")
        self._progress = Progress("Beginning", 0.0)

        def report(progress: Progress) -> None:
            self._host.post(lambda: self._proceed(progress))

        self._job = CalibrationJob(
            self._sequence,
            self._clicking.result.scene,
            known=HandEyePrior(self._clicking.result.base_covariances, unknown_cameras(self._sequence.scene)),
            weights=self._host.weights,
            device=self._host.device,
            inference=self._host.inference,
            report=report,
        )

    def _proceed(self, progress: Progress) -> None:
        if self._job is not None and self._job.cancelled:
            if not progress.ended:
                return
            # It may have ended before it saw that it was stopped, and still not be wanted.
            progress = STOPPED if progress.result is not None else progress
        self._progress = progress
        self._report(lambda draft: draft if progress.result is None else self._calibrated(draft, progress.result))

    def _calibrated(self, draft: Draft, result: CalibrationResult) -> Draft:
        """The draft with a calibration that the points agree with, or with the offer of one that they speak against."""
        report = report_of(result, self._clicking, draft.points)
        if result.stop_reason in (StopReason.FAILED, StopReason.START_KEPT):
            text = f"The calibration from your points is as it was, with a loss of {report.loss_before:.4f}."
            verdict = f" {report.verdict.capitalize()}: {report.reason}" if report.verdict else ""
            self._progress = Progress("", 0.0, error=text + verdict, ended=True)
            return draft
        self._progress, found = None, as_plain(result.scene)
        draft = draft.uncalibrated(report=report)
        return replace(draft, offered=found) if report.objection else replace(draft, calibration=found)

    def _target(self, draft: Draft) -> str:
        try:
            return str(target_folder(self._host.roots, Path(draft.source), draft.name))
        except SettingsError as error:
            return str(error)


def _wish_of(point: ImagePoint) -> Wish:
    return Wish(point.camera, point.frame, point.arm, point.landmark)
