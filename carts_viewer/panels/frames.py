"""Data of the sheet that lists all frames."""

import threading
from typing import Any

from carts_core.project import ProjectState, worst_first
from carts_core.project.values import WHOLE_PROJECT
from carts_viewer.state import ViewState
from carts_viewer.transport.page import TabPage

_NUMBERS = 10**9


class FramesData:
    """Sends the values of all frames to a tab while its sheet of frames is open."""

    def __init__(self, page: TabPage) -> None:
        self._page = page
        self._state: ViewState | None = None
        self._sent: tuple[ProjectState, tuple[tuple[str, int], ...]] | None = None
        self._open = False
        # Keys are pressed on the event loop, and states are shown by the worker.
        self._lock = threading.Lock()
        page.on_pressed(self._pressed)

    def _pressed(self, key: str) -> None:
        if key not in ("frames", "frames-closed"):
            return
        with self._lock:
            self._open, self._sent = key == "frames", None
            self._send()

    def show(self, state: ViewState) -> None:
        """Send changes, except during an unfinished gesture."""
        with self._lock:
            if not state.unsaved or self._state is None:
                self._state = state
            self._send()

    def _send(self) -> None:
        state = self._state
        if not self._open or state is None or self._sent == (state.project, state.others):
            return
        self._sent = state.project, state.others
        who: dict[int, str] = {}
        for name, index in state.others:
            who[index] = f"{who[index]}, {name}" if index in who else name
        self._page.call(
            "setFrames", {"values": frame_values(state.project), "who": who, "poses": _pose_numbers(state.project)}
        )


def _pose_numbers(project: ProjectState) -> dict[int, int]:
    """Frame -> number in the address of its thumbnail, which changes with the pose, for frames with a record.

    `WHOLE_PROJECT` -> the number of all other frames.
    """
    whole = id(project.records.get(WHOLE_PROJECT))
    found = {index: (id(record) ^ whole) % _NUMBERS for index, record in project.records.items() if index >= 0}
    return {**found, WHOLE_PROJECT: whole % _NUMBERS}


def frame_values(project: ProjectState) -> dict[int, list[Any]]:
    """Loss, Dice, probability of failure, note, and place in the order from the worst fit, of frames with a record."""
    recorded = sorted(index for index in project.records if index >= 0)
    measured = [i for i in recorded if project.figures(i) is not None or project.verdict(i) is not None]
    places = {index: place for place, index in enumerate(worst_first(project, measured), start=1)}
    values = {}
    for index in recorded:
        figures, verdict = project.figures(index), project.verdict(index)
        values[index] = [
            None if figures is None else figures.loss,
            None if figures is None else figures.dice,
            None if verdict is None else verdict.failure,
            project.review(index).note,
            places.get(index),
        ]
    return values
