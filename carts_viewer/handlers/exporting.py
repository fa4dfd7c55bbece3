"""What intents about files do: the shown mask as a download, and frames in any format into the project's folder."""

import os
from collections.abc import Callable
from dataclasses import replace
from functools import singledispatchmethod
from pathlib import Path

from carts_core.errors import CartsError, SettingsError
from carts_core.export import FORMATS, Dataset, Monitor, Parts, export, mask_png, project_frame
from carts_core.files import OutputPath, file_name, output_path
from carts_core.project import ProjectState, ReviewState, frames_in
from carts_core.project.calibrated import calibrated_scene
from carts_core.project.values import UNREVIEWED
from carts_viewer import intents
from carts_viewer.archive import zipped
from carts_viewer.checks import unknown
from carts_viewer.context import Context, OpenRun
from carts_viewer.state import ExportState
from carts_viewer.stepping import Stepped

FRAME_CHOICES = {
    "All": frozenset(ReviewState),
    "All but rejected": frozenset(ReviewState) - {ReviewState.REJECTED},
    "Accepted": frozenset({ReviewState.ACCEPTED}),
    "Accepted or optimized": frozenset({ReviewState.ACCEPTED, ReviewState.OPTIMIZED}),
    "Needs work": frozenset({ReviewState.NEEDS_WORK}),
    "Unreviewed": UNREVIEWED,
}
"""What people can choose: review states of the frames that are exported."""
PARTS_CHOICES: tuple[Parts, ...] = ("arms", "parts", "links")
"""What may get a category of its own."""
_STEMS = {
    "csv": "kinematics",
    "npz": "kinematics",
    "json": "kinematics",
    "dvrk": "base_frames",
    "dvrk-2.3": "base_frames",
    "dvrk-suj": "suj",
}
"""How a file is called where the format's own name would say nothing."""
_BIT = 0.05
"""How long the page waits for an export at a time [s]; a step that takes longer is finished."""


Deliver = Callable[[int, str, bytes], None]
"""Sends a file to a tab: client id, file name, content."""


class ExportingHandler:
    """The handler that makes files."""

    def __init__(self, context: Context, run: OpenRun, deliver: Deliver) -> None:
        self._context = context
        self._open_run = run
        self._deliver = deliver
        self._session = context.session
        self._job: Stepped[Path] | None = None
        self._intent: intents.Export | None = None

    @singledispatchmethod
    def handle(self, intent: intents.Exporting) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        raise unknown(intent)

    def wait_time(self) -> float | None:
        """0 while there is something to write; None when there is not."""
        return None if self._job is None else 0.0

    def advance(self) -> None:
        """Write on for a moment, if there is something to write.

        Raises:
            CartsError: it cannot be written; nothing of it is left.
        """
        if self._job is None or self._intent is None:
            return
        job, intent = self._job, self._intent
        try:
            path = job.advance(_BIT)
        except Exception as error:
            self.cancel()
            if not isinstance(error, ImportError):
                raise
            raise CartsError(
                f"{FORMATS[intent.format].label} needs the package {error.name}, which is not installed. "
                f"Install it (pip install {error.name}), then export again."
            ) from error
        self._report(done=job.done, total=job.total)
        if path is not None:
            self._job = None
            self._report(path=path)
            self._log(intent, path)

    def cancel(self) -> None:
        """Stop the export that is going on, if there is one; nothing of it is left."""
        if self._job is not None:
            job, self._job = self._job, None
            job.cancel()
            self._context.change(export=None)

    # ---- Intents ---------------------------------------------------------------------------------------------------

    @handle.register
    def _(self, intent: intents.Export) -> None:
        if self._job is not None:
            raise CartsError("Something is being exported already. Wait, or cancel that first.")
        if intent.format not in FORMATS or intent.frames not in FRAME_CHOICES or intent.parts not in PARTS_CHOICES:
            raise SettingsError(f"There is no export of {intent.frames!r} as {intent.format!r} by {intent.parts!r}.")
        self._open_run.end("Stopped: frames are exported")
        self._context.save()
        make, count = self._dataset(intent)
        target = free_path(self._session.editor.project.path, _STEMS.get(intent.format, intent.format), intent)
        self._intent = intent
        self._job = Stepped(lambda monitor: export(make(monitor), intent.format, target, monitor=monitor))
        self._context.change(export=ExportState(FORMATS[intent.format].label, count), error=None)

    @handle.register
    def _(self, intent: intents.CancelExport) -> None:
        self.cancel()

    @handle.register
    def _(self, intent: intents.Download) -> None:
        export_state = self._context.state.export
        if export_state is None or export_state.path is None:
            raise CartsError("Nothing has been exported yet.")
        self._deliver(intent.client_id, *zipped(export_state.path))

    # ---- The export ------------------------------------------------------------------------------------------------

    def _dataset(self, intent: intents.Export) -> tuple[Callable[[Monitor], Dataset], int]:
        """What makes the dataset as the project is now, frame by frame, and how many frames it will have."""
        state, session = self._context.state, self._session
        view = session.editor.view
        chosen = frames_within(view, intent.frames, intent.range)
        if not chosen:
            where = "" if intent.range is None else ", in the timeline's range"
            raise SettingsError(
                f"No frame is in this choice ({intent.frames.lower()}{where}). Review frames, or choose others."
            )
        cameras = [state.camera] if intent.shown_camera else [camera.name for camera in session.scene.cameras]
        scene = calibrated_scene(session.scene, view).with_cameras(cameras)
        renderer, sequence, images = self._context.renderer, session.sequence, "copied" if intent.images else "named"

        def make(monitor: Monitor) -> Dataset:
            indices = Monitor(cancelled=monitor.cancelled).track(chosen)
            frames = tuple(project_frame(sequence, view, index, cameras, renderer.mask) for index in indices)
            return Dataset(sequence, frames, scene, state.domain, parts=intent.parts, images=images)

        return make, len(chosen)

    def _log(self, intent: intents.Export, path: Path) -> None:
        project, export_state = self._session.editor.project, self._context.state.export
        if project.writable and export_state is not None:
            settings = {"frames": intent.frames, "parts": intent.parts, "images": intent.images}
            if intent.range is not None:
                settings["range"] = list(intent.range)
            project.log_export(intent.format, path, export_state.frames, settings)
            self._context.change(project=self._session.editor.view)

    def _report(self, **changes: object) -> None:
        if self._context.state.export is not None:
            self._context.change(export=replace(self._context.state.export, **changes))


def frames_within(project: ProjectState, frames: str, part: tuple[int, int] | None) -> list[int]:
    """Indices of the frames of one of `FRAME_CHOICES`, of a range with both its ends or of the whole sequence."""
    first, last = part or (0, len(project.identity.frame_ids) - 1)
    return [index for index in frames_in(project, FRAME_CHOICES[frames]) if first <= index <= last]


def shown_mask(context: Context) -> tuple[str, bytes]:
    """The mask of the shown frame and camera as it was corrected: name and content of a PNG file."""
    state, sequence = context.state, context.session.sequence
    name = file_name(f"{sequence.name}_{state.frame.frame_id}_{state.camera}") + ".png"
    mask = context.renderer.mask(state.pose.scene, state.camera, state.mask_correction)
    painted = state.part_labels_of(state.camera)
    if painted is not None:
        mask = mask | (painted.labels() > 0)
    return name, mask_png(mask)


def free_path(project: Path, stem: str, intent: intents.Export) -> OutputPath:
    """Where an export goes: into a folder beside the project, under a name that nothing has yet."""
    folder, suffix = output_path(project.parent, f"{project.stem}_exports"), FORMATS[intent.format].suffix
    number, path = 1, folder / f"{stem}{suffix}"
    while os.path.lexists(path):
        number += 1
        path = folder / f"{stem}-{number}{suffix}"
    return path
