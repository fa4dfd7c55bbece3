"""Recently opened sequences, with a small picture and the progress of their review."""

import json
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np

from carts_core.errors import CartsError
from carts_core.files import write_bytes, write_text
from carts_core.files.reading import TABLE, is_regular, parse_json, read_bytes, read_text, typed
from carts_core.project import ProjectState, ReviewState, read_state
from carts_core.project.file import LOG, beside
from carts_core.project.identity import data_dir
from carts_viewer.app import ViewerApp
from carts_viewer.companions import damage

_KEPT = 24
_WIDTH = 320
"""Of a thumbnail [px]."""
_DONE = frozenset({ReviewState.ACCEPTED, ReviewState.REJECTED})
_Count = Annotated[int, msgspec.Meta(ge=0)]


@dataclass(frozen=True)
class RecentProject:
    """A sequence that was opened."""

    sequence: str
    """Path of its file."""
    name: str
    project: str
    """Path of its project."""
    frames: _Count
    reviewed: _Count
    """Frames that a person has accepted or rejected."""
    corrected: _Count
    """Frames whose joints differ from the measured ones."""
    changed: Annotated[float, msgspec.Meta(ge=0, le=1e11)]
    """When the project was changed or left last [s since 1970]."""

    @property
    def thumbnail(self) -> Path:
        """Where its picture is, if there is one."""
        return _folder() / f"{sha256(self.sequence.encode()).hexdigest()[:16]}.jpg"


def recent_projects() -> list[RecentProject]:
    """Those whose sequence files are still there, the newest first; none where the list cannot be read."""
    try:
        return [each for each in _read() if is_regular(Path(each.sequence))]
    except (OSError, ValueError):
        return []


def set_damaged_aside() -> str:
    """Set the list aside where it is damaged; what happened, for people, or an empty text."""
    try:
        _read()
    except (OSError, ValueError) as error:
        return damage(_list(), "list of recent recordings", error, "A new list was begun")
    return ""


def _read() -> list[RecentProject]:
    """The list.

    Raises:
        OSError, ValueError: it is damaged.
    """
    try:
        return typed(parse_json(read_text(_list(), TABLE)), list[RecentProject])
    except FileNotFoundError:
        return []


def up_to_date(project: RecentProject) -> RecentProject:
    """The entry with the numbers of its project file as it is now; another program may have changed it.

    Raises:
        ProjectError: the project cannot be read.
    """
    path = Path(project.project)
    if not is_regular(path):
        return replace(project, reviewed=0, corrected=0)
    stamp = _changed(path), _changed(beside(path, LOG))
    # A project that nothing has written to since it was left here is not read again.
    if max(stamp) <= project.changed:
        return project
    reviewed, corrected = _read_numbers(path, stamp)
    return replace(project, reviewed=reviewed, corrected=corrected, changed=max(stamp))


@lru_cache(maxsize=_KEPT)
def _read_numbers(path: Path, stamp: tuple[float, float]) -> tuple[int, int]:
    return _numbers(read_state(path))


def _numbers(state: ProjectState) -> tuple[int, int]:
    """How many frames are reviewed, and how many are corrected."""
    frames = range(len(state.identity.frame_ids))
    reviewed = sum(state.review(index).state in _DONE for index in frames)
    return reviewed, sum(bool(state.joints(index)) for index in frames)


def _changed(path: Path) -> float:
    """When a file was changed last [s since 1970]; 0 where there is none."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def thumbnail(project: RecentProject) -> bytes | None:
    """A JPEG file, None without one."""
    try:
        return read_bytes(project.thumbnail, TABLE)
    except (CartsError, OSError):
        return None


def remember(app: ViewerApp) -> None:
    """Put the sequence of a viewer, open or closed, at the head of the list."""
    reviewed, corrected = _numbers(app.project.state)
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
    if (picture := _picture(app)) is not None:
        write_bytes(entry.thumbnail, picture)


def forget(sequence: str) -> None:
    """Take a sequence off the list; its files stay."""
    _write(each for each in recent_projects() if each.sequence != sequence)


def _picture(app: ViewerApp) -> bytes | None:
    """The image that is shown, small."""
    state = app.state
    image = state.frame.images[state.camera]
    height = max(1, round(image.shape[0] * _WIDTH / image.shape[1]))
    small = cv2.resize(image, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    good, content = cv2.imencode(".jpg", np.ascontiguousarray(small[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 80])
    return content.tobytes() if good else None


def _write(projects: Iterable[RecentProject]) -> None:
    set_damaged_aside()
    write_text(_list(), json.dumps([asdict(each) for each in projects][:_KEPT], indent=1))


def _folder() -> Path:
    return data_dir() / "recent"


def _list() -> Path:
    return _folder() / "recent.json"
