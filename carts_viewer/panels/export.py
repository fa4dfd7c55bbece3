"""Taking files away."""

import viser

from carts_viewer import intents as ask
from carts_viewer.page import Page
from carts_viewer.panels.inputs import Emit, on_click
from carts_viewer.session import Session
from carts_viewer.state import ViewState


class ExportPanel:
    """The mask of this frame, or everything as one zip, with progress and a way to stop it."""

    def __init__(self, page: Page, session: Session, emit: Emit) -> None:
        gui = page.server.gui
        cameras = len(session.scene.cameras)
        gui.add_markdown("**This frame**: the mask of the shown camera, as PNG (255 = arm, 0 = background).")
        mask = gui.add_button("Export mask", icon=viser.Icon.PHOTO_DOWN)
        gui.add_markdown(
            f"**All {len(session.sequence)} frames**: a zip with the masks of "
            f"{'all cameras' if cameras > 1 else 'every frame'} and `kinematics.csv`. Frames that you optimized or "
            "edited are written as corrected, the others as measured; column `source` says which."
        )
        self._all = gui.add_button("Export all", icon=viser.Icon.FILE_ZIP)
        self._progress = gui.add_progress_bar(0.0, visible=False)
        self._cancel = gui.add_button("Cancel export", icon=viser.Icon.X, color="gray", visible=False)
        on_click(mask, ask.ExportMask, emit)
        on_click(self._all, ask.ExportAll, emit)
        on_click(self._cancel, lambda _: ask.CancelExport(), emit)

    def show(self, state: ViewState) -> None:
        """Bring the widgets up to date."""
        export = state.export
        self._all.disabled = export is not None
        self._progress.visible = self._cancel.visible = export is not None
        if export is not None:
            self._progress.value = 100.0 * export.done / max(export.total, 1)
