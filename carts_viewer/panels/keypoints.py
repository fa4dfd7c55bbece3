"""Saying where points of the arm are in the image: which one, and how far off it still is."""

import viser

from carts_viewer import intents
from carts_viewer.marks import labelled_keypoints
from carts_viewer.panels.inputs import Emit, escaped, on_click, on_input, write
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.transport.tab_page import TabPage

_NEAREST = "Nearest to the pointer"


class KeypointsPanel:
    """The keypoint to place by a click or a drag, and the residuals of those that were placed."""

    def __init__(self, page: TabPage, session: Session, emit: Emit) -> None:
        gui = page.gui
        self._labels = {point: label for label, point in labelled_keypoints(session.scene).items()}
        with gui.add_folder("Keypoints"):
            gui.add_html(
                '<p class="carts-caption"><b>Shift+click</b> on the picture: the chosen keypoint is there. '
                "<b>Shift+drag</b> takes it along. The arm follows at once; a run starts there, and the clicks do not "
                "pull on it.</p>"
            )
            options = [_NEAREST, *self._labels.values()]
            self._chosen = gui.add_dropdown("Keypoint", options)
            self._shown = gui.add_checkbox("Show keypoints", False)
            self._residuals = gui.add_html("")
            self._forget = gui.add_button("Forget the clicks", icon=viser.Icon.X, color="gray", visible=False)
        on_input(self._chosen, lambda label: intents.ChooseKeypoint(None if label == _NEAREST else label), emit)
        on_input(self._shown, lambda on: intents.ShowKeypoints(bool(on)), emit)
        on_click(self._forget, lambda _: intents.ForgetPins(), emit)

    def show(self, state: ViewState) -> None:
        """Bring the widgets up to date."""
        keypoints = state.keypoints
        write(self._chosen, keypoints.chosen or _NEAREST)
        write(self._shown, keypoints.shown)
        self._forget.visible = bool(keypoints.pins)
        rows = [
            f"<tr><td>{escaped(self._labels[pin.keypoint])} <small>({escaped(pin.camera)})</small></td>"
            f"<td>{residual:.1f} px off</td></tr>"
            for pin, residual in zip(keypoints.pins, keypoints.residuals, strict=True)
        ]
        self._residuals.content = f'<table class="carts-values">{"".join(rows)}</table>'
