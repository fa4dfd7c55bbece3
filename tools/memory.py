"""How much memory this process has."""

import os
from pathlib import Path


def resident_megabytes() -> float:
    """Memory of this process [MB], as Linux reports it."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
