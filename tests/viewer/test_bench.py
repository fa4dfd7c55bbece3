"""The measurements of the viewer measure something, and what must not happen does not."""

from collections.abc import Callable
from math import isfinite

import pytest

from carts_viewer import intents as ask
from carts_viewer.app import ViewerApp
from carts_viewer.bench import memory_while_optimizing, slider_latency


@pytest.mark.slow
def test_no_drag_ends_with_a_stale_overlay_and_every_move_becomes_visible(
    open_viewer: Callable[..., ViewerApp],
) -> None:
    app = open_viewer(width=640, height=480)
    for draws in (True, False):
        latency = slider_latency(app, drags=2, seconds=2.0, draws=draws)
        assert not latency.stale
        assert 0 < latency.median <= latency.p95 <= latency.worst and isfinite(latency.worst)


@pytest.mark.slow
def test_memory_stays_flat_while_the_optimizer_runs(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer()
    for name, value in (("working_width", 96), ("attention_radius", 4), ("wide_attention_radius", 8)):
        app.mailbox.put(ask.SetSetting(name, value))
    samples = memory_while_optimizing(app, iterations=500)
    assert samples[-1][0] == 500
    # The first tenth allocates what the rest reuses.
    assert samples[-1][1] - samples[1][1] < 30
    assert samples[-1][1] < 1500
