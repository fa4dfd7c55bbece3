"""Exports, downloads, and imported masks."""

import io
import json
import os
import threading
import time
import zipfile
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar

from carts_core.errors import CartsError, SettingsError
from carts_core.export import FORMATS, Dataset, ExportFrame, ExportProgress, Parts, export, mask_png, project_frame
from carts_core.files import OutputPath, file_name, output_path
from carts_core.model.camera import Camera
from carts_core.project import ProjectState, ReviewState, frames_in
from carts_core.project.masks import AnnotationEdits, annotation_edits, apply_annotations
from carts_core.project.state import calibrated_scene
from carts_core.project.values import UNREVIEWED
from carts_core.settings import Masks
from carts_core.wording import shown
from carts_viewer.actions import intents
from carts_viewer.actions.context import Context, Handler
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.jobs.solver import RefineTask
from carts_viewer.picture.layers import Layer
from carts_viewer.picture.strokes import Mask
from carts_viewer.state import ExportState

FRAME_CHOICES = {
    "All": frozenset(ReviewState),
    "All but rejected": frozenset(ReviewState) - {ReviewState.REJECTED},
    "Accepted": frozenset({ReviewState.ACCEPTED}),
    "Accepted or optimized": frozenset({ReviewState.ACCEPTED, ReviewState.OPTIMIZED}),
    "Needs work": frozenset({ReviewState.NEEDS_WORK}),
    "Unreviewed": UNREVIEWED,
}
"""Label -> review states of the exported frames."""
MASKS_CHOICES: tuple[Masks, ...] = ("auto", "refined", "rendered")
"""Choices of masks: refined if the verdict is good, refined, or as rendered."""
PARTS_CHOICES: tuple[Parts, ...] = ("arms", "parts", "links")
"""Choices of the granularity of categories."""
_STEMS = {
    "csv": "kinematics",
    "npz": "kinematics",
    "json": "kinematics",
    "dvrk": "base_frames",
    "dvrk-2.3": "base_frames",
    "dvrk-suj": "suj",
}
"""File names for formats whose name is not descriptive."""
_REPLY_INTERVAL = 0.005
"""Interval between checks for a reply of the solver [s]."""
_TIME_SLICE = 0.05
"""Time slice of an export [s]; longer steps are completed."""


Deliver = Callable[[int, str, bytes], None]
"""Function that sends a file to a tab; its arguments are client id, file name and content."""


class ExportingHandler(Handler):
    """Handler of exports."""

    def __init__(self, context: Context, optimizers: OptimizerFactory) -> None:
        super().__init__(context)
        self._optimizers = optimizers
        self._job: CooperativeThread[Path] | None = None
        self._intent: intents.Export | None = None

    def wait_time(self) -> float | None:
        """Time until the next step is due [s]: 0 during an export, otherwise None."""
        return None if self._job is None else 0.0

    def advance(self) -> None:
        """Continue the export for `_TIME_SLICE` seconds.

        Raises:
            CartsError: the export cannot be written; its files are removed.
        """
        if self._job is None or self._intent is None:
            return
        job, intent = self._job, self._intent
        try:
            path = job.advance(_TIME_SLICE)
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
        """Cancel the running export and remove its files."""
        if self._job is not None:
            job, self._job = self._job, None
            job.cancel()
            self._context.change(export=None)

    # ---- Intents ---------------------------------------------------------------------------------------------------

    def _on_Export(self, intent: intents.Export) -> None:
        if self._job is not None:
            raise CartsError("An export is already running. Wait, or cancel it first.")
        known = intent.format in FORMATS and intent.frames in FRAME_CHOICES and intent.parts in PARTS_CHOICES
        if not known or intent.masks not in MASKS_CHOICES:
            wanted = ", ".join(map(shown, (intent.format, intent.frames, intent.parts, intent.masks)))
            raise SettingsError(f"Unsupported export (format, frames, categories, masks): {wanted}.")
        self._context.end_run("Stopped: an export was started")
        self._context.save()
        make, count = self._dataset(intent)
        target = free_path(self._session.editor.project.path, _STEMS.get(intent.format, intent.format), intent)
        self._intent = intent
        self._job = CooperativeThread(lambda progress: export(make(progress), intent.format, target, progress=progress))
        self._context.change(export=ExportState(FORMATS[intent.format].label, count), error=None)

    def _on_CancelExport(self, intent: intents.CancelExport) -> None:
        self.cancel()

    # ---- The export ------------------------------------------------------------------------------------------------

    def _dataset(self, intent: intents.Export) -> tuple[Callable[[ExportProgress], Dataset], int]:
        """A function that builds the dataset from the current project, and the number of its frames."""
        state, session = self._context.state, self._session
        view = session.editor.view
        chosen = frames_within(view, intent.frames, intent.range)
        if not chosen:
            where = "" if intent.range is None else ", in the timeline's range"
            raise SettingsError(
                f"No frames to export ({intent.frames.lower()}{where}). Review frames, or choose other frames."
            )
        cameras = [state.camera] if intent.shown_camera else [camera.name for camera in session.scene.cameras]
        scene = calibrated_scene(session.scene, view).with_cameras(cameras)
        renderer, sequence, images = self._context.renderer, session.sequence, "copied" if intent.images else "named"

        def make(progress: ExportProgress) -> Dataset:
            def refine(dataset: Dataset, frame: ExportFrame, camera: Camera, rendered: Mask) -> Mask:
                masks, scene = {camera.name: rendered}, tuple(one.name for one in dataset.scene.cameras)
                place = dataset.sequence, frame.index, dataset.domain, scene, dataset.state(frame)
                reply = self._optimizers.refine(RefineTask(*place, masks, frame.ignored))
                while not reply.done:
                    reply.wait(_REPLY_INTERVAL)
                    progress.pause()
                return reply.result()[camera.name]

            indices = ExportProgress(cancelled=progress.cancelled).track(chosen)
            frames = tuple(project_frame(sequence, view, index, cameras, renderer.mask) for index in indices)
            return Dataset(
                sequence,
                frames,
                scene,
                state.domain,
                parts=intent.parts,
                images=images,
                masks=intent.masks,
                refine=refine,
            )

        return make, len(chosen)

    def _log(self, intent: intents.Export, path: Path) -> None:
        project, export_state = self._session.editor.project, self._context.state.export
        if project.writable and export_state is not None:
            settings = {"frames": intent.frames, "parts": intent.parts, "images": intent.images, "masks": intent.masks}
            if intent.range is not None:
                settings["range"] = list(intent.range)
            project.log_export(intent.format, path, export_state.frames, settings)
            self._context.change(project=self._session.editor.view)

    def _report(self, **changes: object) -> None:
        if self._context.state.export is not None:
            self._context.change(export=replace(self._context.state.export, **changes))


def frames_within(project: ProjectState, frames: str, part: tuple[int, int] | None) -> list[int]:
    """Indices of the frames of a choice (`FRAME_CHOICES`) in the inclusive range `part`, by default in all frames."""
    first, last = part or (0, len(project.identity.frame_ids) - 1)
    return [index for index in frames_in(project, FRAME_CHOICES[frames]) if first <= index <= last]


def shown_mask(context: Context) -> tuple[str, bytes]:
    """Name and content of a PNG file with the mask of the shown frame and camera. The mask is refined if the layer
    *Refined mask* is shown and the mask was not painted."""
    state, sequence = context.state, context.session.sequence
    name = file_name(f"{sequence.name}_{state.frame.frame_id}_{state.camera}") + ".png"
    mask = context.renderer.mask(state.pose.scene, state.camera, state.mask_correction)
    refined = state.refined_mask(state.pose.scene, state.camera)
    if state.layer is Layer.REFINED and refined is not None and state.mask_correction is None:
        mask = refined
    painted = state.part_labels_of(state.camera)
    if painted is not None:
        mask = mask | (painted.labels() > 0)
    return name, mask_png(mask)


def free_path(project: Path, stem: str, intent: intents.Export) -> OutputPath:
    """Path of a new export, in a folder beside the project."""
    folder, suffix = output_path(project.parent, f"{project.stem}_exports"), FORMATS[intent.format].suffix
    number, path = 1, folder / f"{stem}{suffix}"
    while os.path.lexists(path):
        number += 1
        path = folder / f"{stem}-{number}{suffix}"
    return path


MAX_DOWNLOAD = 512 * 2**20
"""Maximum size of a download [bytes]."""
_COMPRESSED = {".png", ".jpg", ".mp4", ".npz"}


def _files_to_send(path: Path) -> list[Path]:
    """Files of a download.

    Raises:
        CartsError: the export no longer exists, or is too large for a browser.
    """
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    if not files:
        raise CartsError(f"{path} no longer exists. Export again.")
    size = sum(file.stat().st_size for file in files)
    if size > MAX_DOWNLOAD:
        raise CartsError(
            f"{path} has {size / 2**20:.0f} MiB; the limit for downloads is {MAX_DOWNLOAD // 2**20} MiB. "
            "Copy it from that path."
        )
    return files


def _zipped(path: Path, files: Sequence[Path]) -> tuple[str, bytes]:
    """Name and content of a download: a file unchanged, a folder as a zip archive."""
    if path.is_file():
        return path.name, path.read_bytes()
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files:
            kind = zipfile.ZIP_STORED if file.suffix in _COMPRESSED else zipfile.ZIP_DEFLATED
            archive.write(file, Path(path.name) / file.relative_to(path), kind)
    return f"{path.name}.zip", content.getvalue()


_MAX_NAMED = 6
"""Maximum number of frames named in a warning."""


def export_warnings(project: ProjectState, frames: Sequence[int], cameras: Collection[str]) -> list[str]:
    """Warnings about an export, for frame indices and exported cameras."""
    found: list[str] = []
    # A recording of one hour has 100,000 frames, but few of them have a record.
    recorded = [index for index in frames if index in project.records]
    accepted = sum(project.review(index).state is ReviewState.ACCEPTED for index in recorded)
    open_ones = len(frames) - accepted
    if open_ones:
        found.append(f"{open_ones} of {len(frames)} frames {'is' if open_ones == 1 else 'are'} not accepted")
    for verdict in ("failed", "doubtful"):
        those = [i for i in recorded if (known := project.verdict(i)) is not None and known.verdict == verdict]
        have = "has" if len(those) == 1 else "have"
        found += _line(project, those, f"of the exported frames {have} the verdict {verdict}")
    partly = [i for i in recorded if not _seen_by_all(project, i, cameras)]
    were = "was" if len(partly) == 1 else "were"
    return found + _line(project, partly, f"of the exported frames {were} fitted to only some of the exported cameras")


def _seen_by_all(project: ProjectState, frame: int, cameras: Collection[str]) -> bool:
    """Whether all exported cameras were used to fit a frame; True if unknown."""
    used = [_cameras(correction.provenance.settings) for correction in project.joints(frame).values()]
    return all(names is None or set(cameras) <= names for names in used)


@lru_cache(maxsize=256)
def _cameras(settings: str | None) -> frozenset[str] | None:
    """Cameras in the settings of an optimizer; None if they are not recorded."""
    names = json.loads(settings).get("cameras") if settings else None
    return None if names is None else frozenset(map(str, names))


def _line(project: ProjectState, frames: Sequence[int], text: str) -> list[str]:
    if not frames:
        return []
    named = ", ".join(project.identity.frame_ids[index] for index in frames[:_MAX_NAMED])
    more = " …" if len(frames) > _MAX_NAMED else ""
    return [f"{len(frames)} {text}: {named}{more}"]


T = TypeVar("T")


class CooperativeThread(Generic[T]):
    """Runs a function that checks an `ExportProgress` between its steps.

    The function has a thread of its own, but runs only while `advance` waits for it, so shared data need no lock.

    Attributes:
        done: number of completed steps.
        total: number of all steps; 0 until the first is done.
    """

    def __init__(self, function: Callable[[ExportProgress], T]) -> None:
        self.done, self.total = 0, 0
        self._function = function
        self._go, self._back = threading.Semaphore(0), threading.Semaphore(0)
        self._pause_at = 0.0
        self._cancelled = False
        self._result: T | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="carts-export", daemon=True)

    def advance(self, seconds: float) -> T | None:
        """Continue for about `seconds`; returns the function's result once it has ended.

        Raises:
            Exception: the exception raised by the function.
        """
        if self._thread.ident is None:
            self._thread.start()
        self._pause_at = time.monotonic() + seconds
        self._go.release()
        self._back.acquire()
        if self._error is not None:
            raise self._error
        return self._result

    def cancel(self) -> None:
        """Stop the function, and wait until it has cleaned up."""
        self._cancelled = True
        if self._thread.is_alive():
            self._go.release()
            self._thread.join()

    def _work(self) -> None:
        self._go.acquire()
        try:
            self._result = self._function(ExportProgress(self._report, self._stop))
        except BaseException as error:
            self._error = error
        finally:
            self._back.release()

    def _report(self, done: int, total: int) -> None:
        self.done, self.total = done, total

    def _stop(self) -> bool:
        if not self._cancelled and time.monotonic() >= self._pause_at:
            self._back.release()
            self._go.acquire()
        return self._cancelled


_MAX_PATH_LENGTH = 4096


_WAIT = 0.02
"""Maximum wait for a thread, during which intents are delayed [s]."""


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(4, thread_name_prefix="carts-transfer")


class TransferHandler(Handler):
    """Handler of downloads and of imported masks and keypoints, whose files are read on other threads."""

    def __init__(self, context: Context, deliver: Deliver) -> None:
        super().__init__(context)
        self._deliver = deliver
        self._running: dict[Future[Any], Callable[[Future[Any]], None]] = {}
        """Function that uses the result, by running thread."""
        self._import: Future[AnnotationEdits] | None = None
        self._cancelled = threading.Event()
        self._read = 0
        """Number of images that the import has read."""

    def wait_time(self) -> float | None:
        """Time until the next step is due [s]: 0 while a thread runs, otherwise None."""
        return 0.0 if self._running else None

    def advance(self) -> None:
        """Wait up to `_WAIT` for the threads, and use their results.

        Raises:
            CartsError: the files cannot be read, or the import is refused; the project is unchanged.
        """
        if not self._running:
            return
        ended = wait(self._running, _WAIT, FIRST_COMPLETED).done
        if self._context.state.importing not in (None, self._read):
            self._context.change(importing=self._read)
        for thread in ended:
            self._running.pop(thread)(thread)

    def cancel(self) -> None:
        """Cancel the running import, which leaves the project unchanged."""
        self._cancelled.set()
        if self._import is not None:
            self._running.pop(self._import, None)
        self._context.change(importing=None)

    # ---- Intents ---------------------------------------------------------------------------------------------------

    def _on_Download(self, intent: intents.Download) -> None:
        export_state = self._context.state.export
        if export_state is None or export_state.path is None:
            raise CartsError("Nothing has been exported yet.")
        thread = _threads().submit(_zipped, export_state.path, _files_to_send(export_state.path))
        self._running[thread] = lambda packed: self._deliver(intent.client_id, *packed.result())

    def _on_ImportMasks(self, intent: intents.ImportMasks) -> None:
        if self._context.state.importing is not None:
            raise CartsError("An import is already running. Wait, or cancel it first.")
        session = self._session
        given = intent.path.strip()[:_MAX_PATH_LENGTH]
        if not given:
            raise CartsError("Enter the path of the masks: an annotation file, or a folder of masks or labels.")
        path = session.roots.checked(session.sequence.path.parent.absolute() / os.path.expanduser(given))
        sequence, state = session.sequence, session.editor.project.state
        self._read, self._cancelled = 0, threading.Event()

        def read(cancelled: threading.Event = self._cancelled) -> AnnotationEdits:
            from carts_core.recording.annotations import read_annotations  # noqa: PLC0415  imports all importers

            found = read_annotations(path, sequence, intent.camera, format=intent.format, confined=True)
            return annotation_edits(state, replace(found, frames=self._counted(found.frames, cancelled)))

        self._import = _threads().submit(read)
        self._running[self._import] = lambda found: self._apply(found, path.name, replace=intent.replace)
        self._context.change(importing=0, error=None, notice=None)

    def _on_CancelImport(self, intent: intents.CancelImport) -> None:
        if self._context.state.importing is not None:
            self.cancel()
            self._context.change(notice="Import cancelled; the project is unchanged.")

    def _counted(self, frames: Iterator[T], cancelled: threading.Event) -> Iterator[T]:
        for frame in frames:
            if cancelled.is_set():
                raise CartsError("Cancelled.")
            self._read += 1
            yield frame

    def _apply(self, found: Future[AnnotationEdits], source: str, *, replace: bool) -> None:
        """Apply an import that was read."""
        self._context.change(importing=None)
        read, session = found.result(), self._session
        self._context.end_run("Stopped: masks were imported")
        self._context.save()
        report = apply_annotations(session.editor.project, read, source=source, replace=replace)
        if report.changed:
            session.editor.claim()
        self._context.refresh()
        self._context.change(layer=Layer.IMPORTED, imported=report.sentence(), error=None)
