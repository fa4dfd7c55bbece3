"""Where intents wait for the one worker; of those of one tab with the same key only the newest."""

import threading
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Generic, TypeVar

from carts_viewer.intents import Intent

T = TypeVar("T", bound=Hashable)


@dataclass(frozen=True)
class Asked(Generic[T]):
    """An intent, and the tab that it came from."""

    tab: T
    intent: Intent


class IntentQueue(Generic[T]):
    """Where intents wait, in the order of their newest version. Any thread may put, the worker takes."""

    def __init__(self) -> None:
        self._waiting: dict[Hashable, Asked[T]] = {}
        self._changed = threading.Condition()
        self._woken = False

    def put(self, tab: T, intent: Intent) -> None:
        """Add an intent, in place of a waiting one of the same tab and key."""
        with self._changed:
            key = object() if intent.key is None else (tab, intent.key)
            # Removed first, so that the newest version queues up behind what was asked for before it.
            self._waiting.pop(key, None)
            self._waiting[key] = Asked(tab, intent)
            self._changed.notify()

    def take(self, timeout: float | None = None) -> list[Asked[T]]:
        """Everything that waits, emptying the queue.

        Args:
            timeout: How long to wait for a first intent [s]; None waits for ever, 0 not at all.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._woken, timeout)
            self._woken = False
            waiting = list(self._waiting.values())
            self._waiting.clear()
            return waiting

    def wake(self) -> None:
        """End a `take` that waits, with nothing."""
        with self._changed:
            self._woken = True
            self._changed.notify()

    def empty(self) -> bool:
        """Whether nothing waits."""
        with self._changed:
            return not self._waiting

    def waits(self, tab: T, key: Hashable) -> bool:
        """Whether an intent of this tab and key has arrived and was not yet taken."""
        with self._changed:
            return (tab, key) in self._waiting
