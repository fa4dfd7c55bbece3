"""Panels of the project: saving, undo, history, users, and errors."""

import viser

from carts_viewer.actions import intents
from carts_viewer.editing import MAX_NAME_LENGTH
from carts_viewer.panels.inputs import PanelPage, write
from carts_viewer.panels.jobs import jobs_question, network_question
from carts_viewer.session import Storage
from carts_viewer.state import ViewState
from carts_viewer.transport.document import escaped

_MAX_LISTED = 60
"""Maximum number of listed steps, centred on the current step."""


class SavedPanel:
    """Save status, a banner if edits are not saved, undo and redo."""

    def __init__(self, page: PanelPage, storage: Storage) -> None:
        gui = page.gui
        self._storage = storage
        self._notice = gui.add_html("", visible=False)
        self._noticed: str | None = None
        self._text = gui.add_html("")
        self._undo = page.button("Undo", intents.Undo(), icon=viser.Icon.ARROW_BACK_UP)
        self._redo = page.button("Redo", intents.Redo(), icon=viser.Icon.ARROW_FORWARD_UP)
        page.row(self._undo, self._redo, icons=(self._undo, self._redo))

    def show(self, state: ViewState) -> None:
        """Update the widgets."""
        path = self._storage.project.path
        asked = jobs_question(state) or network_question(state)
        decide = "Jobs or a network of another user need your confirmation; see the tab Jobs." if asked else None
        notice = " ".join(filter(None, (self._storage.notice, *state.problems, decide))) or None
        if notice != self._noticed:
            self._noticed = notice
            self._notice.visible = notice is not None
            self._notice.content = f'<p class="carts-notice" role="status">{escaped(notice or "")}</p>'
        if not self._storage.project.safe:
            text = "<b class='carts-unsafe'>Not saved</b>"
        elif not self._storage.kept:
            text = "Not saved" if state.unsaved else escaped(path.name)
        elif state.unsaved:
            text = "Not saved yet …"
        else:
            text = "<b>Saved</b>"
        self._text.content = (
            f'<p class="carts-caption carts-saved" title="{escaped(str(path))}"><span>{text}</span></p>'
        )
        self._undo.disabled, self._redo.disabled = not state.can_undo, not state.can_redo


class HistoryPanel:
    """List of the steps in the history."""

    def __init__(self, page: PanelPage) -> None:
        gui = page.gui
        self._positions: dict[str, int] = {}
        with gui.add_folder("History"):
            self._steps = gui.add_dropdown("Go to", ["As measured"], hint="Undo or redo up to the selected step")
            page.columns([self._steps], 1, narrow_labels=True)
        page.on_input(self._steps, lambda label: intents.GoToStep(self._positions[label]))

    def show(self, state: ViewState) -> None:
        """Update the list."""
        project = state.project
        first = max(project.position - _MAX_LISTED // 2, 0)
        positions = {"Start": 0} | {
            f"{step.number}. {step.name}{' (undone)' if step.number > project.position else ''}": step.number
            for step in project.steps[first : first + _MAX_LISTED]
        }
        if positions != self._positions:
            # Set before the options of the widget, so that every option has an entry.
            self._positions = positions
            self._steps.options = tuple(positions)
        write(self._steps, next(label for label, number in positions.items() if number == project.position))


class PeoplePanel:
    """Name of the user, other users with their frames, and a button that copies the link."""

    def __init__(self, page: PanelPage, state: ViewState) -> None:
        gui = page.gui
        self._waits = page.waits
        with gui.add_folder("People"):
            self._name = gui.add_text(
                "Your name",
                state.name,
                hint=f"Shown before your steps in the history; up to {MAX_NAME_LENGTH} characters",
            )
            page.columns([self._name], 1, narrow_labels=True)
            self._others = gui.add_html("")
            link = gui.add_button(
                "Copy link", icon=viser.Icon.LINK, color="gray", hint="Copy a link to this frame, camera and domain"
            )
        page.on_input(self._name, lambda name: intents.SetName(str(name)))

        @link.on_click
        async def _(event: viser.GuiEvent) -> None:
            page.call("copyLink")

    def show(self, state: ViewState) -> None:
        """Update name and list."""
        if not self._waits(intents.SetName):
            write(self._name, state.name)
        ids = state.project.identity.frame_ids
        rows = [
            f'<a href="#" data-frame="{index}">{escaped(name)}</a> on frame {escaped(ids[index])}'
            + (" <b>(this frame)</b>" if index == state.index else "")
            for name, index in state.others
        ]
        text = "<br>".join(rows) if rows else "No other users."
        self._others.content = f'<p class="carts-caption">{text}</p>'


class MessagePanel:
    """The newest error, over the image, until it is dismissed or an action such as showing another frame clears it."""

    def __init__(self, page: PanelPage) -> None:
        self._page = page
        self._shown: str | None = None
        page.on_pressed(lambda key: page.emit(intents.DismissError()) if key == "dismiss" else None)

    def show(self, state: ViewState) -> None:
        """Update the message."""
        if state.error != self._shown:
            self._shown = state.error
            self._page.call("setError", state.error)
