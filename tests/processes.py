"""Descendants of a process, and waiting for conditions."""

import time
from collections.abc import Callable
from pathlib import Path


def descendants(process: int) -> set[int]:
    """All descendants of a process."""
    found: set[int] = set()
    for task in Path(f"/proc/{process}/task").glob("*/children"):
        for child in map(int, task.read_text().split()):
            found |= {child, *descendants(child)}
    return found


def command(process: int) -> str:
    """Command line of a running process; empty if it has ended."""
    try:
        return Path(f"/proc/{process}/cmdline").read_text().replace("\0", " ").strip()
    except OSError:
        return ""


def eventually(condition: Callable[[], bool], longest: float = 120.0) -> None:
    """Wait until a condition holds, with a timeout [s]."""
    end = time.monotonic() + longest
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)
