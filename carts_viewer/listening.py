"""What the pages of a viewer say, each of itself: where somebody points, what they ask for, that they come or go."""

import logging

from carts_core.errors import CartsError
from carts_core.model.camera import Camera
from carts_core.model.parts import part_classes
from carts_core.project import ReviewState
from carts_core.recording import Sequence
from carts_viewer import intents
from carts_viewer.layout import choose_theme
from carts_viewer.strokes import read_stroke
from carts_viewer.tab import View
from carts_viewer.tabs import Hello, Tabs, read_hello
from carts_viewer.transport.page import Page
from carts_viewer.worker import Worker

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


class Listening:
    """Hands what a page says to its tab; what makes no sense is not answered."""

    def __init__(self, page: Page, tabs: Tabs, worker: Worker, sequence: Sequence) -> None:
        self._page, self._tabs, self._worker, self._sequence = page, tabs, worker, sequence
        self._classes = max((one.number for one in part_classes(sequence.scene.arms)), default=0)
        page.on_asked(self._answer)
        page.on_disconnect(lambda client_id: worker.call(lambda: tabs.detach(client_id)))
        page.on_drawn(self._drawn)
        page.on_released(lambda client_id: self._put(client_id, intents.Released()))
        page.on_pointed(self._pointed)
        page.on_dragged(self._dragged)
        page.on_activated(self._activated)
        page.on_painted(self._painted)
        page.on_pressed(self._pressed)
        page.on_picked(self._picked)

    def _put(self, client_id: int, intent: intents.Intent) -> None:
        tab = self._tabs.of_client(client_id)
        if tab is not None:
            tab.put(intent)

    def _answer(self, client_id: int, text: str) -> None:
        kind, _, rest = text[:_LONGEST].partition(" ")
        client = self._page.server.get_clients().get(client_id)
        if kind == "hello" and client is not None and self._tabs.of_client(client_id) is None:
            hello = read_hello(rest)
            if hello is not None:
                self._worker.call(lambda: self._come(client_id, hello))
        elif kind == "theme" and client is not None:
            choose_theme(client.gui, light=rest == "light")
        elif kind == "trace" and (tab := self._tabs.of_client(client_id)) is not None and tab.view is not None:
            tab.view.layout.timeline.answer(rest)
        elif kind == "range":
            self._put(client_id, intents.SetRange(_range(rest)))
        elif kind == "do" and rest in _DO:
            self._put(client_id, _DO[rest])

    def _come(self, client_id: int, hello: Hello) -> None:
        # Said more than once until it is heard, and perhaps gone by now.
        client = self._page.server.get_clients().get(client_id)
        if client is not None and self._tabs.of_client(client_id) is None:
            self._tabs.attach(client, hello)

    def _drawn(self, client_id: int) -> None:
        tab = self._tabs.of_client(client_id)
        view: View | None = None if tab is None else tab.view
        if tab is not None and view is not None:
            view.display.drawn()
            tab.put(intents.Drawn())

    def _pointed(self, client_id: int, u: float, v: float, index: float) -> None:
        camera = self._camera(index)
        if camera is not None:
            self._put(client_id, intents.PointAt(u * camera.width, v * camera.height, camera.name))

    def _dragged(self, client_id: int, gesture: float, *places: float) -> None:
        *shares, index = places
        camera = self._camera(index)
        if camera is not None:
            size = camera.width, camera.height
            start, end = ((u * size[0], v * size[1]) for u, v in (shares[:2], shares[2:]))
            self._put(client_id, intents.DragLink(gesture, camera.name, start, end))

    def _activated(self, client_id: int, index: float) -> None:
        camera = self._camera(index)
        if camera is not None:
            self._put(client_id, intents.ShowCamera(camera.name))

    def _camera(self, index: float) -> Camera | None:
        """The camera with this index; None where a tab names none."""
        cameras = self._sequence.scene.cameras
        return cameras[int(index)] if index in range(len(cameras)) else None

    def _picked(self, client_id: int, index: float) -> None:
        self._put(client_id, intents.ShowFrame(int(min(max(index, 0.0), 1e9))))

    def _pressed(self, client_id: int, key: str) -> None:
        tab = self._tabs.of_client(client_id)
        view: View | None = None if tab is None else tab.view
        if view is not None:
            view.page.press(key)

    def _painted(self, client_id: int, text: str) -> None:
        try:
            cameras = {camera.name: camera for camera in self._sequence.scene.cameras}
            stroke = read_stroke(text, len(self._sequence), cameras, self._classes)
        except CartsError as error:
            # Our page sends no such thing.
            _log.info("Refused: %s", error)
        else:
            self._put(client_id, intents.Paint(client_id, stroke))


def _range(text: str) -> tuple[int, int] | None:
    """First and last frame, from what a tab says; None where these are no two numbers."""
    numbers = [int(part) for part in text.split() if part.isdecimal() and len(part) < 10]
    return (numbers[0], numbers[1]) if len(numbers) == 2 else None
