"""Panels of exports and of imported masks."""

import viser

from carts_core.export import FORMATS, FormatName, formats_of
from carts_core.project import Key, ProjectState, ReviewState
from carts_core.settings import ANNOTATION_FORMATS, AnnotationFormat
from carts_core.wording import counted
from carts_viewer.actions import intents
from carts_viewer.actions.import_export import FRAME_CHOICES, export_warnings, frames_within
from carts_viewer.panels.inputs import PanelPage
from carts_viewer.session import Session, Storage
from carts_viewer.state import ViewState
from carts_viewer.transport.document import escaped

_PARTS = {"Arm": "arms", "Part": "parts", "Link": "links"}
_MASKS = {"Refined if good": "auto", "Refined": "refined", "As rendered": "rendered"}
_WRITTEN = "Masks of the shown arms with painted corrections, not the recording's own masks."
_NOT_KEPT = "This project is temporary: download its exports before you close the viewer."


class ExportPanel:
    """Exports frames in any format, with progress, and the shown frame's mask."""

    def __init__(self, page: PanelPage, session: Session, storage: Storage) -> None:
        gui = page.gui
        cameras = len(session.scene.cameras)
        self._camera_names = [camera.name for camera in session.scene.cameras]
        self._kept = storage.scratch is None
        self._formats: dict[str, FormatName] = {
            known.label: name for name, known in formats_of(session.sequence).items()
        }
        self._counted: ProjectState | None = None
        self._chosen = ""
        self._range: tuple[int, int] | None = None
        with gui.add_folder("Export frames"):
            gui.add_html(f'<p class="carts-caption">{_WRITTEN}</p>')
            self._format = gui.add_dropdown("Format", list(self._formats))
            self._frames = gui.add_dropdown("Frames", list(FRAME_CHOICES))
            self._within = gui.add_checkbox("Only the range", True, visible=False)
            self._cameras = gui.add_dropdown("Cameras", ["All", "Shown camera"], visible=cameras > 1)
            self._parts = gui.add_dropdown("Category per", list(_PARTS))
            self._masks = gui.add_dropdown(
                "Masks",
                list(_MASKS),
                hint="Refined: corrected near the outline by the network. Refined if good: only if the verdict is good",
            )
            self._images = gui.add_checkbox("Copy images", False)
            self._count = gui.add_html("")
            self._export = page.button("Export", lambda _: self._intent(), icon=viser.Icon.FILE_EXPORT, color="teal")
            self._progress = gui.add_progress_bar(0.0, visible=False)
            self._cancel = page.button("Cancel export", intents.CancelExport(), icon=viser.Icon.X, visible=False)
            self._result = gui.add_html("", visible=False)
            self._download = page.button("Download", intents.Download, icon=viser.Icon.DOWNLOAD, visible=False)
        with gui.add_folder("This frame"):
            page.button("Export mask", intents.ExportMask, icon=viser.Icon.PHOTO_DOWN)
        for widget in (self._format, self._frames, self._within, self._cameras):
            page.on_input(widget, lambda _: intents.Refresh())

    def show(self, state: ViewState) -> None:
        """Update the widgets."""
        name = self._formats.get(self._format.value)
        self._parts.visible = name is not None and FORMATS[name].categories
        self._masks.visible = name is not None and FORMATS[name].refines
        self._images.visible = name is not None and (
            FORMATS[name].images or name == "masks" or bool(FORMATS[name].source)
        )
        self._within.visible = state.range is not None
        self._range = state.range if self._within.value else None
        self._show_count(state)
        export = state.export
        running = export is not None and export.path is None
        self._export.disabled = running
        self._progress.visible = self._cancel.visible = running
        self._result.visible = export is not None
        self._download.visible = export is not None and not running
        if export is None:
            return
        if export.path is None:
            self._progress.value = 100.0 * export.done / max(export.total, 1)
            text = f"{escaped(export.format)}: {export.done} of {export.total or '…'}"
        else:
            where = f"<code>{escaped(str(export.path))}</code>"
            text = f"<b>{export.frames} frames</b> as {escaped(export.format)} in<br>{where}"
            text += "" if self._kept else f"<br>{_NOT_KEPT}"
        self._result.content = f'<p class="carts-caption" role="status">{text}</p>'

    def _intent(self) -> intents.Export:
        """The export with the options of the widgets, which the controller checks."""
        return intents.Export(
            self._formats.get(self._format.value, self._format.value),  # type: ignore[arg-type]
            self._frames.value,
            _PARTS.get(self._parts.value, self._parts.value),  # type: ignore[arg-type]
            bool(self._images.value),
            self._cameras.value == "Shown camera",
            self._range,
            _MASKS.get(self._masks.value, self._masks.value),  # type: ignore[arg-type]
        )

    def _show_count(self, state: ViewState) -> None:
        chosen = f"{self._frames.value} {self._cameras.value} {state.camera} {self._range}"
        if state.unsaved or (state.project is self._counted and chosen == self._chosen):
            return
        self._counted, self._chosen = state.project, chosen
        known = self._frames.value in FRAME_CHOICES
        frames = frames_within(state.project, self._frames.value, self._range) if known else []
        cameras = [state.camera] if self._cameras.value == "Shown camera" else self._camera_names
        warnings = export_warnings(state.project, frames, cameras)
        outside = set(frames_within(state.project, self._frames.value, None)) - set(frames) if known else ()
        accepted = sum(state.project.review(index).state is ReviewState.ACCEPTED for index in outside)
        if accepted:
            names = "frame outside of the range is" if accepted == 1 else "frames outside of the range are"
            warnings.append(f"{accepted} accepted {names} not exported")
        notes = "".join(f"<br>⚠ {escaped(line)}" for line in warnings)
        total = len(state.project.identity.frame_ids)
        self._count.content = f'<p class="carts-caption"><b>{len(frames)}</b> of {total} frames{notes}</p>'


_BY_NAME = "By name"
_HINT = (
    "A file of COCO, LabelMe or Label Studio (.json), CVAT (.xml) or SurgPose, or a "
    "folder of LabelMe files, YOLO labels or mask images"
)
_BY_CONTENT = "By content"
_FORMATS: dict[str, AnnotationFormat | None] = {
    _BY_CONTENT: None,
    **{name[0].upper() + name[1:]: format for format, name in ANNOTATION_FORMATS.items()},
}
"""Choices of the format of imported annotations."""


class ImportPanel:
    """Import of masks: path, camera, and the last result."""

    def __init__(self, page: PanelPage, session: Session) -> None:
        gui = page.gui
        cameras = [camera.name for camera in session.scene.cameras]
        folder = escaped(str(session.sequence.path.parent.absolute()))
        with gui.add_folder("Import", expand_by_default=False):
            gui.add_html(f'<p class="carts-caption">A path relative to <code>{folder}</code>, or an absolute path.</p>')
            self._path = gui.add_text("From", "", hint=_HINT)
            self._camera = gui.add_dropdown(
                "Camera", [_BY_NAME, *cameras], visible=len(cameras) > 1, hint="Camera whose images were annotated"
            )
            self._format = gui.add_dropdown("Source format", [*_FORMATS], hint="Format of the annotations")
            self._replace = gui.add_checkbox("Replace", False, hint="Replace earlier imports")
            self._import = page.button("Import masks", lambda _: self._intent(), icon=viser.Icon.FILE_IMPORT)
            self._cancel = page.button("Cancel import", intents.CancelImport(), icon=viser.Icon.X, visible=False)
            self._text = gui.add_html("")

    def _intent(self) -> intents.ImportMasks:
        camera = None if self._camera.value == _BY_NAME else self._camera.value
        chosen = _FORMATS.get(str(self._format.value))
        return intents.ImportMasks(str(self._path.value), camera, chosen, bool(self._replace.value))

    def show(self, state: ViewState) -> None:
        """Update the text."""
        there = state.project.get(Key.imported_labels()) is not None
        content = "Nothing has been imported yet."
        self._import.disabled = self._cancel.visible = state.importing is not None
        if state.importing is not None:
            content = f"Importing: {counted(state.importing, 'image')} read."
        elif there:
            content = escaped(state.imported) or "The layer <i>Imported masks</i> shows the imports."
        if self._text.content != (wanted := f'<p class="carts-caption">{content}</p>'):
            self._text.content = wanted
