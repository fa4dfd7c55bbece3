"""What the page's timeline draws of every frame; only what has changed is sent, and of curves only what is in view."""

import json
from collections.abc import Mapping
from typing import Any

from carts_core.model.scene import Scene
from carts_core.optimization import undetermined_joints
from carts_core.project import FitVerdict, ProjectState, ReviewState, Source
from carts_core.project.state import Record
from carts_core.project.values import VERDICTS
from carts_viewer.finding import BY_HAND, SOLVED, review_name
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.traces import Traces
from carts_viewer.transport.tab_page import TabPage

_REVIEWS = (
    ReviewState.UNTOUCHED,
    ReviewState.OPTIMIZED,
    ReviewState.NEEDS_WORK,
    ReviewState.ACCEPTED,
    ReviewState.REJECTED,
    BY_HAND,
    SOLVED,
)
_SOURCES = (Source.HAND, Source.OPTIMIZER, Source.PROPAGATED)
_FULL = 0.2
"""1 - Dice, and probability of failure, that fill the height of a bar [1]."""
_MOST_OPEN = 255
_MOST_IDS = 5000
"""Of longer sequences, frames are named by their number."""


class TimelineData:
    """Sends a tab what is known of the frames, whole at first, and then what has changed."""

    def __init__(self, page: TabPage, session: Session) -> None:
        self._page = page
        self._session = session
        self._ids = session.sequence.frame_ids
        stamps = session.sequence.timestamps
        span = 0.0 if stamps is None or len(stamps) < 2 else float(stamps[-1] - stamps[0])
        self._fps = (len(self._ids) - 1) / span if span > 0 else 0.0
        self._records: Mapping[int, Record] = {}
        self._codes: dict[int, int] = {}
        self._draft: int | None = None
        """The frame of which something was sent that is not saved yet."""
        self._solving: list[int] | None = None
        self._traces = Traces(session)
        page.call("setTimeline", self._whole())

    def show(self, state: ViewState) -> None:
        """Send what has changed; a gesture that is not finished changes its own frame alone."""
        solving = None
        if state.solve is not None and state.solving:
            solving = [state.solve.frames[0], len(state.solve.frames), state.solve.done]
        changed = self._drafted(state) if state.unsaved else self._changed(state.project)
        measured = self._traces.measure(self._session.sequence)
        if changed or measured or solving != self._solving:
            self._solving = solving
            traced = measured or (bool(changed) and not state.unsaved)
            message = {"whole": False, "codes": changed, "solving": solving, "traced": traced}
            self._page.call("setTimeline", message)

    def answer(self, text: str) -> None:
        """Send a curve that the tab asks for, `{"name", "first", "last", "columns"}`; nonsense is not answered."""
        try:
            asked = json.loads(text)
            name, numbers = str(asked["name"]), [int(asked[key]) for key in ("first", "last", "columns")]
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
            return
        found = self._traces.between(name, *numbers)
        if found is not None:
            self._page.call("setTrace", {"name": name, **found})

    def _whole(self) -> dict[str, Any]:
        codes = [number for pair in list(self._codes.items()) for number in pair]
        ids = list(self._ids) if len(self._ids) <= _MOST_IDS else None
        sequence = self._session.sequence
        return {
            "whole": True,
            "frames": len(self._ids),
            "fps": self._fps,
            "ids": ids,
            "codes": codes,
            "solving": self._solving,
            "traces": self._traces.names,
            "domains": list(sequence.domains),
            "cameras": [camera.name for camera in sequence.scene.cameras],
            "aspects": [camera.width / camera.height for camera in sequence.scene.cameras],
        }

    def _drafted(self, state: ViewState) -> list[int]:
        """As `_changed`, of the shown frame alone, while somebody or the optimizer moves it."""
        self._draft, number = state.index, code(state.project, state.index, self._session.scene)
        if self._codes.get(state.index, 0) == number:
            return []
        self._codes[state.index] = number
        return [state.index, number]

    def _changed(self, project: ProjectState) -> list[int]:
        """Frame and code, one after the other, of the frames whose code is another one than before."""
        draft, self._draft = self._draft, None
        if project.records is self._records and draft is None:
            return []
        before, self._records = self._records, project.records
        touched = [i for i, record in project.records.items() if i >= 0 and before.get(i) is not record]
        whole = before.get(-1) is not project.records.get(-1)
        # What the calibration changes makes figures and verdicts of all frames void.
        indices = {i for i in project.records if i >= 0} if whole else set(touched)
        indices |= {i for i in before if i >= 0 and i not in project.records}
        indices |= set() if draft is None else {draft}
        self._traces.follow(project, indices)
        changed: list[int] = []
        for index in sorted(indices):
            number = code(project, index, self._session.scene)
            if self._codes.get(index, 0) != number:
                self._codes[index] = number
                changed += [index, number]
        return changed


def code(project: ProjectState, frame: int, scene: Scene) -> int:
    """Review, verdict, source, whether it is kept, how badly it fits (1 to 255, 0 unknown), and how many joints are not
    determined (one more than there are, 0 unknown), in bits."""
    record = project.records.get(frame)
    if record is None:
        return 0
    review = _REVIEWS.index(review_name(project, frame))
    verdict, figures = project.verdict(frame), project.figures(frame)
    source = next((number for number, source in enumerate(_SOURCES, start=1) if source in record.sources), 0)
    dice = None if figures is None else figures.dice
    badness = 1.0 - dice if dice is not None else None if verdict is None else verdict.failure
    return (
        review
        + 8 * _fit(verdict)
        + 32 * source
        + 128 * int(record.is_kept)
        + 256 * _height(badness)
        + 65536 * _open(project, frame, scene)
    )


def _open(project: ProjectState, frame: int, scene: Scene) -> int:
    known = {name: found.standard_deviations or () for name, found in project.joints(frame).items()}
    joints = undetermined_joints(scene, known)
    return 0 if joints is None else min(1 + len(joints), _MOST_OPEN)


def _fit(verdict: FitVerdict | None) -> int:
    return 0 if verdict is None else 1 + VERDICTS.index(verdict.verdict)


def _height(badness: float | None) -> int:
    return 0 if badness is None else min(max(round(255 * badness / _FULL), 1), 255)
