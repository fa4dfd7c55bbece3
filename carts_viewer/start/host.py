"""What a place may ask of the site that it is shown on."""

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from carts_core.settings.optimization import Inference
from carts_viewer.start.roots import Roots
from carts_viewer.transport.document import Document
from carts_viewer.transport.page import Page


class Place(Protocol):
    """What a page shows at one time. Everything but the constructor is called on the site's thread."""

    def show(self) -> None:
        """Bring the document up to date."""

    def choose(self, name: str, value: str) -> None:
        """Do what somebody has chosen in the document; any two texts."""

    def click(self, u: float, v: float) -> None:
        """Somebody has clicked in the image; shares of its width and height."""

    def fail(self, error: Exception) -> None:
        """Show what went wrong."""

    def close(self) -> None:
        """Keep what is to be kept."""


class Host(Protocol):
    """The site as its places see it."""

    page: Page
    document: Document
    roots: Roots
    device: str
    inference: Inference
    weights: tuple[Path, ...]

    def post(self, job: Callable[[], None]) -> None:
        """Do something on the site's thread, after everything that was asked for before. Any thread may ask."""

    def show_start(self, problem: str = "") -> None:
        """Go to the start page."""

    def show_recording(self, draft: str | None = None) -> None:
        """Go to New recording: a new one, or a draft that is there."""

    def show_batch(self, folder: Path) -> None:
        """Go to a batch; if it cannot be read, to the start page with the reason."""

    def open_sequence(self, path: Path, *, project: Path | None = None, frame: int | None = None) -> None:
        """Go to the viewer of a sequence; if it cannot be opened, to the start page with the reason.

        Args:
            path: the sequence file.
            project: its project; None for the default one.
            frame: index of the frame to begin with; None for the first.
        """

    def open_sample(self) -> None:
        """Open the shipped sequence."""
