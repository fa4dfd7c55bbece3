"""Where a sequence's project is when nobody says so."""

import hashlib
import os
from pathlib import Path

from ..resources import sample_data_dir

SUFFIX = ".carts"


def data_dir() -> Path:
    """Folder of the user's own data: `$CARTS_DATA`, else `$XDG_DATA_HOME/carts`, else `~/.local/share/carts`."""
    if configured := os.environ.get("CARTS_DATA"):
        return Path(configured)
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "carts"


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
