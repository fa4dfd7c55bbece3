"""Interfaces of the site and of its places, and a file browser."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from carts_core.errors import SettingsError
from carts_core.networks import FeatureExtractor
from carts_viewer.start.roots import MOST_ENTRIES, Entry, Roots
from carts_viewer.transport.document import Document, alert, button, escaped
from carts_viewer.transport.page import Page


class Place(Protocol):
    """A view of the site, such as the start page. Everything but the constructor is called on the site's thread."""

    def show(self) -> None:
        """Update the document."""

    def choose(self, name: str, value: str) -> None:
        """Carry out a choice in the document; a tab can send any two texts."""

    def click(self, u: float, v: float) -> None:
        """Handle a click in the image, at shares of its width and height."""

    def fail(self, error: Exception) -> None:
        """Show what went wrong."""

    def close(self) -> None:
        """Keep what is to be kept."""


class Host(Protocol):
    """The site as its places see it."""

    page: Page
    document: Document
    roots: Roots

    def post(self, job: Callable[[], None]) -> None:
        """Queue a function for the site's thread. Any thread may call this."""

    def load_networks(self) -> FeatureExtractor:
        """Load the networks. Any thread may ask.

        Raises:
            WeightsError: they cannot be loaded.
        """
        ...

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


Wanted = Callable[[Entry], bool]
"""Whether a file may be picked."""


class FileBrowser:
    """File browser of the allowed folders.

    Attributes:
        folder: what is listed; None for the list of the allowed folders.
        problem: why the last choice was not possible; empty if it was.
    """

    def __init__(self, roots: Roots, *, wanted: Wanted, folders: bool, purpose: str) -> None:
        """
        Args:
            roots: the allowed folders.
            wanted: which files may be picked; others are shown greyed out.
            folders: whether a folder may be picked.
            purpose: instruction for the user.
        """
        self._roots = roots
        self._wanted = wanted
        self._pick_folders = folders
        self._purpose = purpose
        self.folder: Path | None = roots.folders[0] if len(roots.folders) == 1 else None
        self.problem = ""

    def begin_in(self, folder: Path) -> None:
        """List this folder, if it is one that may be looked into."""
        self.browse(str(folder))
        if self.problem:
            self.folder, self.problem = self._roots.folders[0], ""

    def browse(self, text: str) -> None:
        """Go to a folder; "" is the list of the allowed ones."""
        self.problem = ""
        try:
            folder = self._roots.checked(text) if text else None
            if folder is not None and not folder.is_dir():
                raise SettingsError(f"{folder} is no folder.")
            self.folder = folder
        except SettingsError as error:
            self.problem = str(error)

    def picked(self, text: str) -> Path | None:
        """The path that a person has picked; None, with a `problem`, if it cannot be."""
        self.problem = ""
        try:
            path = self._roots.checked(text)
            if path.is_dir() and not self._pick_folders:
                raise SettingsError(f"{path} is a folder. Choose a file in it.")
            return path
        except SettingsError as error:
            self.problem = str(error)
            return None

    def html(self) -> str:
        """The list; its choices are `browse` and `pick`, each with a path."""
        problem = alert(self.problem)
        if self.folder is None:
            rows = [_row("browse", str(root), str(root), "") for root in self._roots.folders]
            return f'{problem}<p>{escaped(self._purpose)}</p><div class="files">{"".join(rows)}</div>'
        try:
            entries = self._roots.entries(self.folder)
        except SettingsError as error:
            entries, problem = [], alert(error)
        rows = [
            _row("browse", str(entry.path), f"{entry.name}/", "folder")
            if entry.is_folder
            else _row("pick", str(entry.path), entry.name, _about(entry), off=not self._wanted(entry))
            for entry in entries
        ]
        if not rows:
            rows = ["<p>This folder is empty.</p>"]
        if len(entries) >= MOST_ENTRIES:
            rows.append(f"<p>Only the first {MOST_ENTRIES} are listed.</p>")
        return f"{problem}{self._head()}<div class='files' data-scroll='files'>{''.join(rows)}</div>"

    def _head(self) -> str:
        assert self.folder is not None
        parent = self._roots.parent(self.folder)
        above = "" if parent is None else str(parent)
        up = button("browse", "↑ Up", above, disabled=parent is None and len(self._roots.folders) == 1)
        pick = button("pick", "Choose this folder", str(self.folder), kind="main") if self._pick_folders else ""
        where = f"<code>{escaped(self.folder)}</code>"
        return f'<p>{escaped(self._purpose)}</p><div class="bar">{up}{where}<span class="far">{pick}</span></div>'


def _row(action: str, path: str, name: str, about: str, *, off: bool = False) -> str:
    return (
        f'<button type="button" data-do="{action}" data-value="{escaped(path)}"{" disabled" if off else ""}>'
        f"<span>{escaped(name)}</span><span>{escaped(about)}</span></button>"
    )


def _about(entry: Entry) -> str:
    return f"{_size(entry.size)} · {_day(entry.changed)}"


def _size(count: int) -> str:
    size = float(count)
    for unit in ("B", "KB", "MB", "GB"):
        if size < 1000 or unit == "GB":
            break
        size /= 1000
    return f"{size:.0f} {unit}" if unit in ("B", "KB") else f"{size:.1f} {unit}"


def _day(seconds: float) -> str:
    return time.strftime("%Y-%m-%d", time.localtime(seconds))
