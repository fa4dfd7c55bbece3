"""A running viewer of a tiny sequence, a tab without a browser, and a real browser."""

import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import torch
from playwright.sync_api import Browser, expect, sync_playwright
from viewer_canvas import Canvas, mark_frames
from viewer_desk import Desk
from viewer_tab import Tab

from carts_core.networks.network import FeatureNetwork
from carts_core.networks.weights import save_weights
from carts_core.project import Project
from carts_core.recording import Sequence
from carts_core.settings import Architecture
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.jobs.optimizers import OptimizerFactory

FLAGS = (
    "--no-sandbox --disable-quic --no-first-run --disable-background-networking --disable-component-update "
    "--disable-sync"
).split()

# Without a graphics card, and with others at work, a page may need long for what a person sees at once.
_LONGEST, _LONGEST_EXPECTED = 90_000, 20_000
"""Waits for the page, and for what a test expects of it [ms]."""
expect.set_options(timeout=_LONGEST_EXPECTED)


@pytest.fixture(scope="session")
def untrained_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of a small untrained network: its features are edges and blobs, which is enough to optimize on."""
    path = tmp_path_factory.mktemp("weights") / "untrained.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        save_weights(FeatureNetwork(Architecture()).eval(), path, {}, (320, 240))
    return path


@pytest.fixture
def open_viewer(tiny_sequence: Callable[..., Path], untrained_weights: Path) -> Iterator[Callable[..., ViewerApp]]:
    """Opens the viewer of a tiny sequence; arguments are those of `tiny_sequence`, and
    `prepare`, which gets the sequence's folder before it is opened."""
    with ExitStack() as stack:

        def make(prepare: Callable[[Path], None] = lambda folder: None, **options) -> ViewerApp:
            path = tiny_sequence(**options)
            prepare(path.parent)
            app = stack.enter_context(ViewerApp.open(path, port=0, weights=(untrained_weights,)))
            app.wait_until_shown(60)
            return app

        yield make


@pytest.fixture
def desk(tiny_sequence: Callable[..., Path], untrained_weights: Path) -> Desk:
    """A controller with three frames of two cameras in two domains."""
    sequence = Sequence.open(tiny_sequence(frames=3, cameras=("left", "right"), domains=("regular", "smoke")))
    factory = OptimizerFactory(weights=(untrained_weights,), report=lambda line: None)
    return Desk(sequence, Project.open(sequence), factory)


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
def open_tab(browser: Browser) -> Iterator[Callable[..., Tab]]:
    """Opens a tab of a viewer, in a window of any size, when the first picture is there.

    The browser has seen the page before, unless it is a `new` one. `asked` gets every address that the page asks for.
    """
    with ExitStack() as stack:

        def make(
            app: ViewerApp, window: tuple[int, int] = (1280, 800), *, new: bool = False, asked: list[str] | None = None
        ) -> Tab:
            context = browser.new_context(viewport={"width": window[0], "height": window[1]}, accept_downloads=True)
            stack.callback(context.close)
            context.set_default_timeout(_LONGEST)
            if not new:
                context.add_init_script("localStorage.setItem('carts-tour', 'seen')")
            page = context.new_page()
            if asked is not None:
                page.on("request", lambda request: asked.append(request.url))
            page.goto(app.url)
            tab = Tab(app, page, Canvas(app, page))
            tab.wait_until_ready()
            return tab

        yield make


@pytest.fixture
def open_marked(open_viewer: Callable[..., ViewerApp]) -> Callable[..., ViewerApp]:
    """Opens a viewer whose frames carry discs, through an uneven lens off the centre, with a solid mask on top."""

    def uneven(text: str) -> str:
        return re.sub(r"K = .*", "K = [[390.0, 0.0, 130.0], [0.0, 372.0, 128.0], [0.0, 0.0, 1.0]]", text)

    def make() -> ViewerApp:
        app = open_viewer(width=320, height=240, edit=uneven, masks=False, prepare=mark_frames)
        app.queue.put(intents.SetOpacity(1.0))
        app.wait_until_shown()
        return app

    return make
