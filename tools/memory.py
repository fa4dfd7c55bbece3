"""Resident memory of a process."""

import os
from pathlib import Path


def resident_megabytes(process: int | str = "self") -> float:
    """Resident memory of a process by its id [MB], as Linux reports it."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
