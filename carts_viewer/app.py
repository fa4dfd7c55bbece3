"""The viewer of one sequence: page, tabs and worker, and the dispatch of browser events to tabs."""

import logging
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from threading import Thread
from typing import Any, Unpack

from carts_core.errors import CartsError
from carts_core.model.camera import Camera
from carts_core.model.parts import part_classes
from carts_core.model.scene import SceneState
from carts_core.project.state import corrected_state
from carts_core.recording import Frame, Sequence
from carts_viewer.actions import intents
from carts_viewer.actions.shortcuts import key_sheet
from carts_viewer.jobs.optimizers import NetworkOptions, OptimizerFactory
from carts_viewer.jobs.solver_process import Requests, SolverProcess, SolverStopped
from carts_viewer.panels.layout import choose_theme
from carts_viewer.panels.timeline import Thumbnails
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.picture.strokes import Painted, read_stroke
from carts_viewer.session import Storage, open_storage
from carts_viewer.state import ViewState
from carts_viewer.tabs import IntentQueue, Tab, Tabs, View
from carts_viewer.transport import events
from carts_viewer.transport.guard import Proxy, check_address
from carts_viewer.transport.page import Page
from carts_viewer.worker import Worker

_log = logging.getLogger(__name__)
_EVENTS = (
    events.Hello
    | events.Theme
    | events.SceneShown
    | events.Trace
    | events.Pressed
    | events.Pointed
    | events.Dragged
    | Painted
    | intents.AcceptAndNext
    | intents.ChooseKeypoint
    | intents.ClearLayer
    | intents.Drawn
    | intents.MoveFrame
    | intents.NextObject
    | intents.Peek
    | intents.Released
    | intents.RemovePins
    | intents.ReviewFrames
    | intents.SetDiameter
    | intents.SetKeys
    | intents.SetPaintClass
    | intents.SetRange
    | intents.SetReview
    | intents.SetSwipe
    | intents.SetTarget
    | intents.SetTool
    | intents.ShowCamera
    | intents.ShowFrame
    | intents.ShowKeypoints
    | intents.ShowLoupe
)
"""Events that the page's scripts send; handlers check the values of intents."""


class EventDispatcher:
    """Dispatches browser events to tabs; invalid events are ignored."""

    def __init__(self, page: Page, tabs: Tabs, worker: Worker, sequence: Sequence) -> None:
        self._page, self._tabs, self._worker, self._sequence = page, tabs, worker, sequence
        self._classes = max((one.number for one in part_classes(sequence.scene.arms)), default=0)
        page.listen(_EVENTS, self._dispatch)
        page.on_disconnect(lambda client_id: worker.call(lambda: tabs.detach(client_id)))

    def _dispatch(self, client_id: int, event: Any) -> None:
        client, tab = self._page.server.get_clients().get(client_id), self._tabs.of_client(client_id)
        if isinstance(event, events.Theme) and client is not None:
            choose_theme(client.gui, light=event.light)
        elif isinstance(event, events.Hello) and tab is None:
            self._worker.call(lambda: self._attach(client_id, event))
        elif tab is not None and (view := tab.view) is not None:
            self._act(client_id, tab, view, event)

    def _act(self, client_id: int, tab: Tab, view: View, event: Any) -> None:
        match event:
            case events.SceneShown():
                self._worker.call(lambda: view.display.show_scene(event.on))
            case events.Trace():
                view.layout.timeline.answer(event)
            case events.Pressed():
                view.page.press(event.key)
            case events.Pointed() if (camera := self._camera(event.camera)) is not None:
                tab.put(intents.PointAt(*_pixel(event.at, camera), camera.name))
            case events.Dragged() if (camera := self._camera(event.camera)) is not None:
                start, end = _pixel(event.start, camera), _pixel(event.end, camera)
                tab.put(intents.DragLink(event.gesture, camera.name, start, end))
            case Painted():
                self._paint(client_id, tab, event)
            case intents.Intent():
                if isinstance(event, intents.Drawn):
                    view.display.drawn(event.picture)
                tab.put(event)

    def _attach(self, client_id: int, hello: events.Hello) -> None:
        # A page repeats `Hello` until it is answered, and may have been closed since.
        client = self._page.server.get_clients().get(client_id)
        if client is not None and self._tabs.of_client(client_id) is None:
            self._tabs.attach(client, hello)

    def _camera(self, index: int) -> Camera | None:
        """The camera with this index; None if the index is invalid."""
        cameras = self._sequence.scene.cameras
        return cameras[index] if 0 <= index < len(cameras) else None

    def _paint(self, client_id: int, tab: Tab, painted: Painted) -> None:
        try:
            cameras = {camera.name: camera for camera in self._sequence.scene.cameras}
            stroke = read_stroke(painted, len(self._sequence), cameras, self._classes)
        except CartsError as error:
            # The viewer's own page never sends such strokes.
            _log.info("Stroke rejected: %s", error)
        else:
            tab.put(intents.Paint(client_id, stroke))


def _pixel(at: tuple[float, float], camera: Camera) -> tuple[float, float]:
    return at[0] * camera.width, at[1] * camera.height


class ServerOptions(NetworkOptions, total=False):
    """Options of the networks and of the server."""

    host: str
    """Address to listen on, 127.0.0.1 by default. The URL contains a token if other computers can reach the address."""
    port: int
    """Port to listen on, 8080 by default; 0 for any free port. If the port is busy, the next free port is used."""
    proxy: Proxy | None
    """Reverse proxy in front of the server; None without one."""


class _SolverListener:
    """Passes events of the solver process to the worker."""

    def __init__(self, worker: Worker, say: Callable[[str], None]) -> None:
        self._worker, self._say = worker, say

    def solver_replied(self) -> None:
        """See `Listener`."""
        self._worker.wake()

    def solver_reports(self, text: str) -> None:
        """See `Listener`."""
        self._worker.call(lambda: self._say(text))

    def solver_stopped(self, error: SolverStopped) -> None:
        """See `Listener`."""
        self._worker.call(lambda: self._worker.fail(error))


class ViewerApp:
    """Serves the viewer of one sequence until it is closed.

    Attributes:
        url: Address of the page.
        page: The page, for tests and scripts.
        tabs: All tabs.
        sequence: The recording.
        scene: The recording's arms and cameras.
        project: The project with the sequence's corrections.
    """

    def __init__(
        self,
        sequence: Sequence,
        storage: Storage,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        proxy: Proxy | None = None,
        report: Callable[[str], None] = lambda line: None,
        page: Page | None = None,
        folders: tuple[Path, ...] = (),
        solver: Requests | None = None,
        **networks: Unpack[NetworkOptions],
    ) -> None:
        """Start serving an open sequence with its project, which is closed with the viewer; see `open`.

        `solver`: the solver, which remains; None for a process that is closed with the viewer.
        """
        self._report = report
        self._own_page = page is None
        self._closed = False
        self.sequence = sequence
        self.scene = sequence.scene
        self.project = storage.project
        self._storage = storage
        renderer = OverlayRenderer(sequence)
        queue: IntentQueue[Tab] = IntentQueue()
        self._own_solver = solver is None
        self._solver: Requests = solver or SolverProcess()
        self._optimizers = OptimizerFactory(report=self._say, requests=self._solver, **networks)
        self.tabs = Tabs(sequence, storage, renderer, self._optimizers, self._deliver, queue, folders)
        report("Preparing the renderer (takes a few seconds the first time)")
        # The first rendering loads the compiled kernel or compiles it; meanwhile the page is served and loaded.
        first = self.state.pose.scene, self.state.camera
        self._renderer_start = Thread(target=renderer.arm_ids, args=first, name="carts-renderer")
        self._renderer_start.start()
        self.page = page or Page(host=host, port=port, title=f"{sequence.name} · CaRTS", proxy=proxy)
        self.url = self.page.url
        self.page.keys = key_sheet()
        self.page.project = sequence.name
        self._thumbnails = Thumbnails(sequence, self._saved_pose)
        self.page.thumbnail = self._thumbnails.answer
        self._worker = Worker(queue, self.tabs, lambda: self._solver.busy, report)
        self._listener = _SolverListener(self._worker, self._say)
        self._solver.listeners.append(self._listener)
        EventDispatcher(self.page, self.tabs, self._worker, sequence)
        self._worker.start(self._prepare)

    @classmethod
    def open(
        cls,
        path: Path,
        *,
        project: Path | None = None,
        report: Callable[[str], None] = lambda line: None,
        page: Page | None = None,
        folders: tuple[Path, ...] = (),
        solver: Requests | None = None,
        **options: Unpack[ServerOptions],
    ) -> "ViewerApp":
        """Open a sequence file and serve its viewer.

        Args:
            path: The sequence file.
            project: The project file, created if missing; None for the default path.
            report: Called with a line for the user about long operations.
            page: An empty page that is already served and remains after the viewer is closed; None to serve a new page.
            folders: Folders that masks may be imported from, besides the sequence's own folder.
            solver: The solver, which remains after the viewer is closed; None for a process of its own.
            options: See `ServerOptions`.

        Raises:
            CartsError: the sequence, its robot, its project or an option is not usable.
        """
        check_address(options.get("host", "127.0.0.1"), options.get("port", 8080))
        report(f"Opening {path}")
        sequence = Sequence.open(path, progress=report)
        storage = open_storage(sequence, project)
        if storage.reason is None:
            report(f"Project {storage.project.path}")
        if storage.notice is not None:
            report(storage.notice)
        try:
            return cls(sequence, storage, report=report, page=page, folders=folders, solver=solver, **options)
        except BaseException:
            storage.close()
            raise

    def __enter__(self) -> "ViewerApp":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def queue(self) -> Tab:
        """The first tab, which accepts intents even without a page."""
        return self.tabs.first

    @property
    def state(self) -> ViewState:
        """Immutable snapshot of the first tab's newest state."""
        return self.tabs.first.controller.state

    @property
    def view(self) -> View:
        """View of the first tab (for tests and scripts).

        Raises:
            RuntimeError: no page shows the first tab.
        """
        if self.tabs.first.view is None:
            raise RuntimeError("The first tab has no page.")
        return self.tabs.first.view

    @property
    def notice(self) -> str | None:
        """Message about the storage of corrections (`Storage.notice`); None if there is none."""
        return self._storage.notice

    @property
    def storage_failure(self) -> str | None:
        """Message if corrections are not in the project file, naming the file that contains them; None otherwise."""
        return self.project.storage_failure

    def close(self) -> None:
        """Save unfinished edits, and stop the worker and the server; closing again does nothing.

        Raises:
            ProjectError: the edits could not be saved.
        """
        if self._closed:
            return
        self._closed = True
        self._worker.stop()
        self._renderer_start.join()
        self._solver.listeners.remove(self._listener)
        if self._own_page:
            self.page.close()
        self._thumbnails.close()
        with ExitStack() as stack:
            # The callbacks run in reverse order, even if one of them fails.
            stack.callback(self._storage.close)
            if self._own_solver:
                stack.callback(self._solver.close)
            stack.callback(self.tabs.close)

    def _saved_pose(self, frame: Frame) -> SceneState:
        """The frame's pose in the project, without unsaved edits."""
        return corrected_state(self.scene, frame, self.project.state)

    def wait_until_shown(self, timeout: float = 120.0) -> ViewState:
        """Wait until all intents so far are carried out and their results are sent to the page.

        Raises:
            TimeoutError: the viewer is still busy after `timeout` [s].
        """
        if not self._worker.settled(timeout):
            raise TimeoutError(f"The viewer was still busy after {timeout} s.")
        return self.state

    def _prepare(self) -> None:
        """Start the solver and load the networks after the first picture."""
        self._solver.start(*self._optimizers.warm_up)
        reply = self._optimizers.prepare()
        # Errors are shown in all tabs.
        reply.on_done(lambda: self._worker.call(reply.check))

    def _say(self, text: str) -> None:
        self._report(text)
        self._worker.report(text)

    def _deliver(self, client_id: int, name: str, content: bytes) -> None:
        client = self.page.server.get_clients().get(client_id)
        if client is not None:
            client.send_file_download(name, content, save_immediately=True)
