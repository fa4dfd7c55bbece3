"""A running viewer of a tiny sequence, tabs in a real browser, and a controller without either."""

import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
import torch
from playwright.sync_api import Browser, expect, sync_playwright
from viewer_desk import Desk
from viewer_tab import OpenTab, OpenViewer, Tab, mark_frames, new_context
from waiting import PATIENCE

from carts_core.networks.network import FeatureNetwork
from carts_core.networks.weights import save_weights
from carts_core.settings import Architecture
from carts_viewer import editing
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.jobs.optimizers import NetworkOptions
from carts_viewer.jobs.solver_process import Requests, SolverProcess

FLAGS = (
    "--no-sandbox --disable-quic --no-first-run --disable-background-networking --disable-component-update "
    "--disable-sync"
).split()

# Without a graphics card, and on a busy machine, a page may need long.
expect.set_options(timeout=1000 * PATIENCE)


@pytest.fixture(scope="session")
def untrained_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of a small untrained network: its features are edges and blobs, which is enough to optimize on."""
    path = tmp_path_factory.mktemp("weights") / "untrained.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        save_weights(FeatureNetwork(Architecture()).eval(), path, {}, (320, 240))
    return path


@pytest.fixture(scope="session")
def solver() -> Iterator[SolverProcess]:
    """The process of the solver, which the viewers share."""
    with closing(SolverProcess()) as process:
        yield process


@pytest.fixture
def open_viewer(
    tiny_sequence: Callable[..., Path], untrained_weights: Path, solver: SolverProcess
) -> Iterator[OpenViewer]:
    """Opens the viewer of a tiny sequence; further options are those of `tiny_sequence`.

    `prepare` gets the sequence's folder before it is opened, `networks` the options of the networks. A `marked` one
    has discs in its frames, an uneven lens whose centre is not the image's, and a solid mask.
    """

    def uneven(text: str) -> str:
        return re.sub(r"K = .*", "K = [[390.0, 0.0, 130.0], [0.0, 372.0, 128.0], [0.0, 0.0, 1.0]]", text)

    with ExitStack() as stack:

        def make(
            prepare: Callable[[Path], object] = lambda folder: None,
            *,
            marked: bool = False,
            networks: NetworkOptions | None = None,
            solver: Requests = solver,
            **options,
        ) -> ViewerApp:
            if marked:
                options |= {"width": 320, "height": 240, "edit": uneven, "masks": False}
            path = tiny_sequence(**options)
            (mark_frames if marked else prepare)(path.parent)
            chosen: NetworkOptions = {"weights": (untrained_weights,), **(networks or {})}
            app = stack.enter_context(ViewerApp.open(path, port=0, solver=solver, **chosen))
            if marked:
                app.queue.put(intents.SetOpacity(1.0))
            app.wait_until_shown()
            return app

        yield make


@pytest.fixture(scope="module")
def shared_viewer(
    shared_sequence: Callable[..., Path], untrained_weights: Path, solver: SolverProcess
) -> Iterator[ViewerApp]:
    """Viewer of a tiny sequence, for tests that do not change it."""
    with ViewerApp.open(shared_sequence(), port=0, solver=solver, weights=(untrained_weights,)) as app:
        app.wait_until_shown()
        yield app


@pytest.fixture
def desk(tiny_sequence: Callable[..., Path], untrained_weights: Path) -> Desk:
    """A controller with three frames of two cameras in two domains."""
    path = tiny_sequence(frames=3, cameras=("left", "right"), domains=("regular", "smoke"))
    return Desk.open(path, weights=(untrained_weights,))


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Headless Chromium: `CARTS_CHROMIUM`, or the one on the path."""
    executable = os.environ.get("CARTS_CHROMIUM") or shutil.which("chromium")
    if executable is None:
        pytest.skip("no Chromium: set CARTS_CHROMIUM to its executable")
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=executable, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def open_tab(browser: Browser, open_viewer: OpenViewer, monkeypatch: pytest.MonkeyPatch) -> Iterator[OpenTab]:
    """Opens a tab of a viewer, in a window of any size, when the first picture is there.

    However slow a drag is, its edit is saved when it is let go of, and not before.

    Without a viewer one is opened, with the options of `open_viewer`. The browser has seen the page before, unless it
    is a `new` one. `asked` gets every address that the page asks for; `query` is appended to the page's address.
    """
    monkeypatch.setattr(editing, "MAX_DRAFT_SECONDS", 1e6)
    with ExitStack() as stack:

        def make(
            app: ViewerApp | None = None,
            window: tuple[int, int] = (1100, 720),
            *,
            new: bool = False,
            asked: list[str] | None = None,
            query: str = "",
            **options,
        ) -> Tab:
            app = app or open_viewer(**options)
            context = stack.enter_context(closing(new_context(browser, window)))
            if not new:
                context.add_init_script("localStorage.setItem('carts-tour', 'seen')")
            page = context.new_page()
            if asked is not None:
                page.on("request", lambda request: asked.append(request.url))
            page.goto(app.url + query)
            tab = Tab(app, page)
            tab.wait_until_ready()
            return tab

        yield make
