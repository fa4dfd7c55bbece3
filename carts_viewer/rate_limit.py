"""When the next picture may be sent: one at a time, as fast as the slowest tab draws, and never slower than 12 Hz.

A browser drops a WebGL picture that a newer one overtakes while it is being decoded, so sending faster than a tab can
draw shows less, not more. Each tab says when it has drawn; one that is hidden says nothing, hence the limit in time.
"""

import threading
import time
from collections.abc import Callable

LONGEST_WAIT = 0.08
"""After this long the next picture is sent whether the last one was drawn or not [s]."""
_REMEMBERED = 3.0


class RateLimit:
    """Keeps count of what was sent and which tabs have drawn it. Safe to use from several threads."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._sent_at = float("-inf")
        self._drawn_at: dict[int, float] = {}

    def sent(self) -> None:
        """A picture has been sent to all tabs."""
        with self._lock:
            self._sent_at = self._clock()

    def drawn(self, tab: int) -> None:
        """A tab has drawn the newest picture."""
        with self._lock:
            self._drawn_at[tab] = self._clock()

    def ready_in(self) -> float:
        """How long until the next picture may be sent [s], 0 when it may now."""
        with self._lock:
            now = self._clock()
            # Only tabs that have lately drawn anything are waited for: the others are hidden or gone.
            for tab, drawn_at in list(self._drawn_at.items()):
                if now - drawn_at > _REMEMBERED and self._sent_at > drawn_at:
                    del self._drawn_at[tab]
            waiting = not self._drawn_at or any(drawn < self._sent_at for drawn in self._drawn_at.values())
            return max(0.0, self._sent_at + LONGEST_WAIT - now) if waiting else 0.0
