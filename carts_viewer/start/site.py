"""One server for the start page, a new recording, a batch, and the viewer of a sequence."""

import gc
import logging
import queue
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Unpack

import viser

from carts_core.errors import CartsError
from carts_core.process import return_memory
from carts_core.resources import sample_sequence
from carts_viewer.actions import intents
from carts_viewer.app import ServerOptions, ViewerApp
from carts_viewer.jobs.optimizers import NetworkOptions, OptimizerFactory
from carts_viewer.jobs.solver_process import Requests, SolverProcess
from carts_viewer.start.batch_page import BatchPage
from carts_viewer.start.host import SitePage
from carts_viewer.start.roots import Roots
from carts_viewer.start.start_page import StartPage, remember
from carts_viewer.transport.document import Document, render
from carts_viewer.transport.events import Chosen
from carts_viewer.transport.page import Page

_log = logging.getLogger(__name__)


class Site:
    """Server of one page: start page, new recording, batch or viewer.

    Attributes:
        page: the page.
        document: the document over the page.
        roots: the allowed folders.
        shown: the shown page; None while a sequence is open.
        app: the viewer of the open sequence, if there is one.
        url: address of the page.
        storage_failure: message that names the file with the corrections of a closed sequence, if it is not its
            project.
    """

    def __init__(
        self,
        folders: Sequence[Path],
        *,
        batch: Path | None = None,
        report: Callable[[str], None] = lambda line: None,
        solver: Requests | None = None,
        **options: Unpack[ServerOptions],
    ) -> None:
        """Start serving the start page, or a batch.

        Args:
            folders: the allowed folders.
            batch: folder of the batch that is shown first.
            report: called with a line for the user about long operations.
            solver: the solver, which remains after the site is closed; None for a process for each shown page.
            options: see `ServerOptions`.

        Raises:
            SettingsError: a folder does not exist, or the address is not usable.
        """
        self.roots = Roots(folders)
        self.page = Page(
            host=options.get("host", "127.0.0.1"),
            port=options.get("port", 8080),
            title="CaRTS",
            proxy=options.get("proxy"),
        )
        self.document = Document(self.page)
        self._report, self._options = report, options
        self._solver = solver
        self._own_solver: SolverProcess | None = None
        self.url = self.page.url
        self.app: ViewerApp | None = None
        self.storage_failure: str | None = None
        self.shown: SitePage | None = None
        self._listen()
        # A loaded page shows the present state of the jobs.
        self.page.server.on_client_connect(lambda _: self.post(self._refresh))
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="carts-site", daemon=True)
        self._thread.start()
        self.post(self.show_start if batch is None else lambda: self.show_batch(batch))

    def __enter__(self) -> "Site":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def post(self, job: Callable[[], None]) -> None:
        """Queue a function for the site's thread. Thread-safe."""
        self._jobs.put(job)

    def wait(self, timeout: float = 120.0) -> None:
        """Wait until all requests so far are done.

        Raises:
            TimeoutError: the site is still busy after `timeout` [s].
        """
        done = threading.Event()
        self.post(done.set)
        if not done.wait(timeout):
            raise TimeoutError(f"The page was still busy after {timeout} s.")

    def close(self) -> None:
        """Save and stop the server.

        Raises:
            ProjectError: corrections could not be saved.
        """
        self._jobs.put(None)
        self._thread.join(timeout=60.0)
        try:
            self._leave()
        finally:
            self.page.close()

    @property
    def optimizers(self) -> OptimizerFactory:
        """See `Host.optimizers`."""
        networks = {name: value for name, value in self._options.items() if name in NetworkOptions.__annotations__}
        self._own_solver = None if self._solver else self._own_solver or SolverProcess()
        requests = self._solver or self._own_solver
        return OptimizerFactory(report=self._report, requests=requests, **networks)  # pyright: ignore[reportArgumentType]

    def show_start(self, problem: str = "") -> None:
        """Show the start page."""
        self._show(lambda: StartPage(self, problem))

    def show_recording(self, draft: str | None = None, source: Path | None = None) -> None:
        """See `Host.show_recording`."""
        # Its calibration imports torch and SciPy, which a batch and a sequence do not need.
        from carts_viewer.wizard.wizard import RecordingWizard  # noqa: PLC0415

        self._show(lambda: RecordingWizard(self, draft, source))

    def open_sample(self) -> None:
        """Open the shipped sequence."""
        self.open_sequence(sample_sequence())

    def show_batch(self, folder: Path) -> None:
        """Show a batch, or the start page with an error if the batch cannot be read."""
        try:
            self._show(lambda: BatchPage(self, folder))
        except CartsError as error:
            self.show_start(str(error))

    def open_sequence(self, path: Path, *, project: Path | None = None, frame: int | None = None) -> None:
        """See `Host.open_sequence`."""
        self.document.show(render("message.html", title=f"Opening {path.name}", text="This takes a few seconds."))
        try:
            self._leave()
            self._listening = False
            self.page.clear(f"{path.stem} · CaRTS")
            app = ViewerApp.open(
                path,
                project=project,
                report=self._report,
                page=self.page,
                folders=self.roots.given,
                solver=self._solver,
                **self._options,
            )
        except CartsError as error:
            self._report(str(error))
            self.show_start(str(error))
            return
        back = self.page.server.gui.add_button("All recordings", icon=viser.Icon.ARROW_LEFT, color="gray", order=-1.0)
        back.on_click(lambda _: self.post(self.show_start))
        self.app = app
        if frame is not None:
            app.queue.put(intents.ShowFrame(frame))
        with suppress(CartsError):
            remember(app)
        self.document.show("")
        self.page.reload()

    def _show(self, make: Callable[[], SitePage]) -> None:
        """Close the shown page, and show another page."""
        self._leave()
        again = not self._listening
        if again:
            self.page.clear("CaRTS")
            self._listen()
        self.shown = make()
        self.shown.show()
        if again:
            self.page.reload()

    def _refresh(self) -> None:
        if isinstance(self.shown, BatchPage):
            self.shown.show()

    def _listen(self) -> None:
        """Prepare an empty page for documents."""
        self.page.server.gui.configure_theme(dark_mode=True, show_share_button=False, show_logo=False)
        self.page.listen(Chosen, lambda _, event: self.post(lambda: self._dispatch(event)))
        self._listening = True

    def _dispatch(self, event: Chosen) -> None:
        page = self.shown
        if page is None:
            return
        try:
            page.choose(event.name, event.value)
        except Exception as error:
            if not isinstance(error, CartsError):
                _log.exception("Unexpected error in the page")
            if self.shown is page:
                page.fail(error)
            else:
                # Another page was being made.
                self.show_start(str(error) or type(error).__name__)

    def _leave(self) -> None:
        page, self.shown = self.shown, None
        app, self.app = self.app, None
        if page is not None:
            page.close()
        if self._own_solver is not None:
            self._own_solver.close()
            self._own_solver = None
        if app is not None:
            try:
                app.close()
            finally:
                self.storage_failure = app.project.storage_failure or self.storage_failure
                # Unfinished edits are saved by now.
                with suppress(CartsError):
                    remember(app)
                del app
                gc.collect()
                return_memory()

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except Exception as error:
                _log.exception("Unexpected error in the page")
                with suppress(Exception):
                    self.show_start(f"{type(error).__name__}: {error}")
