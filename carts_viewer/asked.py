"""What a tab asks for in words: its theme, to be where it was before the server started anew, and a few intents."""

import json
import logging

from carts_core.project import ReviewState
from carts_core.recording import Sequence
from carts_viewer import intents
from carts_viewer.intent_queue import IntentQueue
from carts_viewer.layout import choose_theme
from carts_viewer.transport.page import Page

_log = logging.getLogger(__name__)
_LONGEST = 2000
"""Characters."""
_DO: dict[str, intents.Intent] = {
    "previous": intents.MoveFrame(-1),
    "next": intents.MoveFrame(1),
    "accept": intents.AcceptAndNext(),
    "work": intents.SetReview(ReviewState.NEEDS_WORK),
    "peek": intents.Peek(True),
    "look": intents.Peek(False),
    "reject": intents.SetReview(ReviewState.REJECTED),
}


class Asked:
    """Answers what tabs ask for; what makes no sense is not answered."""

    def __init__(self, page: Page, queue: IntentQueue, sequence: Sequence) -> None:
        self._page = page
        self._queue = queue
        self._sequence = sequence
        page.on_asked(self._answer)

    def _answer(self, client_id: int, text: str) -> None:
        kind, _, rest = text[:_LONGEST].partition(" ")
        client = self._page.server.get_clients().get(client_id)
        if kind == "theme" and client is not None:
            choose_theme(client.gui, light=rest == "light")
        elif kind == "do" and rest in _DO:
            self._queue.put(_DO[rest])
        elif kind == "restore" and len(self._page.server.get_clients()) <= 1:
            # Whoever is not alone would take the others along.
            self._restore(rest)

    def _restore(self, text: str) -> None:
        try:
            place = json.loads(text)
            frame, camera, domain = int(place["frame"]), int(place["camera"]), str(place["domain"])
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
            _log.info("Refused: no place to go back to: %s", text)
            return
        cameras = self._sequence.scene.cameras
        if domain in self._sequence.domains and 0 <= camera < len(cameras):
            self._queue.put(intents.ShowDomain(domain))
            self._queue.put(intents.ShowCamera(cameras[camera].name))
            self._queue.put(intents.ShowFrame(min(max(frame, 0), len(self._sequence) - 1)))
