"""Benchmark of the viewer: times from start to first overlay, from slider to overlay and from key to next frame, and
growth of memory.

    python -m tools.bench_viewer [SEQUENCE]

The sliders are moved over a real websocket, as a browser moves them (at most 20 times a second).
"""

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from carts_core.process import tune_process
from carts_core.resources import sample_sequence
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.jobs.job_list import JobState
from carts_viewer.picture.scene_view import OVERLAY
from tools.bench_start import print_starts
from tools.memory import resident_megabytes
from tools.raw_tab import RawTab

_MOVES_PER_SECOND = 20
_SETTLE = 0.5
_ITERATIONS = 500


@dataclass(frozen=True)
class Latency:
    """Times from an action to the picture that shows its result [ms]."""

    median: float
    p95: float
    worst: float
    stale: bool
    """Whether the last overlay did not show the last value or frame."""


_KEY = "bench"
"""Key of the measuring tab, which the next measuring tab reuses."""


def slider_latency(
    app: ViewerApp, *, drags: int = 4, seconds: float = 4.0, draws: bool = True, job: bool = False
) -> Latency:
    """Drag the first joint's slider and wait for overlays.

    Args:
        app: The viewer.
        drags: Number of drags.
        seconds: Duration of each [s].
        draws: Whether the tab acknowledges pictures; otherwise the viewer waits for its timeout.
        job: Whether all frames are optimized at the same time.
    """
    arm = app.state.frame.measured
    name = next(iter(arm))
    times: list[float] = []
    stale = False
    with RawTab(app.url, draws=draws, key=_KEY) as tab:
        slider = app.page.element_id(app.view.layout.joints.slider(name, 0))
        shown = _record_pictures(app, name)
        app.wait_until_shown()
        if job:
            app.queue.put(intents.OptimizeFrames("all"))
            _until(lambda: any(one.state is JobState.RUNNING for one in app.state.jobs))
        for _ in range(drags):
            start = float(np.degrees(arm[name][0]))
            moves: list[tuple[float, float]] = []
            for step in range(int(seconds * _MOVES_PER_SECOND)):
                value = round(start + 0.1 * (step + 1), 6)
                moves.append((time.perf_counter(), value))
                tab.set(slider, value)
                time.sleep(1.0 / _MOVES_PER_SECOND)
            last = moves[-1][1]
            _until(lambda last=last: bool(shown) and abs(np.degrees(shown[-1][1]) - last) < 1e-3)
            time.sleep(_SETTLE)
            pictures = [(at, np.degrees(value)) for at, value in shown if at >= moves[0][0]]
            arrivals = [at for at, _ in tab.overlays if at >= moves[0][0]]
            stale |= not pictures or abs(pictures[-1][1] - moves[-1][1]) > 1e-3
            times += [_wait_for(at, value, pictures, arrivals) for at, value in moves]
            app.queue.put(intents.BackToMeasured())
            _until(lambda start=start: abs(np.degrees(shown[-1][1]) - start) < 1e-3)
            shown.clear()
        if job:
            running = app.state.jobs[-1]
            if running.state is not JobState.RUNNING:
                raise RuntimeError(f"The job ended early: {running.text}")
            app.queue.put(intents.CancelJob(running.number))
        app.wait_until_shown()
    return _latency(times, stale)


def frame_latency(app: ViewerApp, *, moves: int = 120, frames: int = 8, pause: float = 0.15) -> Latency:
    """Press the keys for the next and the previous frame, and wait for frame and overlay, which are sent together.

    Frames are cached. Times include the transmission to the tab.

    Args:
        app: The viewer.
        moves: Number of key presses.
        frames: Number of frames forwards before the direction is reversed.
        pause: Time between two key presses [s].
    """
    count = min(frames, len(app.sequence)) - 1
    app.queue.put(intents.ShowFrame(0))
    times: list[float] = []
    with RawTab(app.url, key=_KEY) as tab:
        app.wait_until_shown()
        keys = {1: tab.command("Next frame"), -1: tab.command("Previous frame (back)")}
        lap = [1] * count + [-1] * count
        for number in range(len(lap) + moves):
            by, pressed = lap[number % len(lap)], time.perf_counter()
            wanted = app.state.index + by
            tab.press(keys[by])
            _until(lambda wanted=wanted: app.state.index == wanted)
            app.wait_until_shown()
            # Of the pictures that came since, the newest shows the frame; others may have been on their way before.
            sent = app.view.scene.sent(OVERLAY)
            _until(lambda sent=sent: bool(tab.overlays) and tab.overlays[-1][1] == sent)
            times.append(tab.overlays[-1][0] - pressed)
            time.sleep(pause)
        stale = tab.overlays[-1][1] != app.view.scene.sent(OVERLAY)
    # The first lap has read the frames.
    return _latency(times[len(lap) :], stale)


def _until(holds: Callable[[], bool], patience: float = 60.0) -> None:
    """Wait for a condition.

    Raises:
        RuntimeError: the condition does not hold after the timeout.
    """
    end = time.perf_counter() + patience
    while not holds():
        if time.perf_counter() > end:
            raise RuntimeError(f"The picture of a key did not come within {patience:g} s.")
        time.sleep(0.0005)


def _latency(times: list[float], stale: bool) -> Latency:
    ms = 1e3 * np.array(times)
    return Latency(float(np.median(ms)), float(np.percentile(ms, 95)), float(ms.max()), stale)


def _record_pictures(app: ViewerApp, arm: str) -> list[tuple[float, float]]:
    """List to which the time and the first joint [rad] of each started picture are appended."""
    shown: list[tuple[float, float]] = []
    show = app.view.display.show_picture
    row = [own.name for own in app.scene.arms].index(arm)

    def recorded(state: Any) -> None:
        shown.append((time.perf_counter(), float(state.pose.scene.joint_positions[row][0])))
        show(state)

    app.view.display.show_picture = recorded
    return shown


def _wait_for(moved: float, value: float, pictures: list[tuple[float, float]], arrivals: list[float]) -> float:
    """Time from a move to the arrival of the first picture of this or a later value [s]; infinity without a picture."""
    made = next((at for at, shown in pictures if shown >= value - 1e-3), None)
    if made is None:
        return float("inf")
    # One picture is under way at a time, so the first arrival after its making began is its own.
    return next((at - moved for at in arrivals if at >= made), float("inf"))


def memory_while_optimizing(app: ViewerApp, iterations: int = _ITERATIONS) -> list[tuple[int, float]]:
    """Resident memory after each of several runs, as (iterations so far, MB).

    All runs start at the same pose.
    """
    done, samples = 0, list[tuple[int, float]]()
    while done < iterations:
        app.queue.put(intents.Run())
        state = app.wait_until_shown(600.0)
        steps = len(state.run.curves.loss) - 1
        if state.error is not None or steps < 1:
            raise RuntimeError(state.error or "The run made no step.")
        done += steps
        samples.append((done, resident_megabytes()))
        app.queue.put(intents.Reset())
        app.wait_until_shown()
    return samples


def _figures(latency: Latency) -> str:
    times = ", ".join(f"{key} {value:.0f} ms" for key, value in dataclasses.asdict(latency).items() if key != "stale")
    return f"{times}; stale at the end: {latency.stale}"


def main() -> None:
    """Print the measurements."""
    tune_process()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", nargs="?", type=Path, default=sample_sequence())
    parser.add_argument("--weights", type=Path, nargs="*", default=())
    parser.add_argument("--iterations", type=int, default=_ITERATIONS)
    arguments = parser.parse_args()
    print_starts(arguments.sequence)
    with (
        tempfile.TemporaryDirectory() as folder,
        ViewerApp.open(
            arguments.sequence, project=Path(folder) / "bench.carts", port=0, weights=tuple(arguments.weights)
        ) as app,
    ):
        app.wait_until_shown(120)
        camera = app.scene.camera(app.state.camera)
        print(f"{arguments.sequence}: {camera.width} x {camera.height}, {len(app.scene.arms)} arm(s)")
        for draws, name in ((True, "tab that draws at once"), (False, "tab that never answers")):
            print(f"slider to overlay, {name}: {_figures(slider_latency(app, draws=draws))}")
        print(f"slider to overlay, while all frames are optimized: {_figures(slider_latency(app, job=True))}")
        print(f"key to next frame with overlay, read before: {_figures(frame_latency(app))}")
        for iterations, megabytes in memory_while_optimizing(app, arguments.iterations):
            print(f"memory after {iterations} iterations: {megabytes:.0f} MB")


if __name__ == "__main__":
    main()
