"""The viewer of one sequence: page, tabs and worker, and the dispatch of browser events to tabs."""

import logging
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Unpack

from carts_core.errors import CartsError
from carts_core.model.camera import Camera
from carts_core.model.parts import part_classes
from carts_core.project import ReviewState
from carts_core.recording import Sequence
from carts_viewer.actions import intents
from carts_viewer.jobs.optimizers import NetworkOptions, OptimizerFactory
from carts_viewer.panels.help import key_groups
from carts_viewer.panels.layout import choose_theme
from carts_viewer.panels.timeline import Thumbnails
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.picture.strokes import read_stroke
from carts_viewer.session import Storage, open_storage
from carts_viewer.state import ViewState
from carts_viewer.tabs import Hello, IntentQueue, Tab, Tabs, View, read_hello
from carts_viewer.transport.guard import check_address
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
    """Dispatches browser events to tabs; invalid ones are ignored."""

    def __init__(self, page: Page, tabs: Tabs, worker: Worker, sequence: Sequence) -> None:
        self._page, self._tabs, self._worker, self._sequence = page, tabs, worker, sequence
        self._classes = max((one.number for one in part_classes(sequence.scene.arms)), default=0)
        page.on("asked", self._answer)
        page.on_disconnect(lambda client_id: worker.call(lambda: tabs.detach(client_id)))
        page.on("drawn", self._drawn)
        page.on("released", lambda client_id: self._put(client_id, intents.Released()))
        page.on("pointed", self._pointed)
        page.on("dragged", self._dragged)
        page.on("activated", self._activated)
        page.on("painted", self._painted)
        page.on("pressed", self._pressed)
        page.on("picked", self._picked)

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
        # A page repeats its greeting until it is answered, and may have closed by now.
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
            # The viewer's own page sends no such strokes.
            _log.info("Refused: %s", error)
        else:
            self._put(client_id, intents.Paint(client_id, stroke))


def _range(text: str) -> tuple[int, int] | None:
    """First and last frame, from what a tab says; None where these are no two numbers."""
    numbers = [int(part) for part in text.split() if part.isdecimal() and len(part) < 10]
    return (numbers[0], numbers[1]) if len(numbers) == 2 else None


Report = Callable[[str], None]
"""Called with a line for the user about long operations."""


class ViewerApp:
    """The viewer of one sequence, serving until it is closed.

    Attributes:
        url: Where the page is.
        page: The page, for tests and scripts.
        tabs: All tabs.
        sequence: The recording.
        scene: The recording's arms and cameras.
        project: The sequence's corrections.
    """

    def __init__(
        self,
        sequence: Sequence,
        storage: Storage,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        report: Report = lambda line: None,
        page: Page | None = None,
        folders: tuple[Path, ...] = (),
        **networks: Unpack[NetworkOptions],
    ) -> None:
        """Start serving an open sequence with its project, which is closed with the viewer; the rest as in `open`."""
        self._report = report
        self._own_page = page is None
        self._closed = False
        self.sequence = sequence
        self.scene = sequence.scene
        self.project = storage.project
        self._storage = storage
        renderer = OverlayRenderer(sequence)
        queue: IntentQueue[Tab] = IntentQueue()
        self._optimizers = OptimizerFactory(report=self._say, **networks)
        self.tabs = Tabs(sequence, storage, renderer, self._optimizers, self._deliver, queue, folders)
        # The first rendering compiles the visibility kernel, which takes seconds the very first time.
        report("Preparing the renderer (the first time takes a few seconds)")
        renderer.arm_ids(self.state.pose.scene, self.state.camera)
        self.page = page or Page(host=host, port=port, title=f"{sequence.name} · CaRTS")
        self.url = self.page.url
        self.page.key_groups = key_groups()
        self.page.project = sequence.name
        self._thumbnails = Thumbnails(sequence)
        self.page.thumbnail = self._thumbnails.answer
        self._worker = Worker(queue, self.tabs)
        Listening(self.page, self.tabs, self._worker, sequence)
        self._worker.start(self._prepare)

    @classmethod
    def open(
        cls,
        path: Path,
        *,
        project: Path | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        report: Report = lambda line: None,
        page: Page | None = None,
        folders: tuple[Path, ...] = (),
        **networks: Unpack[NetworkOptions],
    ) -> "ViewerApp":
        """Open a sequence file and serve its viewer.

        Args:
            path: The sequence file.
            project: The project file, begun if it is not there; None for the default place.
            host: The address to listen on; one that other computers can reach makes the url carry a token.
            port: 0 picks a free port; a busy one moves up to the next free one.
            report: Called with a line about what takes long.
            page: An empty page that is served already, and stays when the viewer is closed; None to serve a new one.
            folders: From where masks may be imported, besides the sequence's own folder.
            networks: Options of the networks.

        Raises:
            CartsError: the sequence, its robot, its project or an option is not usable.
        """
        check_address(host, port)
        report(f"Opening {path}")
        sequence = Sequence.open(path, progress=report)
        storage = open_storage(sequence, project)
        if storage.reason is None:
            report(f"Project {storage.project.path}")
        if storage.notice is not None:
            report(storage.notice)
        try:
            return cls(sequence, storage, host=host, port=port, report=report, page=page, folders=folders, **networks)
        except BaseException:
            storage.close()
            raise

    def __enter__(self) -> "ViewerApp":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def queue(self) -> Tab:
        """The first tab, which takes intents whether or not a page shows it."""
        return self.tabs.first

    @property
    def state(self) -> ViewState:
        """The newest state of the first tab; a snapshot that does not change."""
        return self.tabs.first.controller.state

    @property
    def view(self) -> View:
        """What the first tab's page is made of (for tests and scripts).

        Raises:
            RuntimeError: no page shows the first tab.
        """
        if self.tabs.first.view is None:
            raise RuntimeError("No page shows the first tab.")
        return self.tabs.first.view

    @property
    def notice(self) -> str | None:
        """Message about where corrections are kept, see `Storage.notice`; None without one."""
        return self._storage.notice

    def close(self) -> None:
        """Save what is under way, stop the worker and the server; closing again does nothing.

        Raises:
            ProjectError: it could not be saved.
        """
        if self._closed:
            return
        self._closed = True
        self._worker.stop()
        if self._own_page:
            self.page.close()
        self._thumbnails.close()
        with ExitStack() as stack:
            # From the last to the first, whatever fails.
            stack.callback(self._storage.close)
            stack.callback(self.tabs.close)

    def wait_until_shown(self, timeout: float = 30.0) -> ViewState:
        """Wait until everything asked for so far has been done and sent to the page.

        Args:
            timeout: [s]

        Raises:
            TimeoutError: it has not, in that time.
        """
        if not self._worker.settled(timeout):
            raise TimeoutError(f"The viewer was still busy after {timeout} s.")
        return self.state

    def _prepare(self) -> None:
        """Load on the worker, with the first picture already out, what the first run will need."""
        try:
            self._optimizers.prepare()
        finally:
            self._worker.report(None)

    def _say(self, text: str) -> None:
        self._report(text)
        self._worker.report(text)

    def _deliver(self, client_id: int, name: str, content: bytes) -> None:
        client = self.page.server.get_clients().get(client_id)
        if client is not None:
            client.send_file_download(name, content, save_immediately=True)
