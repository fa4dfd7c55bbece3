"""Links and special files at output paths, processes killed while writing, and comparison of the resulting files."""

import hashlib
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

PRECIOUS = "years of work"


def treasure(folder: Path) -> Path:
    """Folder of unrelated files that must not change."""
    (folder / "thesis").mkdir(parents=True)
    (folder / "thesis" / "thesis.tex").write_text(PRECIOUS)
    (folder / "bashrc").write_text(PRECIOUS)
    return folder


def contents(folder: Path) -> dict[str, str]:
    """Entries below a folder, without following links: name -> kind, and content of a file or target of a link."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink():
            what = f"link to {os.readlink(path)}"
        elif path.is_file():
            what = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            what = "folder" if path.is_dir() else "special"
        found[str(path.relative_to(folder))] = what
    return found


def _link(to: str) -> Callable[[Path, Path], None]:
    return lambda place, home: place.symlink_to(home / to)


def _folder_instead(place: Path, home: Path) -> None:
    place.mkdir()
    (place / "own.txt").write_text(PRECIOUS)


PLANTED: dict[str, Callable[[Path, Path], None]] = {
    "link to a file": _link("bashrc"),
    "link to a folder": _link("thesis"),
    "dangling link": _link("new file"),
    "hard link": lambda place, home: os.link(home / "bashrc", place),
    "pipe": lambda place, home: os.mkfifo(place),
    "folder": _folder_instead,
}
"""Kind -> function that creates such an entry at a path; links point into the home folder."""

SPECIAL = ("pipe", "folder", "dangling link", "link to a folder", "link to a device", "link to itself")
"""Kinds that are invalid for any input."""
PLANTED_INPUTS: dict[str, Callable[[Path, Path], None]] = {
    "link to a device": lambda place, home: place.symlink_to("/dev/zero"),
    "link to itself": lambda place, home: place.symlink_to(place.name),
}


def plant(kind: str, place: Path, home: Path) -> None:
    """Create an entry at a path, replacing an existing one."""
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    else:
        place.unlink(missing_ok=True)
    place.parent.mkdir(parents=True, exist_ok=True)
    (PLANTED | PLANTED_INPUTS)[kind](place, home)


def killed(work: Callable[[], object]) -> bool:
    """Run a function in a forked process; returns whether it was killed by `die`."""
    if (child := os.fork()) == 0:
        try:
            work()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def die(*_: object, **__: object) -> None:
    """Kill this process."""
    os.kill(os.getpid(), signal.SIGKILL)
