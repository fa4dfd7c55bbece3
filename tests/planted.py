"""Links and special files where a program writes, processes killed while they write, and comparison of what is left."""

import hashlib
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

PRECIOUS = "years of work"


def treasure(folder: Path) -> Path:
    """A folder of somebody's own files, which nothing may change."""
    (folder / "thesis").mkdir(parents=True)
    (folder / "thesis" / "thesis.tex").write_text(PRECIOUS)
    (folder / "bashrc").write_text(PRECIOUS)
    return folder


def contents(folder: Path) -> dict[str, str]:
    """Everything below a folder, links not followed: name -> kind, and a file's content or a link's target."""
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
"""Kind -> lays it at a place; links lead into the home folder."""

SPECIAL = ("pipe", "folder", "dangling link", "link to a folder", "link to a device", "link to itself")
"""What no input can be."""
PLANTED_INPUTS: dict[str, Callable[[Path, Path], None]] = {
    "link to a device": lambda place, home: place.symlink_to("/dev/zero"),
    "link to itself": lambda place, home: place.symlink_to(place.name),
}


def plant(kind: str, place: Path, home: Path) -> None:
    """Lay something at a place, in place of what lies there."""
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    else:
        place.unlink(missing_ok=True)
    place.parent.mkdir(parents=True, exist_ok=True)
    (PLANTED | PLANTED_INPUTS)[kind](place, home)


def killed(work: Callable[[], object]) -> bool:
    """Do some work in a forked process; whether it was killed, as `die` does, before its end."""
    if (child := os.fork()) == 0:
        try:
            work()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def die(*_: object, **__: object) -> None:
    """Kill this process."""
    os.kill(os.getpid(), signal.SIGKILL)
