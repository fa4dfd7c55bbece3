"""The loupe in headless Chromium: pixels, coordinates and colours without asking the server."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from viewer_canvas import MARKERS, decoded, eventually
from viewer_tab import Tab

from carts_viewer.app import ViewerApp

_COUNT = """() => {
  const mutable = window.__viserMutable, send = mutable.sendMessage;
  window.sent = [];
  mutable.sendMessage = (message) => { window.sent.push(message.type); send(message); };
}"""


def _loupe(tab: Tab) -> dict[str, Any] | None:
    return tab.page.evaluate("(() => { const b = document.querySelector('.carts-loupe');"
                             " return b && !b.hidden ? { ...b.dataset } : null; })()")  # fmt: skip


def _colour(tab: Tab) -> np.ndarray:
    loupe = _loupe(tab)
    assert loupe is not None
    return np.array(loupe["rgb"].split(), float)


@pytest.mark.browser
def test_the_loupe_shows_place_and_colour_of_the_pixel_under_the_pointer_and_asks_nobody(
    open_marked: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_marked()
    tab = open_tab(app)
    tab.canvas.where()
    assert _loupe(tab) is None
    tab.page.evaluate(_COUNT)
    # Held: it is there as long as the key is down.
    u, v = MARKERS[1][0] * 320, MARKERS[1][1] * 240
    tab.page.mouse.move(*tab.place(u, v))
    tab.page.keyboard.down(",")
    eventually(lambda: _loupe(tab), lambda loupe: loupe is not None)
    tab.page.wait_for_timeout(450)
    tab.page.keyboard.up(",")
    eventually(lambda: _loupe(tab), lambda loupe: loupe is None)
    # Pressed: it stays, and follows the pointer.
    tab.page.keyboard.press(",")
    loupe = eventually(lambda: _loupe(tab), lambda loupe: loupe is not None)
    assert loupe is not None and loupe["camera"] == "left"
    assert (float(loupe["u"]), float(loupe["v"])) == pytest.approx((u, v), abs=0.5)
    # The frame is sent as JPEG, so a colour is off by some levels.
    assert np.abs(_colour(tab) - (255, 0, 0)).max() < 30
    shown = decoded(tab.page.locator(".carts-loupe canvas").screenshot())[..., 2::-1]
    assert np.abs(shown[65, 65].astype(float) - (255, 0, 0)).max() < 40
    tab.page.mouse.move(*tab.place(160, 12))
    eventually(lambda: float((_loupe(tab) or {"v": 999})["v"]), lambda v: abs(v - 12) < 0.5)
    assert _colour(tab).max() < 30
    tab.page.get_by_role("button", name="Loupe").click()
    eventually(lambda: _loupe(tab), lambda loupe: loupe is None)
    assert "GuiUpdateMessage" not in tab.page.evaluate("window.sent")
