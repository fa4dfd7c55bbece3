"""Reviews of frames, and which one to review next."""

from collections import Counter

import viser

from carts_core.project import ProjectState, ReviewState
from carts_core.project.values import WHOLE_PROJECT
from carts_viewer import intents
from carts_viewer.finding import BY_HAND, SOLVED, review_name
from carts_viewer.panels.inputs import Emit, Waits, on_click, on_input, write
from carts_viewer.state import ViewState
from carts_viewer.transport.tab_page import TabPage

_COLORS = {
    ReviewState.UNTOUCHED: "#6b7280",
    BY_HAND: "#facc15",
    ReviewState.OPTIMIZED: "#60a5fa",
    SOLVED: "#e879f9",
    ReviewState.NEEDS_WORK: "#fb923c",
    ReviewState.ACCEPTED: "#2dd4a7",
    ReviewState.REJECTED: "#ef4444",
}
"""By what `review_name` says, in the order in which frames are counted; as in the timeline."""


class ReviewPanel:
    """Review state and note of the shown frame, where to go next, and how many frames are in which state."""

    def __init__(self, page: TabPage, emit: Emit, waits: Waits) -> None:
        gui = page.gui
        self._waits = waits
        self._counted: ProjectState | None = None
        with gui.add_folder("Review"):
            self._state = gui.add_html("")
            self._accept = accept = gui.add_button("Accept + next", icon=viser.Icon.CHECK, color="gray")
            keep = gui.add_button("Accept", color="gray")
            page.row(accept, keep, weights=(3, 2))
            work = gui.add_button("Needs work", color="gray")
            reject = gui.add_button("Reject", color="gray")
            clear = gui.add_button("Clear", color="gray", hint="Forget what was said about this frame (Shift+G)")
            page.row(work, reject, clear, weights=(11, 7.65, 7.35))
            self._note = gui.add_text("Note", "")
            previous = gui.add_button("Previous worst", color="gray")
            following = gui.add_button("Next worst", color="gray")
            page.row(previous, following, weights=(5, 4))
            unreviewed = gui.add_button("Next unreviewed", icon=viser.Icon.CHEVRON_RIGHT, color="gray")
            self._counts = gui.add_html("")
        on_click(accept, lambda _: intents.AcceptAndNext(), emit)
        for button, state in (
            (keep, ReviewState.ACCEPTED),
            (work, ReviewState.NEEDS_WORK),
            (reject, ReviewState.REJECTED),
            (clear, ReviewState.UNTOUCHED),
        ):
            on_click(button, lambda _, state=state: intents.SetReview(state), emit)
        on_click(previous, lambda _: intents.ShowWorse(-1), emit)
        on_click(following, lambda _: intents.ShowWorse(1), emit)
        on_click(unreviewed, lambda _: intents.ShowUnreviewed(1), emit)
        on_input(self._note, intents.SetNote, emit)

    def show(self, state: ViewState) -> None:
        """Bring the widgets up to date."""
        review = state.review
        keyframe = " · keyframe" if state.project.is_keyframe(state.index) else ""
        name = review_name(state.project, state.index)
        self._state.content = f'<p class="carts-caption">{_dot(name)}<b>{name}</b>{keyframe}</p>'
        # Bright where the images say that there is something to accept.
        good = (
            state.verdict is not None and state.verdict.verdict == "good" and review.state is not ReviewState.ACCEPTED
        )
        self._accept.color = "teal" if good else "gray"
        if not self._waits(intents.SetNote):
            write(self._note, review.note)
        if self._counted is None or not (state.unsaved or state.project is self._counted):
            self._counted = state.project
            self._count(state.project)

    def _count(self, project: ProjectState) -> None:
        # An hour has 100,000 frames, of which few have a record.
        recorded = project.records.keys() - {WHOLE_PROJECT}
        counts = Counter(review_name(project, index) for index in recorded)
        counts[str(ReviewState.UNTOUCHED)] += len(project.identity.frame_ids) - len(recorded)
        known = " ".join(
            f'<span class="carts-key">{_dot(name)}{counts[name]} {name}</span>'
            for name in map(str, _COLORS)
            if counts[name]
        )
        self._counts.content = f'<p class="carts-caption">{known}</p>'


def _dot(name: str) -> str:
    """The colour of what `review_name` says."""
    return f'<span class="carts-swatch" style="background: {_COLORS[name]}"></span>'
