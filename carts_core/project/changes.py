"""What was saved, and who is notified of it."""

import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from .keys import Key
from .state import Step

Action = Literal["apply", "undo", "redo", "figures", "export"]


@dataclass(frozen=True)
class Change:
    """What has just been saved. The new state is that of the project."""

    action: Action
    step: Step | None
    """The step that was done or, for "undo", taken back; the furthest one when several were passed."""
    keys: frozenset[Key[Any]]
    """What may have another value now."""
    frames: tuple[int, ...]
    """Indices of the frames that it is about, in order; values of the whole project aside."""


Listener = Callable[[Change], None]


class Listeners:
    """Functions that are called after each save, in the order in which they came."""

    def __init__(self) -> None:
        self._listeners: list[Listener] = []

    def add(self, listener: Listener) -> Callable[[], None]:
        """Call a function from now on; what is returned ends this."""
        self._listeners.append(listener)

        def remove() -> None:
            with suppress(ValueError):
                self._listeners.remove(listener)

        return remove

    def notify(self, change: Change, project: Path) -> None:
        """Call them all. One that fails is logged: the edit is saved, so it must not look as if it were not."""
        for listener in tuple(self._listeners):
            try:
                listener(change)
            except Exception:
                logging.getLogger(__name__).exception("a listener of project %s failed", project)
