"""The start page: recent recordings, unfinished imports, the sample, and a file browser."""

import json
import os
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Annotated

import msgspec

from carts_core.batch.folder import is_batch
from carts_core.errors import CartsError
from carts_core.files import write_bytes, write_text
from carts_core.files.reading import TABLE, is_regular, parse_json, read_bytes, read_text, typed
from carts_core.project import ProjectState, ReviewState, read_state
from carts_core.project.file import LOG, beside
from carts_core.project.identity import data_dir
from carts_viewer.app import ViewerApp
from carts_viewer.jobs.companions import set_aside_damaged
from carts_viewer.picture.layers import small_jpeg
from carts_viewer.start.host import FileBrowser, Host, SitePage, Wanted
from carts_viewer.start.uploads import Uploads
from carts_viewer.transport.document import render

_MAX_RECENT = 24
_WIDTH = 320
"""Width of a thumbnail [px]."""
_DONE = frozenset({ReviewState.ACCEPTED, ReviewState.REJECTED})
_Count = Annotated[int, msgspec.Meta(ge=0)]


@dataclass(frozen=True)
class RecentProject:
    """Recently opened sequence."""

    sequence: str
    """Path of the sequence file."""
    name: str
    project: str
    """Path of the project file."""
    frames: _Count
    reviewed: _Count
    """Number of accepted or rejected frames."""
    corrected: _Count
    """Number of frames with corrected joints."""
    changed: Annotated[float, msgspec.Meta(ge=0, le=1e11)]
    """Time of the last change or use of the project [s since 1970]."""

    @property
    def thumbnail(self) -> Path:
        """Path of the thumbnail, which may not exist."""
        return _folder() / f"{sha256(self.sequence.encode()).hexdigest()[:16]}.jpg"


def recent_projects() -> list[RecentProject]:
    """Projects with existing sequence files, newest first; empty if the list cannot be read."""
    try:
        return [each for each in _read() if is_regular(Path(each.sequence))]
    except (OSError, ValueError):
        return []


def set_damaged_aside() -> str:
    """Set a damaged list aside; returns a message for the user, empty if the list is not damaged."""
    try:
        _read()
    except (OSError, ValueError) as error:
        return set_aside_damaged(_list(), "list of recent recordings", error, "A new list was started")
    return ""


def _read() -> list[RecentProject]:
    """Read the list.

    Raises:
        OSError, ValueError: the list is damaged.
    """
    try:
        return typed(parse_json(read_text(_list(), TABLE)), list[RecentProject])
    except FileNotFoundError:
        return []


def up_to_date(project: RecentProject) -> RecentProject:
    """The entry with its counts of reviewed and corrected frames, read again if the project file has changed.

    Raises:
        ProjectError: the project cannot be read.
    """
    path = Path(project.project)
    if not is_regular(path):
        return replace(project, reviewed=0, corrected=0)
    stamp = _changed(path), _changed(beside(path, LOG))
    # An unchanged project is not read again.
    if max(stamp) <= project.changed:
        return project
    reviewed, corrected = _read_counts(path, stamp)
    return replace(project, reviewed=reviewed, corrected=corrected, changed=max(stamp))


@lru_cache(maxsize=_MAX_RECENT)
def _read_counts(path: Path, stamp: tuple[float, float]) -> tuple[int, int]:
    return _counts(read_state(path))


def _counts(state: ProjectState) -> tuple[int, int]:
    """Numbers of reviewed and corrected frames."""
    frames = range(len(state.identity.frame_ids))
    reviewed = sum(state.review(index).state in _DONE for index in frames)
    return reviewed, sum(bool(state.joints(index)) for index in frames)


def _changed(path: Path) -> float:
    """Modification time of a file [s since 1970]; 0 if it does not exist."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def thumbnail(project: RecentProject) -> bytes | None:
    """Thumbnail of a project as a JPEG file; None if there is none."""
    try:
        return read_bytes(project.thumbnail, TABLE)
    except (CartsError, OSError):
        return None


def remember(app: ViewerApp) -> None:
    """Move the sequence of a viewer, open or closed, to the head of the list."""
    reviewed, corrected = _counts(app.project.state)
    entry = RecentProject(
        sequence=str(app.sequence.path),
        name=app.sequence.name,
        project=str(app.project.path),
        frames=len(app.sequence),
        reviewed=reviewed,
        corrected=corrected,
        changed=time.time(),
    )
    _write([entry, *(each for each in recent_projects() if each.sequence != entry.sequence)])
    write_bytes(entry.thumbnail, small_jpeg(app.state.frame.images[app.state.camera], width=_WIDTH))


def forget(sequence: str) -> None:
    """Remove a sequence from the list; its files are kept."""
    _write(each for each in recent_projects() if each.sequence != sequence)


def _write(projects: Iterable[RecentProject]) -> None:
    set_damaged_aside()
    write_text(_list(), json.dumps([asdict(each) for each in projects][:_MAX_RECENT], indent=1))


def _folder() -> Path:
    return data_dir() / "recent"


def _list() -> Path:
    return _folder() / "recent.json"


class StartPage(SitePage):
    """Cards of recent recordings, unfinished imports, the sample, and a file browser."""

    def __init__(self, site: Host, problem: str = "") -> None:
        self._site = site
        self._problem = problem or set_damaged_aside()
        self._browser: FileBrowser | None = None
        self._path = ""
        """The newest typed path."""
        self._uploads = Uploads(site.roots.folders[0])
        site.page.receive_upload = self._uploads.serve

    def show(self) -> None:
        """Update the document."""
        # The wizard's calibration imports torch, which the list of recent recordings does not need.
        from carts_viewer.wizard.draft import drafts  # noqa: PLC0415

        content = render(
            "start.html",
            problem=self._problem,
            browser=self._browser,
            path=self._path,
            drafts=drafts(),
            cards=[self._card(project) for project in recent_projects()],
            root=self._site.roots.folders[0],
            uploads=self._uploads.root,
            ago=_ago,
        )
        self._site.document.show(content)

    def choose(self, name: str, value: str) -> None:
        """Carry out a choice of the user."""
        self._problem = ""
        browser = self._browser
        match name:
            case "new":
                return self._site.show_recording()
            case "draft":
                return self._site.show_recording(value)
            case "delete-draft":
                from carts_viewer.wizard.draft import delete_draft  # noqa: PLC0415

                delete_draft(value)
            case "sample":
                return self._site.open_sample()
            case "recent" if value in (known := {project.sequence: project.project for project in recent_projects()}):
                own = Path(known[value])
                return self._site.open_sequence(Path(value), project=own if is_regular(own) else None)
            case "forget":
                forget(value)
            case "open-path":
                self._path = value
                return self._open(self._site.roots.checked(os.path.expanduser(value.strip())))
            case "open":
                self._toggle("Choose a sequence file (.toml).", lambda entry: entry.path.suffix.lower() == ".toml")
            case "open-batch":
                self._toggle("Choose the output folder of carts batch.", lambda _: False, folders=True)
            case "close-browser":
                self._browser = None
            case "browse" if browser is not None:
                browser.browse(value)
            case "pick" if browser is not None and (path := browser.picked(value)) is not None:
                return self._site.show_batch(path) if path.is_dir() else self._site.open_sequence(path)
        self.show()

    def _open(self, path: Path) -> None:
        """Open a sequence file, a folder that contains one, a batch, or another path as a new recording."""
        inside = path / "sequence.toml"
        if is_regular(inside) or path.suffix.lower() == ".toml":
            return self._site.open_sequence(inside if path.is_dir() else path)
        return self._site.show_batch(path) if is_batch(path) else self._site.show_recording(source=path)

    def _toggle(self, purpose: str, wanted: Wanted, *, folders: bool = False) -> None:
        new = FileBrowser(self._site.roots, wanted=wanted, folders=folders, purpose=purpose)
        self._browser = None if self._browser is not None else new

    def fail(self, error: Exception) -> None:
        """Show an error."""
        self._problem = str(error) or type(error).__name__
        self.show()

    def close(self) -> None:
        """End the running upload, and accept no more uploads."""
        self._site.page.receive_upload = None
        self._uploads.close()

    def _card(self, project: RecentProject) -> tuple[RecentProject, str, str]:
        """Current entry of a project, the error if the project cannot be read, and the URL of the thumbnail."""
        jpeg = thumbnail(project)
        picture = "" if jpeg is None else self._site.page.media.publish(jpeg)
        try:
            return up_to_date(project), "", picture
        except CartsError as error:
            return project, str(error), picture


def _ago(seconds: float) -> str:
    """Elapsed time as text."""
    minutes = max(time.time() - seconds, 0.0) / 60
    if minutes < 2:
        return "just now"
    if minutes < 90:
        return f"{minutes:.0f} minutes ago"
    if minutes < 36 * 60:
        return f"{minutes / 60:.0f} hours ago"
    return time.strftime("%Y-%m-%d", time.localtime(seconds))
