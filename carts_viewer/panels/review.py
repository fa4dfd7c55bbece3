"""Panels of reviews, and of the frame filter."""

from collections import Counter

import viser

from carts_core.project import ProjectState, ReviewState
from carts_core.project.values import VERDICTS, WHOLE_PROJECT
from carts_viewer.actions import intents
from carts_viewer.actions.frame_filter import (
    ANY,
    BY_HAND,
    NO_REVIEW,
    NOT_CHECKED,
    SOLVED,
    FrameFilter,
    matching_frames,
    review_name,
)
from carts_viewer.panels.inputs import PanelPage, write
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.transport.document import escaped

_COLORS = {
    ReviewState.UNTOUCHED: "#6b7280",
    BY_HAND: "#facc15",
    ReviewState.OPTIMIZED: "#60a5fa",
    SOLVED: "#e879f9",
    ReviewState.NEEDS_WORK: "#fb923c",
    ReviewState.ACCEPTED: "#2dd4a7",
    ReviewState.REJECTED: "#ef4444",
}
"""Colours by `review_name`, in the order of the counts; the timeline uses the same colours."""


class ReviewPanel:
    """Review state and note of the shown frame, navigation, and counts of frames by state."""

    def __init__(self, page: PanelPage) -> None:
        gui = page.gui
        self._waits = page.waits
        self._counted: ProjectState | None = None
        with gui.add_folder("Review"):
            self._state = gui.add_html("")
            self._accept = accept = page.button("Accept + next", intents.AcceptAndNext(), icon=viser.Icon.CHECK)
            keep = page.button("Accept", intents.SetReview(ReviewState.ACCEPTED))
            page.row(accept, keep, weights=(3, 2))
            work = page.button("Needs work", intents.SetReview(ReviewState.NEEDS_WORK))
            reject = page.button("Reject", intents.SetReview(ReviewState.REJECTED))
            hint = "Clear the review of this frame ({SetReview untouched})"
            clear = page.button("Clear", intents.SetReview(ReviewState.UNTOUCHED), hint=hint)
            page.row(work, reject, clear, weights=(11, 7.65, 7.35))
            self._note = gui.add_text("Note", "")
            self._entered = ""
            """Last note that was entered or shown; the widget's value may be ahead of the intents."""
            previous = page.button("Previous worst", intents.ShowWorst(-1))
            following = page.button("Next worst", intents.ShowWorst(1))
            page.row(previous, following, weights=(5, 4))
            page.button("Next unreviewed", intents.ShowUnreviewed(1), icon=viser.Icon.CHEVRON_RIGHT)
            self._counts = gui.add_html("")
        page.on_input(self._note, self._set_note)

    def _set_note(self, text: str) -> intents.SetNote:
        self._entered = text
        return intents.SetNote(text)

    def show(self, state: ViewState) -> None:
        """Update the widgets."""
        review = state.review
        keyframe = " · keyframe" if state.project.is_keyframe(state.index) else ""
        name = review_name(state.project, state.index)
        self._state.content = f'<p class="carts-caption">{_dot(name)}<b>{name}</b>{keyframe}</p>'
        # Highlighted if the verdict is good.
        good = (
            state.verdict is not None and state.verdict.verdict == "good" and review.state is not ReviewState.ACCEPTED
        )
        self._accept.color = "teal" if good else "gray"
        if review.note != self._entered and not self._waits(intents.SetNote):
            self._entered = self._note.value = review.note
        if self._counted is None or not (state.unsaved or state.project is self._counted):
            self._counted = state.project
            self._count(state.project)

    def _count(self, project: ProjectState) -> None:
        # A recording of one hour has 100,000 frames, but few of them have a record.
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
    """HTML colour swatch of a review state, named as by `review_name`."""
    return f'<span class="carts-swatch" style="background: {_COLORS[name]}"></span>'


_MAX_LISTED = 150
_BULK = {"Accept all": ReviewState.ACCEPTED, "Reject all": ReviewState.REJECTED, "Reset all": ReviewState.UNTOUCHED}


class FindPanel:
    """Conditions of the frame filter, links to matching frames, and buttons that review all of them."""

    def __init__(self, page: PanelPage, session: Session) -> None:
        gui = page.gui
        self._waits = page.waits
        self._ids = session.sequence.frame_ids
        self._known: tuple[ProjectState | None, FrameFilter] = (None, FrameFilter())
        with gui.add_folder("Find", expand_by_default=False):
            self._widgets = {
                "review": gui.add_dropdown("Review", [ANY, NO_REVIEW, *map(str, ReviewState), BY_HAND, SOLVED]),
                "fit": gui.add_dropdown(
                    "Fit",
                    [ANY, *VERDICTS, NOT_CHECKED],
                    hint="Frames with this verdict",
                ),
                "arm": gui.add_dropdown("Corrected", [ANY, *(arm.name for arm in session.scene.arms)]),
                "dice": gui.add_number(
                    "Dice below",
                    1.0,
                    min=0.0,
                    max=1.0,
                    step=0.01,
                    hint="Frames with a lower Dice (0 to 1); 1 shows all frames",
                ),
                "note": gui.add_text("Note text", ""),
            }
            self._list = gui.add_html("")
            before = page.button("Previous", intents.ShowMatching(-1), icon=viser.Icon.CHEVRON_LEFT)
            after = page.button("Next", intents.ShowMatching(1), icon=viser.Icon.CHEVRON_RIGHT)
            page.row(before, after)
            self._bulk = [page.button(name, intents.ReviewMatching(state)) for name, state in _BULK.items()]
            clear = page.button("Clear", intents.ClearFilter(), hint="Clear these conditions")
            page.row(*self._bulk[:2])
            page.row(self._bulk[2], clear)
        for name, widget in self._widgets.items():
            page.on_input(widget, lambda value, name=name: intents.SetFilter(name, value))

    def show(self, state: ViewState) -> None:
        """Update the widgets; the list of frames does not change during an unfinished gesture."""
        for name, widget in self._widgets.items():
            if not self._waits((intents.SetFilter, name)):
                write(widget, getattr(state.filter, name))
        if state.unsaved or (state.project, state.filter) == self._known:
            return
        self._known = state.project, state.filter
        frames = [] if state.filter.empty else matching_frames(state.project, state.filter)
        for button in self._bulk:
            button.disabled = not frames
        if state.filter.empty:
            self._list.content = '<p class="carts-caption">Set conditions to find frames.</p>'
            return
        links = " ".join(f'<a href="#" data-frame="{i}">{escaped(self._ids[i])}</a>' for i in frames[:_MAX_LISTED])
        more = " …" if len(frames) > _MAX_LISTED else ""
        self._list.content = (
            f'<div class="carts-list carts-found" aria-label="Frames found"><b>{len(frames)}</b> of {len(self._ids)} '
            f"frames: {links}{more}</div>"
        )
