"""Looking for frames by what was said and found about them, and saying something about all of them."""

import viser

from carts_core.project import ProjectState, ReviewState
from carts_core.project.values import VERDICTS
from carts_viewer import intents
from carts_viewer.finding import ANY, BY_HAND, NOT_CHECKED, SOLVED, UNJUDGED, FrameFilter, found
from carts_viewer.panels.inputs import Emit, Waits, escaped, on_click, on_input, write
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.transport.tab_page import TabPage

_LISTED = 150
_BULK = {"Accept all": ReviewState.ACCEPTED, "Reject all": ReviewState.REJECTED, "Reset all": ReviewState.UNTOUCHED}


class FindPanel:
    """Conditions, the frames that meet them as links, and buttons for all of those."""

    def __init__(self, page: TabPage, session: Session, emit: Emit, waits: Waits) -> None:
        gui = page.gui
        self._waits = waits
        self._ids = session.sequence.frame_ids
        self._known: tuple[ProjectState | None, FrameFilter] = (None, FrameFilter())
        with gui.add_folder("Find", expand_by_default=False):
            self._widgets = {
                "review": gui.add_dropdown("Review", [ANY, UNJUDGED, *map(str, ReviewState), BY_HAND, SOLVED]),
                "fit": gui.add_dropdown(
                    "Fit",
                    [ANY, *VERDICTS, NOT_CHECKED],
                    hint="Frames with this verdict: what the images say of the fit",
                ),
                "arm": gui.add_dropdown("Corrected", [ANY, *(arm.name for arm in session.scene.arms)]),
                "dice": gui.add_number(
                    "Dice below",
                    1.0,
                    min=0.0,
                    max=1.0,
                    step=0.01,
                    hint="Frames that overlap the true mask by less, 0 to 1; 1: whatever it is",
                ),
                "note": gui.add_text("Note has", ""),
            }
            self._list = gui.add_html("")
            before = gui.add_button("Previous", icon=viser.Icon.CHEVRON_LEFT, color="gray")
            after = gui.add_button("Next", icon=viser.Icon.CHEVRON_RIGHT, color="gray")
            page.row(before, after)
            self._bulk = [gui.add_button(name, color="gray") for name in _BULK]
            clear = gui.add_button("Clear", color="gray", hint="Forget these conditions")
            page.row(*self._bulk[:2])
            page.row(self._bulk[2], clear)
        for name, widget in self._widgets.items():
            on_input(widget, lambda value, name=name: intents.SetFilter(name, value), emit)
        on_click(before, lambda _: intents.ShowFound(-1), emit)
        on_click(after, lambda _: intents.ShowFound(1), emit)
        on_click(clear, lambda _: intents.ClearFilter(), emit)
        for button, state in zip(self._bulk, _BULK.values(), strict=True):
            on_click(button, lambda _, state=state: intents.ReviewFound(state), emit)

    def show(self, state: ViewState) -> None:
        """Bring conditions and frames up to date; a gesture that is not finished changes nothing."""
        for name, widget in self._widgets.items():
            if not self._waits((intents.SetFilter, name)):
                write(widget, getattr(state.filter, name))
        if state.unsaved or (state.project, state.filter) == self._known:
            return
        self._known = state.project, state.filter
        frames = [] if state.filter.empty else found(state.project, state.filter)
        for button in self._bulk:
            button.disabled = not frames
        if state.filter.empty:
            self._list.content = '<p class="carts-caption">Choose what frames should be like.</p>'
            return
        links = " ".join(f'<a href="#" data-frame="{i}">{escaped(self._ids[i])}</a>' for i in frames[:_LISTED])
        more = " …" if len(frames) > _LISTED else ""
        self._list.content = (
            f'<div class="carts-list carts-found" aria-label="Frames found"><b>{len(frames)}</b> of {len(self._ids)} '
            f"frames: {links}{more}</div>"
        )
