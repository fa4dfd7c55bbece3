"""Long-running test of the viewer with three tabs: growth of memory, and outdated pictures.

    python -m tools.freshness [SEQUENCE] --minutes 60

In every round the optimizer runs while other tabs watch, frames are scrubbed, a joint is dragged, and one tab is
reloaded; then the final state is checked. Server and tabs share one process, whose memory includes that of the tabs.
"""

import argparse
import logging
import random
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from carts_core.process import tune_process
from carts_core.resources import sample_sequence
from carts_viewer.app import ViewerApp
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.picture.scene_view import OVERLAY
from carts_viewer.tabs import Tab, View
from tools.memory import resident_megabytes
from tools.raw_tab import RawTab

MAX_GROWTH = 0.05
"""Maximum relative growth of memory after warm-up [1]."""
_TABS = 3
_STEP = 0.05
"""Interval between values of a dragged slider, as sent by a browser [s]."""
_WARM_UP = 0.2
"""Share of the rounds that are warm-up [1]."""


@dataclass
class Soak:
    """Results of the test."""

    minutes: float = 0.0
    rounds: int = 0
    frames: int = 0
    """Number of scrubbed frames."""
    iterations: int = 0
    reloads: int = 0
    stale: list[str] = field(default_factory=list)
    """Final pictures that did not match the state, one line each."""
    exceptions: list[str] = field(default_factory=list)
    megabytes: list[tuple[float, float]] = field(default_factory=list)
    """Time since the start [min] and resident memory after each round [MB]."""

    @property
    def growth(self) -> float:
        """Relative growth of memory from the first to the last tenth of the time after warm-up [1]."""

        megabytes = [megabytes for _, megabytes in self.megabytes]
        begin, some = int(_WARM_UP * len(megabytes)), max(len(megabytes) // 10, 1)
        return float(np.median(megabytes[-some:]) / np.median(megabytes[begin : begin + some])) - 1.0

    @property
    def spread(self) -> float:
        """Range of memory after warm-up, relative to the minimum [1]."""
        settled = [megabytes for _, megabytes in self.megabytes[int(_WARM_UP * len(self.megabytes)) :]]
        return max(settled) / min(settled) - 1.0


class _Listener(logging.Handler):
    """Collects all logged errors, including unhandled errors of asyncio."""

    def __init__(self, lines: list[str]) -> None:
        super().__init__(logging.ERROR)
        self._lines = lines

    def emit(self, record: logging.LogRecord) -> None:
        self._lines.append(record.getMessage())


class Soaking:
    """Three tabs of a viewer, and their actions."""

    def __init__(self, app: ViewerApp, *, run: float = 6.0, seed: int = 0) -> None:
        """
        Args:
            app: The viewer.
            run: Duration of the optimizer's run in each round [s].
            seed: Random seed of the actions.
        """
        self._app = app
        self._run_seconds = run
        self._random = random.Random(seed)
        self._tabs: list[RawTab] = []
        self.seen = Soak()

    def soak(self, minutes: float) -> Soak:
        """Run for a duration; returns the results."""
        listener, hook = _Listener(self.seen.exceptions), threading.excepthook
        logging.getLogger().addHandler(listener)
        threading.excepthook = lambda arguments: self.seen.exceptions.append(repr(arguments.exc_value))
        start = time.monotonic()
        try:
            self._tabs = [self._open(f"soak {number}") for number in range(_TABS)]
            while self.seen.minutes < minutes:
                self._round()
                self.seen.minutes = (time.monotonic() - start) / 60
                self.seen.megabytes.append((self.seen.minutes, resident_megabytes()))
        finally:
            for tab in self._tabs:
                tab.__exit__()
            logging.getLogger().removeHandler(listener)
            threading.excepthook = hook
        return self.seen

    def _open(self, key: str) -> RawTab:
        return RawTab(self._app.url, keep=1, key=key).__enter__()

    def _place(self, tab: RawTab) -> Tab:
        return next(place for place in self._app.tabs if place.key == tab.key)

    def _view(self, tab: RawTab) -> View:
        view = self._place(tab).view
        assert view is not None
        return view

    def _set(self, tab: RawTab, label: str, value: object) -> None:
        tab.set(self._app.page.element_id(self._view(tab).page.find(label)), value)

    def _round(self) -> None:
        dice = self._random
        runner = dice.choice(self._tabs)
        self._set(runner, "Run", True)
        end = time.monotonic() + self._run_seconds
        while time.monotonic() < end:
            # Watching: a change of opacity needs a new picture, but does not end the run.
            self._set(dice.choice(self._tabs), "Opacity %", dice.randrange(20, 100, 5))
            time.sleep(0.5)
        self.seen.iterations += max(len(self._place(runner).controller.state.run.curves.loss) - 1, 0)
        count = len(self._app.sequence)
        place = dice.randrange(count)
        for _ in range(40):
            place = (place + 1) % count
            self._set(dice.choice(self._tabs), "Frame", place + 1)
            self.seen.frames += 1
            time.sleep(_STEP)
        tab, arm = dice.choice(self._tabs), self._app.scene.arms[0]
        slider = self._view(tab).layout.joints.slider(arm.name, dice.randrange(len(arm.robot.joint_names)))
        value = slider.value
        for step in range(20):
            tab.set(self._app.page.element_id(slider), value + 0.1 * (step + 1))
            time.sleep(_STEP)
        # In the middle of a drag: its tab is closed, and a new one comes.
        self._tabs.remove(tab)
        tab.__exit__()
        self._tabs.append(self._open(tab.key))
        self.seen.reloads += 1
        self._check()
        self.seen.rounds += 1

    def _check(self) -> None:
        """Wait until all work is done; check that every tab shows its state and no error was logged."""
        self._app.wait_until_shown(60.0)
        end = time.monotonic() + 10.0
        while time.monotonic() < end and any(_newest(tab) != self._view(tab).scene.sent(OVERLAY) for tab in self._tabs):
            time.sleep(0.05)
        for number, tab in enumerate(self._tabs):
            state = self._place(tab).controller.state
            if state.error is not None:
                self.seen.exceptions.append(state.error)
            # Drawn anew, by somebody who has never drawn anything.
            right = OverlayRenderer(self._app.sequence).overlay(
                state.pose.scene, state.frame, state.camera, state.layer, state.opacity, state.maps
            )
            png = cv2.imdecode(np.frombuffer(_newest(tab), np.uint8), cv2.IMREAD_UNCHANGED)
            if png is None or not np.array_equal(cv2.cvtColor(png, cv2.COLOR_BGRA2RGBA), right):
                self.seen.stale.append(f"round {self.seen.rounds}, tab {number}, frame {state.index}")


def _newest(tab: RawTab) -> bytes:
    return tab.overlays[-1][1] if tab.overlays else b"none"


def main() -> None:
    """Print the results; the exit status is 1 after a failure."""
    tune_process()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", nargs="?", type=Path, default=sample_sequence())
    parser.add_argument("--minutes", type=float, default=60.0)
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    with (
        tempfile.TemporaryDirectory() as folder,
        ViewerApp.open(arguments.sequence, project=Path(folder) / "soak.carts", port=0) as app,
    ):
        app.wait_until_shown(120)
        seen = Soaking(app).soak(arguments.minutes)
    print(
        f"{seen.minutes:.1f} minutes, {seen.rounds} rounds: {seen.iterations} iterations, {seen.frames} frames "
        f"scrubbed, {seen.reloads} tabs closed in mid-drag and opened anew"
    )
    for at, megabytes in seen.megabytes[:: max(len(seen.megabytes) // 12, 1)]:
        print(f"  {at:5.1f} min {megabytes:6.0f} MB")
    print(f"memory: {100 * seen.growth:+.1f} % after warm-up, spread {100 * seen.spread:.1f} %")
    print(f"stale overlays: {len(seen.stale)}", *seen.stale, sep="\n  ")
    print(f"exceptions: {len(seen.exceptions)}", *seen.exceptions, sep="\n  ")
    if seen.stale or seen.exceptions or seen.growth > MAX_GROWTH:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
