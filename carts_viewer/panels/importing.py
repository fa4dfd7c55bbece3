"""Bringing in masks and keypoints of others: where they are, whose they are, and what came of it."""

import viser

from carts_core.project import Key
from carts_viewer import intents
from carts_viewer.panels.inputs import Emit, escaped, on_click
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.transport.tab_page import TabPage

_BY_NAME = "By name"
_HINT = "Path in the recording's folder: a COCO (.json) or CVAT (.xml) file, keypoints of SurgPose, or a folder of PNGs"


class ImportPanel:
    """A path, a camera, a button, and what was imported last."""

    def __init__(self, page: TabPage, session: Session, emit: Emit) -> None:
        gui = page.gui
        cameras = [camera.name for camera in session.scene.cameras]
        with gui.add_folder("Masks of others", expand_by_default=False):
            self._place = gui.add_text("From", "", hint=_HINT)
            self._camera = gui.add_dropdown(
                "Camera", [_BY_NAME, *cameras], visible=len(cameras) > 1, hint="Whose images the masks are of"
            )
            self._replace = gui.add_checkbox("Replace", False, hint="Replace what was imported before")
            self._import = gui.add_button("Import masks", icon=viser.Icon.FILE_IMPORT, color="gray")
            self._text = gui.add_html("")
        on_click(self._import, lambda _: self._intent(), emit)

    def _intent(self) -> intents.ImportMasks:
        camera = None if self._camera.value == _BY_NAME else self._camera.value
        return intents.ImportMasks(str(self._place.value), camera, bool(self._replace.value))

    def show(self, state: ViewState) -> None:
        """Bring the text up to date."""
        there = state.project.get(Key.imported_labels()) is not None
        content = "Nothing was imported yet."
        if there:
            content = escaped(state.imported) or "What was imported is the layer <i>Imported masks</i>."
        if self._text.content != (wanted := f'<p class="carts-caption">{content}</p>'):
            self._text.content = wanted
