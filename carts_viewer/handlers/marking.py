"""What intents about keyframes do: marking them, and from which end frames are solved."""

from functools import singledispatchmethod

from carts_core.errors import CartsError
from carts_core.project import Key, Keyframe
from carts_viewer import intents
from carts_viewer.checks import unknown
from carts_viewer.context import Context, OpenRun


class MarkingHandler:
    """The handler that marks keyframes."""

    def __init__(self, context: Context, run: OpenRun) -> None:
        self._context = context
        self._open_run = run

    @singledispatchmethod
    def handle(self, intent: intents.Marking) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        raise unknown(intent)

    @handle.register
    def _(self, intent: intents.HoldKeyframe) -> None:
        state = self._context.state
        on = not state.project.is_keyframe(state.index) if intent.on is None else bool(intent.on)
        self._open_run.end("Stopped: the frame was marked")
        name = "Make a keyframe" if on else "Make no keyframe"
        self._context.edit(name, {Key.keyframe(state.index): Keyframe(on)})

    @handle.register
    def _(self, intent: intents.SetDirection) -> None:
        if intent.direction not in ("forward", "backward"):
            raise CartsError(f"There is no direction {intent.direction!r}.")
        self._context.change(direction=intent.direction)
