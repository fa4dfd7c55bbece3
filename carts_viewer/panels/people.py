"""Who else is at work, under which name, and the link that leads here."""

import viser

from carts_viewer import intents
from carts_viewer.panels.inputs import Emit, Waits, escaped, on_input, write
from carts_viewer.people import LONGEST_NAME
from carts_viewer.state import ViewState
from carts_viewer.transport.tab_page import TabPage


class PeoplePanel:
    """One's own name, everybody else with the frame that they are on, and a button that copies the link."""

    def __init__(self, page: TabPage, state: ViewState, emit: Emit, waits: Waits) -> None:
        gui = page.gui
        self._waits = waits
        with gui.add_folder("People"):
            self._name = gui.add_text(
                "Your name",
                state.name,
                hint=f"Stands in the history before what you do, up to {LONGEST_NAME} characters",
            )
            page.columns([self._name], 1, narrow_labels=True)
            self._others = gui.add_html("")
            link = gui.add_button(
                "Copy link", icon=viser.Icon.LINK, color="gray", hint="Opens this frame, camera and domain"
            )
        on_input(self._name, lambda name: intents.SetName(str(name)), emit)

        @link.on_click
        async def _(event: viser.GuiEvent) -> None:
            page.call("copyLink")

    def show(self, state: ViewState) -> None:
        """Bring name and list up to date."""
        if not self._waits(intents.SetName):
            write(self._name, state.name)
        ids = state.project.identity.frame_ids
        rows = [
            f'<a href="#" data-frame="{index}">{escaped(name)}</a> on frame {escaped(ids[index])}'
            + (" <b>(this one)</b>" if index == state.index else "")
            for name, index in state.others
        ]
        text = "<br>".join(rows) if rows else "Nobody else is at work."
        self._others.content = f'<p class="carts-caption">{text}</p>'
