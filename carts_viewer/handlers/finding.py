"""What intents about looking for frames do."""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import singledispatchmethod
from typing import Any

from carts_core.errors import CartsError
from carts_core.project import Key, Review, ReviewState
from carts_viewer import intents
from carts_viewer.checks import clamped, unknown
from carts_viewer.context import Context, OpenRun
from carts_viewer.finding import FrameFilter, found

_LONGEST = 200
"""Of a text that is looked for, in characters."""
_STEPS = {
    ReviewState.ACCEPTED: "Accept",
    ReviewState.REJECTED: "Reject",
    ReviewState.NEEDS_WORK: "Mark as needing work",
    ReviewState.UNTOUCHED: "Clear the review of",
    ReviewState.OPTIMIZED: "Mark as optimized",
}


class FindingHandler:
    """The handler that looks for frames."""

    def __init__(self, context: Context, run: OpenRun, show: Callable[..., None]) -> None:
        self._context = context
        self._open_run = run
        self._show = show

    @singledispatchmethod
    def handle(self, intent: intents.Finding) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        raise unknown(intent)

    @handle.register
    def _(self, intent: intents.SetFilter) -> None:
        if intent.name not in [field.name for field in fields(FrameFilter)]:
            raise CartsError(f"Frames cannot be looked for by {intent.name!r}.")
        value: Any = clamped(intent.value, 0.0, 1.0) if intent.name == "dice" else str(intent.value)[:_LONGEST]
        self._context.change(filter=replace(self._context.state.filter, **{intent.name: value}))

    @handle.register
    def _(self, intent: intents.ClearFilter) -> None:
        self._context.change(filter=FrameFilter())

    @handle.register
    def _(self, intent: intents.ShowFound) -> None:
        state = self._context.state
        frames = self._found()
        if intent.step > 0:
            index = next((frame for frame in frames if frame > state.index), frames[0])
        else:
            index = next((frame for frame in reversed(frames) if frame < state.index), frames[-1])
        self._context.change(playing=False)
        self._show(index=index)

    @handle.register
    def _(self, intent: intents.ReviewFound) -> None:
        frames, project = self._found(), self._context.session.editor.view
        self._open_run.end("Stopped: many frames were reviewed")
        edits: dict[Key[Any], Any] = {}
        for index in frames:
            review = Review(intent.state, project.review(index).note)
            edits[Key.review(index)] = None if review == Review() else review
        # All frames in a name would be a long one.
        self._context.save()
        self._context.session.editor.apply(f"{_STEPS[intent.state]} {len(frames)} frames", edits)
        self._context.refresh()

    def _found(self) -> list[int]:
        frames = found(self._context.session.editor.view, self._context.state.filter)
        if not frames:
            raise CartsError("No frame is like that. Loosen a condition, or clear them.")
        return frames
