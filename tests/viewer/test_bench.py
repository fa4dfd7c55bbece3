"""The measurements of the viewer measure something, and what must not happen does not."""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from math import isfinite
from multiprocessing import get_context
from pathlib import Path

import pytest
from viewer_tab import OpenViewer

from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from tools.bench_viewer import frame_latency, memory_while_optimizing, slider_latency


@pytest.mark.slow
def test_no_drag_ends_with_a_stale_overlay_and_every_move_becomes_visible(
    open_viewer: OpenViewer,
) -> None:
    app = open_viewer(width=640, height=480)
    for draws in (True, False):
        latency = slider_latency(app, drags=2, seconds=2.0, draws=draws)
        assert not latency.stale
        assert 0 < latency.median <= latency.p95 <= latency.worst and isfinite(latency.worst)


def test_every_key_brings_its_frame_with_its_overlay(open_viewer: OpenViewer) -> None:
    latency = frame_latency(open_viewer(frames=3), moves=6, frames=3, pause=0.0)
    assert not latency.stale and 0 < latency.median <= latency.p95 <= latency.worst


def _measured(sequence: Path, weights: Path) -> list[tuple[int, float]]:
    with ViewerApp.open(sequence, port=0, weights=(weights,)) as app:
        app.wait_until_shown()
        app.queue.put(intents.SetSetting("working_width", 96))
        return memory_while_optimizing(app, iterations=500)


@pytest.mark.slow
def test_memory_stays_flat_while_the_optimizer_runs(
    tiny_sequence: Callable[..., Path], untrained_weights: Path
) -> None:
    # In a process of its own: this one has what all tests before it have left.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        samples = pool.submit(_measured, tiny_sequence(), untrained_weights).result()
    assert samples[-1][0] >= 500 and len(samples) > 5
    # The first runs allocate what the rest reuse.
    assert samples[-1][1] - samples[1][1] < 30
    assert samples[-1][1] < 1500
