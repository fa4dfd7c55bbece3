"""Interfaces of the site and of its pages, and a file browser."""

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from carts_core.errors import SettingsError
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.start.roots import MAX_ENTRIES, Entry, Roots
from carts_viewer.transport.document import Document
from carts_viewer.transport.page import Page


class SitePage(Protocol):
    """A page of the site, such as the start page; its methods are called on the site's thread."""

    def show(self) -> None:
        """Update the document."""

    def choose(self, name: str, value: str) -> None:
        """Carry out a choice in the document; a tab can send arbitrary strings."""

    def fail(self, error: Exception) -> None:
        """Show an error."""

    def close(self) -> None:
        """Close the page, keeping its draft."""


class Host(Protocol):
    """Interface of the site for its pages."""

    page: Page
    document: Document
    roots: Roots

    def post(self, job: Callable[[], None]) -> None:
        """Queue a function for the site's thread. Thread-safe."""

    @property
    def optimizers(self) -> OptimizerFactory:
        """The solver, whose process is started by the first task and ends with the shown page."""
        ...

    def show_start(self, problem: str = "") -> None:
        """Show the start page."""

    def show_recording(self, draft: str | None = None, source: Path | None = None) -> None:
        """Show the page *New recording* with a new or an existing draft, or a draft of a checked path."""

    def show_batch(self, folder: Path) -> None:
        """Show a batch, or the start page with an error if the batch cannot be read."""

    def open_sequence(self, path: Path, *, project: Path | None = None, frame: int | None = None) -> None:
        """Show the viewer of a sequence, or the start page with an error if the sequence cannot be opened."""

    def open_sample(self) -> None:
        """Open the shipped sequence."""


Wanted = Callable[[Entry], bool]
"""Function that returns whether a file may be picked."""


class FileBrowser:
    """File browser of the allowed folders; `files` in `templates/elements.html` shows it.

    Attributes:
        roots: the allowed folders.
        wanted: returns whether a file may be picked; other files are disabled.
        folders: whether a folder may be picked.
        purpose: instruction for the user.
        folder: the listed folder; None for the list of the allowed folders.
        problem: error of the last choice; empty if there was none.
    """

    most = MAX_ENTRIES

    def __init__(self, roots: Roots, *, wanted: Wanted, folders: bool, purpose: str) -> None:
        self.roots, self.wanted, self.folders, self.purpose = roots, wanted, folders, purpose
        self.folder: Path | None = roots.folders[0] if len(roots.folders) == 1 else None
        self.problem = ""

    def begin_in(self, folder: Path) -> None:
        """List this folder if it is allowed; otherwise, list the first allowed folder."""
        self.browse(str(folder))
        if self.problem:
            self.folder, self.problem = self.roots.folders[0], ""

    def browse(self, text: str) -> None:
        """List a folder, or, for an empty string, the allowed folders."""
        self.problem = ""
        try:
            folder = self.roots.checked(text) if text else None
            if folder is not None and not folder.is_dir():
                raise SettingsError(f"{folder} is not a folder.")
            self.folder = folder
        except SettingsError as error:
            self.problem = str(error)

    def picked(self, text: str) -> Path | None:
        """The picked path; None, with a `problem`, if it is not allowed."""
        self.problem = ""
        try:
            path = self.roots.checked(text)
            if path.is_dir() and not self.folders:
                raise SettingsError(f"{path} is a folder. Choose a file in it.")
            return path
        except SettingsError as error:
            self.problem = str(error)
            return None

    @property
    def parent(self) -> Path | None:
        """The folder above; None for the list of the allowed folders."""
        return None if self.folder is None else self.roots.parent(self.folder)

    @property
    def at_top(self) -> bool:
        """Whether the folder has no parent to list."""
        return self.parent is None and len(self.roots.folders) == 1

    def entries(self) -> list[Entry]:
        """Entries of the folder; none, with a `problem`, if it cannot be read."""
        try:
            return [] if self.folder is None else self.roots.entries(self.folder, self.wanted)
        except SettingsError as error:
            self.problem = str(error)
            return []
