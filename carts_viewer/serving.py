"""`carts view`: serves the viewer or the start page until a signal ends it."""

import html
import os
import signal
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import TYPE_CHECKING, Any, TextIO, Unpack

from carts_core.console import log_to_stderr, visible
from carts_core.errors import CartsError
from carts_core.files import write_text
from carts_viewer.app import ServerOptions, ViewerApp

if TYPE_CHECKING:
    from carts_viewer.start.site import Site


def serve(
    sequence: Path,
    *,
    project: Path | None = None,
    folders: tuple[Path, ...] = (),
    open_browser: bool = False,
    **options: Unpack[ServerOptions],
) -> None:
    """Serve the viewer of a sequence until Ctrl-C, SIGTERM or SIGHUP, then save; prints the address.

    Args:
        sequence: The sequence file.
        project: The project file, created if missing; None for the default path.
        folders: Folders for imports of masks, besides the sequence's own folder.
        open_browser: Open the page in the default browser.
        options: See `ServerOptions`.

    Raises:
        SystemExit: after a message on stderr, with code 2 if the sequence or an option is not usable, and with code 1
            if corrections could not be saved in the opened project.
    """
    began = time.monotonic()
    _serve(
        lambda: ViewerApp.open(sequence, project=project, folders=folders, report=_say_doing, **options),
        lambda: f"Ready after {time.monotonic() - began:.1f} s.",
        open_browser=open_browser,
    )


def serve_site(
    folders: Sequence[Path], *, batch: Path | None = None, open_browser: bool = False, **options: Unpack[ServerOptions]
) -> None:
    """Serve the start page, or a batch, until Ctrl-C, SIGTERM or SIGHUP, then save; prints the address.

    Args:
        folders: Folders that the page may read.
        batch: Folder of the batch that is shown first; None for the start page.
        open_browser: Open the page in the default browser.
        options: See `ServerOptions`.

    Raises:
        SystemExit: see `serve`.
    """
    # Not needed by the viewer of one sequence.
    from carts_viewer.start.site import Site  # noqa: PLC0415

    _serve(
        lambda: Site(folders, batch=batch, report=_say_doing, **options), lambda: "Ready.", open_browser=open_browser
    )


def _serve(opened: "Callable[[], ViewerApp | Site]", ready: Callable[[], str], *, open_browser: bool) -> None:
    """Open, serve, save and close; `ready` returns the message to print after opening. Errors as in `serve`."""
    log_to_stderr()
    with GracefulShutdown() as end:
        try:
            served = opened()
        except CartsError as error:
            print(f"error: {visible(str(error))}", file=sys.stderr)
            raise SystemExit(2) from error
        end.ready()
        browser = opened_in_browser(served.url) if open_browser else nullcontext()
        try:
            _say(f"{ready()} Open {served.url} in a browser. Press Ctrl-C to stop.")
            with browser:
                end.wait()
            _say("\nClosing.")
        finally:
            _close(served)


def _close(served: "ViewerApp | Site") -> None:
    """Save and close. Errors as in `serve`."""
    try:
        served.close()
        problem = served.storage_failure
    except CartsError as error:
        problem = f"error: {error}"
    if problem is not None:
        _say(visible(problem), sys.stderr)
        raise SystemExit(1)


def _say_doing(line: str) -> None:
    _say(f"  {visible(line)} …")


def _say(text: str, to: TextIO | None = None) -> None:
    """Print; ignores write errors on a closed terminal, as after SIGHUP."""
    stream: TextIO = to or sys.stdout
    try:
        print(text, file=stream, flush=True)
    except OSError:
        with suppress(OSError, ValueError):
            # Python flushes once more at the end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


_SIGNALS = [signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]


class GracefulShutdown:
    """Context in which SIGINT, SIGTERM and SIGHUP end `wait`.

    Until `ready`, a signal calls its previous handler or raises `KeyboardInterrupt`; afterwards it only ends `wait`, so
    that saving is not interrupted. Ignored signals (`nohup`) remain ignored, except SIGTERM.
    """

    def __init__(self) -> None:
        self._former: dict[int, Any] = {}
        self._ready = False
        # A handler may run between any two instructions and must not wait for a lock; writing a byte is safe.
        self._asked, self._ask = os.pipe()
        os.set_blocking(self._ask, False)

    def __enter__(self) -> "GracefulShutdown":
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
                    self._former[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._former.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        os.close(self._asked)
        os.close(self._ask)

    def ready(self) -> None:
        """Stop raising exceptions for signals; they end `wait` instead."""
        self._ready = True

    def wait(self) -> None:
        """Wait for a signal; return at once if a signal has arrived since `ready`."""
        os.read(self._asked, 1)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if not self._ready:
            former = self._former[number]
            if not callable(former):
                raise KeyboardInterrupt
            former(number, frame)
            return
        try:
            os.write(self._ask, b"x")
        except BlockingIOError:
            return  # The pipe is full of earlier requests.


_PAGE = '<!DOCTYPE html><meta charset="utf-8"><meta http-equiv="refresh" content="0; url={url}"><title>CaRTS</title>'


@contextmanager
def opened_in_browser(url: str) -> Iterator[None]:
    """Open a page in the default browser.

    Every user of this computer can read the command line of a browser. A URL with a token is therefore passed in a
    redirecting file in a private folder, which is removed at the end of the block.
    """
    if "token=" not in url:
        webbrowser.open(url)
        yield
        return
    with TemporaryDirectory(prefix="carts-") as folder:
        page = Path(folder) / "open.html"
        write_text(page, _PAGE.format(url=html.escape(url)))
        page.chmod(0o600)
        webbrowser.open(page.as_uri())
        yield
