"""`carts view`: serves the viewer of a sequence until somebody ends it."""

import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, TextIO, TypeVar

from carts_core.console import log_to_stderr, visible
from carts_core.errors import CartsError
from carts_core.segmentation import Segmenter
from carts_core.settings.optimization import Inference
from carts_viewer.app import ViewerApp
from carts_viewer.ending import EndRequest
from carts_viewer.opening import opened_in_browser
from carts_viewer.transport.guard import check_address

if TYPE_CHECKING:
    from carts_viewer.start.site import Site

Served = TypeVar("Served", ViewerApp, "Site")


def serve(
    sequence_path: Path,
    *,
    project: Path | None = None,
    folders: Sequence[Path] = (),
    host: str = "127.0.0.1",
    port: int = 8080,
    device: str = "cpu",
    inference: Inference = "auto",
    weights: tuple[Path, ...] = (),
    segmenter: Segmenter | None = None,
    open_browser: bool = False,
) -> None:
    """Serve the viewer of a sequence until Ctrl-C, SIGTERM or SIGHUP, then save; prints where it is.

    Args:
        sequence_path: The sequence file.
        project: The project file, begun if it is not there; None for the default place.
        folders: From where masks may be imported, besides the sequence's own folder.
        host: The address to listen on; one that other computers can reach makes the url carry a token.
        port: 0 picks a free port; a busy one moves up to the next free one.
        device: Where the networks run, say `cpu` or `cuda`.
        inference: Who runs the surface network.
        weights: Weights files; a network that none is given of is the shipped one.
        segmenter: Segments what people point at; None for the one that ships.
        open_browser: Open the page in the default browser.

    Raises:
        SystemExit: after a message on stderr, with code 2 when the sequence or an option is not usable, and with code 1
            when corrections could not be saved, or not in the project that was opened.
    """
    began = time.monotonic()
    _serve(
        lambda: ViewerApp.open(
            sequence_path,
            project=project,
            host=host,
            port=port,
            device=device,
            inference=inference,
            weights=weights,
            segmenter=segmenter,
            report=_say_doing,
            folders=tuple(folders),
        ),
        lambda: f"Ready after {time.monotonic() - began:.1f} s.",
        lambda app: app.project.incident,
        open_browser=open_browser,
    )


def serve_site(
    folders: Sequence[Path],
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    device: str = "cpu",
    inference: Inference = "auto",
    weights: tuple[Path, ...] = (),
    segmenter: Segmenter | None = None,
    open_browser: bool = False,
    batch: Path | None = None,
) -> None:
    """Serve the start page, or a batch, until Ctrl-C, SIGTERM or SIGHUP, then save; prints where it is.

    Args:
        folders: What the page may look into, and nothing outside.
        host: The address to listen on; one that other computers can reach makes the url carry a token.
        port: 0 picks a free port; a busy one moves up to the next free one.
        device: Where the networks run, say `cpu` or `cuda`.
        inference: Who runs the surface network.
        weights: Weights files; a network that none is given of is the shipped one.
        segmenter: Segments what people point at; None for the one that ships.
        open_browser: Open the page in the default browser.
        batch: Folder of the batch that is shown first; None for the start page.

    Raises:
        SystemExit: as `serve`.
    """
    # A viewer of one sequence does without.
    from carts_viewer.start.site import Site  # noqa: PLC0415

    def opened() -> Site:
        check_address(host, port)
        return Site(
            folders,
            host=host,
            port=port,
            device=device,
            inference=inference,
            weights=weights,
            segmenter=segmenter,
            report=_say_doing,
            batch=batch,
        )

    _serve(opened, lambda: "Ready.", lambda site: site.incident, open_browser=open_browser)


def _serve(
    opened: Callable[[], Served],
    ready: Callable[[], str],
    incident: Callable[[Served], str | None],
    *,
    open_browser: bool,
) -> None:
    """Open, serve, save and close.

    Args:
        opened: Opens it.
        ready: What to say when it is open.
        incident: Where corrections are kept instead, or why they are not; None where all is well.
        open_browser: Open the page in the default browser.

    Raises:
        SystemExit: see `serve`.
    """
    log_to_stderr()
    with EndRequest() as end:
        try:
            served = opened()
        except CartsError as error:
            print(f"error: {visible(str(error))}", file=sys.stderr)
            raise SystemExit(2) from error
        end.ready()
        browser = opened_in_browser(served.url) if open_browser else nullcontext()
        try:
            _say(f"{ready()} Open {served.url} in a browser; Ctrl-C ends.")
            with browser:
                end.wait()
            _say("\nClosing.")
        finally:
            _close(served, lambda: incident(served))


def _close(served: "ViewerApp | Site", incident: Callable[[], str | None]) -> None:
    """Save and close.

    Args:
        served: What is open.
        incident: Where corrections are kept instead, or why they are not; None where all is well.

    Raises:
        SystemExit: see `serve`.
    """
    try:
        served.close()
        problem = incident()
    except CartsError as error:
        problem = f"error: {error}"
    if problem is not None:
        _say(visible(problem), sys.stderr)
        raise SystemExit(1)


def _say_doing(line: str) -> None:
    _say(f"  {visible(line)} …")


def _say(text: str, to: TextIO | None = None) -> None:
    """Print; a terminal that is gone, as it is after SIGHUP, keeps nothing from being saved."""
    stream: TextIO = to or sys.stdout
    try:
        print(text, file=stream, flush=True)
    except OSError:
        with suppress(OSError, ValueError):
            # Python flushes once more at the end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
