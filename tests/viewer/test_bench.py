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
from carts_viewer.picture.scene_view import FRAME, OVERLAY, SceneView
from tools.bench_viewer import frame_latency, memory_while_optimizing, slider_latency
from tools.freshness import Soaking


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


@pytest.mark.slow
def test_a_short_soak_sees_what_it_is_there_for(open_viewer: OpenViewer, monkeypatch: pytest.MonkeyPatch) -> None:
    app = open_viewer()
    seen = Soaking(app, run=0.5).soak(0.01)
    assert seen.rounds == seen.reloads == 1 and seen.frames == 40 and seen.iterations > 0
    assert not seen.stale and not seen.exceptions and seen.growth == seen.spread == 0.0
    # A server that no longer sends overlays, and one whose worker fails, are noticed.
    overlay, frame = SceneView.show_overlay, SceneView.show_frame
    monkeypatch.setattr(SceneView, "show_overlay", lambda own, *a: None if OVERLAY in own._planes else overlay(own, *a))
    assert Soaking(app, run=0.5).soak(0.01).stale
    monkeypatch.setattr(SceneView, "show_frame", lambda own, *a: 1 / 0 if FRAME in own._planes else frame(own, *a))
    assert any("Unexpected error" in line for line in Soaking(app, run=0.5).soak(0.01).exceptions)


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
