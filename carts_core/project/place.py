"""Where a sequence's project is when nobody says so."""

import hashlib
import os
import re
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from ..files.paths import home
from ..files.reading import is_regular
from ..resources import sample_data_dir

SUFFIX = ".carts"
_RESCUED = r"\.rescued-\d{8}-\d{6}(?:-\d+)?"
"""What `rescue_paths` adds to a name."""


def data_dir() -> Path:
    """Folder of the user's own data: `$CARTS_DATA`, else `$XDG_DATA_HOME/carts`, else `~/.local/share/carts`."""
    if configured := os.environ.get("CARTS_DATA"):
        return Path(configured)
    return Path(os.environ.get("XDG_DATA_HOME") or home() / ".local" / "share") / "carts"


def default_path(sequence_file: Path) -> Path:
    """`NAME.carts` beside `NAME.toml`; in `data_dir()` for the shipped sequence and where the folder is read-only.

    A project that is there already is used in any case.
    """
    sequence_file = sequence_file.resolve()
    beside = sequence_file.with_suffix(SUFFIX)
    shipped = sequence_file.is_relative_to(sample_data_dir().resolve())
    if beside.exists() or (os.access(sequence_file.parent, os.W_OK) and not shipped):
        return beside
    # Sequences of the same name in different folders are different ones.
    folder = hashlib.sha256(str(sequence_file.parent).encode()).hexdigest()[:8]
    return data_dir() / f"{sequence_file.stem}-{folder}{SUFFIX}"


def rescue_paths(path: Path, when: float) -> Iterator[Path]:
    """Where to put what is rescued of a project: beside it, else among the user's data, else among temporary files."""
    stamp = time.strftime("%Y%m%d-%H%M%S", time.localtime(when))
    for folder in (path.parent, data_dir(), Path(tempfile.gettempdir())):
        for number in range(1, 20):
            again = "" if number == 1 else f"-{number}"
            yield folder / f"{path.stem}.rescued-{stamp}{again}{path.suffix}"


def rescued_copies(path: Path) -> list[Path]:
    """Files beside a project that were made of it when it was lost or damaged, the newest first."""
    named = re.compile(re.escape(path.stem) + _RESCUED + re.escape(path.suffix))
    names = os.listdir(path.parent) if path.parent.is_dir() else []
    copies = (path.parent / name for name in sorted(names, reverse=True) if named.fullmatch(name))
    return [copy for copy in copies if is_regular(copy)]
