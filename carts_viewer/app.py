"""The app: opens a sequence, builds page, panels and worker, and ties them together."""

import logging
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from carts_core.errors import CartsError
from carts_core.model.camera import Camera
from carts_core.optimization import FreeParameters, SurfaceSolver
from carts_core.recording import Sequence
from carts_core.settings.inference import Inference
from carts_viewer import intents
from carts_viewer.asked import Asked
from carts_viewer.controller import Controller
from carts_viewer.display import PageDisplay
from carts_viewer.intent_queue import IntentQueue
from carts_viewer.keys import key_groups
from carts_viewer.layers import Layer
from carts_viewer.layout import Layout
from carts_viewer.overlay import OverlayRenderer
from carts_viewer.running import OptimizerFactory
from carts_viewer.scene_view import SceneView
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.storage import Storage, open_storage
from carts_viewer.strokes import read_stroke
from carts_viewer.transport.guard import check_address
from carts_viewer.transport.page import Page
from carts_viewer.worker import Worker

_log = logging.getLogger(__name__)

Report = Callable[[str], None]
"""Called with a line for people about what takes long."""


class ViewerApp:
    """The viewer of one sequence, serving until it is closed.

    Attributes:
        url: Where the page is.
        page: The page, for tests and scripts.
        queue: Where intents go.
        sequence: The recording.
        scene: The recording's arms and cameras.
        scene_view: What is seen in 3D, frame and overlay included.
        project: The sequence's corrections.
        display: What puts states on the page.
        joints: The panel with the joints' sliders.
    """

    def __init__(
        self,
        sequence: Sequence,
        storage: Storage,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        device: str = "cpu",
        inference: Inference = "auto",
        weights: tuple[Path, ...] = (),
        report: Report = lambda line: None,
        page: Page | None = None,
        folders: tuple[Path, ...] = (),
    ) -> None:
        """Start serving an open sequence with its project, which is closed with the viewer; the rest as in `open`."""
        self._report = report
        self._own_page = page is None
        self._closed = False
        self.sequence = sequence
        self.scene = sequence.scene
        self.project = storage.project
        self._storage = storage
        self._session = Session(sequence, storage.project, folders)
        self._renderer = OverlayRenderer(sequence, device)
        state = self._first_state()
        self.queue = IntentQueue()
        self._optimizers = OptimizerFactory(weights=weights, device=device, inference=inference, report=self._say)
        self._controller = Controller(state, self._session, self._renderer, self._optimizers, self._deliver)
        # The first rendering compiles the visibility kernel, which takes seconds the very first time.
        report("Preparing the renderer (the first time takes a few seconds)")
        self._renderer.arm_ids(state.pose.scene, state.camera)
        self.page = page or Page(host=host, port=port, title=f"{sequence.name} · CaRTS")
        self.url = self.page.url
        layout = Layout(self.page, self._session, storage, state, self.queue)
        self.joints = layout.joints
        self.scene_view = SceneView(self.page.server, sequence.scene, state.pose.scene, state.camera)
        self.display = PageDisplay(self.page, self._session, self._renderer, self.scene_view, layout.panels)
        self.page.on_drawn(self._on_drawn)
        self.page.on_released(lambda: self.queue.put(intents.Released()))
        self.page.on_pointed(self._on_pointed)
        self.page.on_activated(self._on_activated)
        self.page.on_painted(self._on_painted)
        self.page.key_groups = key_groups(Layer)
        Asked(self.page, self.queue, self.sequence)
        self.page.on_picked(lambda index: self.queue.put(intents.ShowFrame(int(min(max(index, 0.0), 1e9)))))
        self._worker = Worker(self.queue, self._controller, self.display)
        self._worker.start(self._prepare)

    @classmethod
    def open(
        cls,
        path: Path,
        *,
        project: Path | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        device: str = "cpu",
        inference: Inference = "auto",
        weights: tuple[Path, ...] = (),
        report: Report = lambda line: None,
        page: Page | None = None,
        folders: tuple[Path, ...] = (),
    ) -> "ViewerApp":
        """Open a sequence file and serve its viewer.

        Args:
            path: The sequence file.
            project: The project file, begun if it is not there; None for the default place.
            host: The address to listen on; one that other computers can reach makes the url carry a token.
            port: 0 picks a free port; a busy one moves up to the next free one.
            device: Where to render and optimize, say `cpu` or `cuda`.
            inference: Who runs the surface network.
            weights: Weights files; a network that none is given of is the shipped one.
            report: Called with a line about what takes long.
            page: An empty page that is served already, and stays when the viewer is closed; None to serve a new one.
            folders: From where masks may be imported, besides the sequence's own folder.

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
            return cls(
                sequence,
                storage,
                host=host,
                port=port,
                device=device,
                inference=inference,
                weights=weights,
                report=report,
                page=page,
            )
        except BaseException:
            storage.close()
            raise

    def __enter__(self) -> "ViewerApp":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def state(self) -> ViewState:
        """The newest state; a snapshot that does not change."""
        return self._controller.state

    @property
    def notice(self) -> str | None:
        """What people must know of where corrections are kept, see `Storage.notice`; None if nothing."""
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
        with ExitStack() as stack:
            # From the last to the first, whatever fails.
            stack.callback(self._storage.close)
            stack.callback(self._session.close)
            stack.callback(self._controller.close)

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

    def _first_state(self) -> ViewState:
        sequence = self._session.sequence
        domain, camera = sequence.domains[0], sequence.scene.cameras[0].name
        frame = self._session.frame(0, domain, camera)
        pose = self._session.pose(frame)
        return ViewState(
            index=0,
            frame=frame,
            domain=domain,
            camera=camera,
            pose=pose,
            layer=Layer.MASK,
            opacity=0.5,
            settings=SurfaceSolver(),
            free=FreeParameters(),
            project=self.project.state,
        )

    def _prepare(self) -> None:
        """Load on the worker, with the page already up, what the first run will need."""
        try:
            self._optimizers.prepare()
        finally:
            self._worker.report(None)

    def _say(self, text: str) -> None:
        self._report(text)
        self._worker.report(text)

    def _on_drawn(self, tab: int) -> None:
        self.display.drawn(tab)
        self.queue.put(intents.Drawn())

    def _on_pointed(self, u: float, v: float, index: float) -> None:
        camera = self._camera(index)
        if camera is not None:
            self.queue.put(intents.PointAt(u * camera.width, v * camera.height, camera.name))

    def _on_activated(self, index: float) -> None:
        camera = self._camera(index)
        if camera is not None:
            self.queue.put(intents.ShowCamera(camera.name))

    def _camera(self, index: float) -> Camera | None:
        """The camera with this index; None where a tab names none."""
        return self.scene.cameras[int(index)] if index in range(len(self.scene.cameras)) else None

    def _on_painted(self, tab: int, text: str) -> None:
        try:
            cameras = {camera.name: camera for camera in self.scene.cameras}
            stroke = read_stroke(text, len(self.sequence), cameras)
        except CartsError as error:
            # Our page sends no such thing, and the other tabs did nothing wrong.
            _log.info("Refused: %s", error)
        else:
            self.queue.put(intents.Paint(tab, stroke))

    def _deliver(self, client_id: int, name: str, content: bytes) -> None:
        client = self.page.server.get_clients().get(client_id)
        if client is not None:
            client.send_file_download(name, content, save_immediately=True)
