"""Memory of the viewer under random actions of several tabs, minute by minute, and after all tabs have left.

    python -m tools.soak [SEQUENCE] --minutes 10 --tabs 5 --rest 1 --only run settings

`--only` selects kinds of actions, for bisection. The server runs in a separate process, so the memory of the tabs is
not included.
"""

import argparse
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from websockets.exceptions import ConnectionClosed

from carts_core.resources import sample_sequence
from tools.memory import resident_megabytes
from tools.raw_tab import RawTab

MAX_GROWTH, MAX_REST = 0.15, 0.2
"""Allowed growth after the second minute, and after the last tab has left relative to the start [1]."""
_SETTLED = 15.0
"""Time from the connection of the tabs to the start of the measurement [s]."""
_WATCHED, _IDLE, _MAX_WORK_TIME = 10.0, 0.05, 120
"""Interval [s], share of a core below which the server is idle [1], and maximum number of intervals."""
_MAX_JOBS = 60
"""Duration for which one job per second is cancelled [s]."""
_PACE = 0.2
"""Maximum time between two actions [s]."""

KINDS = {
    "frames": ("Frame", "Domain", "Play", "Next frame", "Previous worst", "Next worst", "Next unreviewed"),
    "joints": ("Yaw [°]", "Insertion [mm]", "Jaw [°]", "Perturb all joints", "All back to measured", "Copy previous"),
    "overlay": ("Layer", "Opacity %", "Compare"),
    "run": ("Run", "Pause", "Step", "Reset", "Check the fit"),
    "settings": (
        "Solver",
        "Fit to",
        "Mask source",
        "Preset",
        "Iterations",
        "Working width [px]",
        "Loss",
    ),
    "review": (
        "Accept + next",
        "Accept",
        "Reject",
        "Note",
        "Undo",
        "Redo",
        "Go to",
        "Keyframe",
        "Dice below",
    ),
    "jobs": ("Solve between", "Solve all", "Take all", "Stop and keep", "Optimize individually", "Calibrate", "Cancel"),
    "export": ("Format", "Frames", "Category per", "With images", "Export", "Cancel export", "Export mask"),
    "live": ("Start", "Stop"),
    "paint": (),
    "prompt": (),
    "connect": (),
}
"""Kind of action -> labels of the widgets that it uses; those without are gestures on the picture, or a new tab."""
_RANGES = {"Working width [px]": (64, 640), "Iterations": (1, 60)}
"""Range of number fields without limits."""


@dataclass
class Soak:
    """Resident memory of the server [MB]."""

    start: float
    """Initial memory, with all tabs open and idle."""
    minutes: list[float] = field(default_factory=list)
    """Memory at the end of each minute of actions."""
    rest: float = 0.0
    """Memory some time after the last tab has left and the server's work has ended."""
    worked: float = 0.0
    """Time from the closing of the last tab to the end of the server's work [s]."""
    actions: int = 0

    @property
    def growth(self) -> float:
        """Relative growth from the second to the last minute [1]; 0 for fewer minutes."""
        return self.minutes[-1] / self.minutes[1] - 1.0 if len(self.minutes) > 2 else 0.0

    @property
    def kept(self) -> float:
        """Final memory relative to the start, minus one [1]."""
        return self.rest / self.start - 1.0


class RandomTab:
    """Tab with random actions, independent of the content of the page."""

    def __init__(self, url: str, key: str, dice: random.Random) -> None:
        self._dice, self._count = dice, 0
        self.tab = RawTab(url, keep=1, key=key).__enter__()

    def act(self, kind: str, frames: int) -> None:
        """Perform an action of this kind."""
        if kind in ("paint", "prompt"):
            self._paint(frames, prompt=kind == "prompt")
            return
        offered = [(i, widget) for i, widget in list(self.tab.widgets.items()) if widget.get("label") in KINDS[kind]]
        element, widget = self._dice.choice(offered)
        if "value" in widget:
            self.tab.set(element, self._value(widget))
            self.tab.report("Released")
        else:
            self.tab.press(element)

    def close(self) -> None:
        """Close the connection."""
        with suppress(ConnectionClosed, TimeoutError, RuntimeError):
            self.tab.__exit__()

    def _value(self, widget: dict[str, Any]) -> object:
        value, dice = widget["value"], self._dice
        if "options" in widget:
            return dice.choice(list(widget["options"]))
        if isinstance(value, bool):
            return True
        if isinstance(value, str):
            return dice.choice(["", "smoke", "occluded"])
        low, high = _RANGES.get(widget["label"], (widget.get("min"), widget.get("max")))
        return value if low is None or high is None else round(dice.uniform(low, high))

    def _paint(self, frames: int, *, prompt: bool) -> None:
        dice = self._dice
        self._count += 1
        points = [[dice.uniform(0, 640), dice.uniform(0, 480)] for _ in range(1 if prompt else dice.randrange(3, 60))]
        stroke = {
            "number": self._count,
            "frame": dice.randrange(frames),
            "camera": "left",
            "target": dice.choice(["Mask", "Ignore region"]),
            "erase": dice.random() < 0.3,
            "polygon": not prompt and dice.random() < 0.3,
            "diameter": dice.randrange(1, 80),
            "points": points,
            "prompt": prompt,
        }
        self.tab.report("Painted", **stroke)


@contextmanager
def served(sequence: Path, python: str) -> Iterator[tuple[str, int]]:
    """Serve a copy of a sequence's folder with an interpreter; returns the address and the id of the process."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        shutil.copytree(sequence.parent, copy)
        command = [python, "-m", "carts_core.cli", "view", str(copy / sequence.name), "--port", "0"]
        server = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True)
        try:
            assert server.stdout is not None
            found = (re.search(r"http://\S+", line) for line in server.stdout)
            url = next(match.group() for match in found if match is not None)
            threading.Thread(target=server.stdout.read, daemon=True).start()
            yield url, server.pid
        finally:
            server.terminate()
            server.wait(60)


def soak(
    sequence: Path,
    *,
    minutes: float = 10.0,
    tabs: int = 5,
    rest: float = 1.0,
    only: tuple[str, ...] = tuple(KINDS),
    seed: int = 0,
    python: str = sys.executable,
) -> Soak:
    """Perform random actions in a viewer, then wait.

    Args:
        sequence: Sequence file of 640x480 px with a camera `left`.
        minutes: Duration of the actions.
        tabs: Number of tabs.
        rest: Time from the end of the server's work, after the last tab has left, to the last measurement [min].
        only: Kinds of actions, of `KINDS`.
        seed: Random seed of the actions.
        python: Interpreter of the server, which selects the measured checkout.
    """
    dice = random.Random(seed)
    with served(sequence, python) as (url, process):
        opened = [RandomTab(url, f"soak{number}", dice) for number in range(tabs)]
        time.sleep(_SETTLED)
        seen, began = Soak(resident_megabytes(process)), time.monotonic()
        while (now := (time.monotonic() - began) / 60) < minutes:
            if now >= len(seen.minutes) + 1:
                seen.minutes.append(resident_megabytes(process))
                print(f"{now:5.1f} min {seen.minutes[-1]:6.0f} MB, {seen.actions} actions", flush=True)
            kind, number = dice.choice(only), dice.randrange(tabs)
            try:
                if kind == "connect" and dice.random() < 0.1:
                    raise ConnectionAbortedError
                if kind != "connect":
                    opened[number].act(kind, 24)
            except (ConnectionClosed, ConnectionAbortedError, TimeoutError, RuntimeError):
                opened[number].close()
                # A viewer at work brings a tab up to date late; the next action, which fails, tries again.
                with suppress(TimeoutError):
                    key = dice.choice([f"soak{number}", f"soak{number}-{seen.actions}"])
                    opened[number] = RandomTab(url, key, dice)
            seen.actions += 1
            time.sleep(_PACE * dice.random())
        seen.minutes.append(resident_megabytes(process))
        for tab in opened:
            tab.close()
        _cancel_jobs(url)
        left = time.monotonic()
        _wait_until_idle(process)
        seen.worked = time.monotonic() - left
        time.sleep(60 * rest)
        seen.rest = resident_megabytes(process)
    return seen


def _cancel_jobs(url: str) -> None:
    """Cancel the jobs, which would otherwise continue for an hour without a tab."""
    with suppress(ConnectionClosed, TimeoutError), RawTab(url, keep=1, key="cancel") as tab:
        for _ in range(_MAX_JOBS):
            for element, widget in list(tab.widgets.items()):
                if widget.get("label") == "Cancel" and widget.get("visible", True):
                    tab.press(element)
            time.sleep(1.0)


def _wait_until_idle(process: int) -> None:
    """Wait until a process is idle, since queued clicks and jobs continue without a tab."""
    before = _ticks(process)
    for _ in range(_MAX_WORK_TIME):
        time.sleep(_WATCHED)
        now = _ticks(process)
        if now - before < _IDLE * _WATCHED * os.sysconf("SC_CLK_TCK"):
            return
        before = now


def _ticks(process: int) -> int:
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


def main() -> None:
    """Print the results; the exit status is 1 if memory grew or was not returned."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", nargs="?", type=Path, default=sample_sequence())
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--tabs", type=int, default=5)
    parser.add_argument("--rest", type=float, default=1.0, help="from the end of work to the last figure [min]")
    parser.add_argument("--only", nargs="+", choices=list(KINDS), default=list(KINDS), help="kinds of action")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--python", default=sys.executable, help="interpreter of the server")
    given = parser.parse_args()
    options = {name: getattr(given, name) for name in ("minutes", "tabs", "rest", "seed", "python")}
    seen = soak(given.sequence, only=tuple(given.only), **options)
    print(f"start {seen.start:.0f} MB; growth after the second minute {seen.growth:+.0%}")
    print(f"the server worked for {seen.worked:.0f} s after the last tab had left")
    print(f"{given.rest:g} min later: {seen.rest:.0f} MB, {seen.kept:+.0%} of the start")
    if seen.growth > MAX_GROWTH or seen.kept > MAX_REST:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
