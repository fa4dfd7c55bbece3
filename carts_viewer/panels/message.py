"""What went wrong, where everybody sees it: a box in the panel and a note over the picture."""

import viser

from carts_viewer import intents
from carts_viewer.panels.inputs import Emit, escaped, on_click
from carts_viewer.state import ViewState
from carts_viewer.transport.tab_page import TabPage


class MessagePanel:
    """The newest error, until it is dismissed or something else works."""

    def __init__(self, page: TabPage, emit: Emit) -> None:
        self._page = page
        self._shown: str | None = None
        self._notes: list[viser.NotificationHandle] = []
        self._text = page.gui.add_html("", visible=False)
        self._dismiss = page.gui.add_button("Dismiss", icon=viser.Icon.X, color="red", visible=False)
        on_click(self._dismiss, lambda _: intents.DismissError(), emit)

    def show(self, state: ViewState) -> None:
        """Bring the message up to date."""
        if state.error == self._shown:
            return
        self._shown = state.error
        while self._notes:
            self._notes.pop().remove()
        self._text.visible = self._dismiss.visible = state.error is not None
        self._text.content = f'<p class="carts-error" role="alert">{escaped(state.error or "")}</p>'
        if state.error is not None:
            note = self._page.client.add_notification(
                "That did not work", state.error, color="red", auto_close_seconds=12.0
            )
            self._notes = [note]
