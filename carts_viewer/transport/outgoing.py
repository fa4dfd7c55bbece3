"""Messages to tabs, queued from any thread.

The toolkit below us wakes the tasks that send messages twice: at once, from whichever thread queued one, and again on
the event loop. An asyncio event is for one thread only: with several tabs the first call now and then fails in the
middle ("deque mutated during iteration"), and what it was to show stays hidden. The second call does the work alone.
"""

import asyncio
import dataclasses
import warnings

from viser.infra import _infra
from viser.infra._async_message_buffer import AsyncMessageBuffer


class LoopEvent(asyncio.Event):
    """An event of one event loop; calls from elsewhere are left to the one that follows on the loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._own_loop = loop

    def set(self) -> None:
        """Wake all who wait, if this runs on the event loop."""
        try:
            running = asyncio.get_running_loop()
        except RuntimeError:
            return
        if running is self._own_loop:
            super().set()


@dataclasses.dataclass
class MessageBuffer(AsyncMessageBuffer):
    """The toolkit's queue with such an event."""

    def __post_init__(self) -> None:
        self.message_event = LoopEvent(self.event_loop)


def queue_safely() -> None:
    """Have every server that starts from now on, and every tab that joins it, use such queues."""
    # A tab that has just gone is normal, and what was on its way to it is no loss.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
    _infra.AsyncMessageBuffer = MessageBuffer  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]
