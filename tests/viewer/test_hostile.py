"""A hostile tab at the real server: it is refused, the server stays up, and another tab notices nothing."""

import gc
import http.client
import logging
import math
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest
import viser
from viewer_tab import place_of, view_of, widget
from waiting import eventually, get
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from carts_viewer.app import ViewerApp
from carts_viewer.picture.scene_view import OVERLAY
from carts_viewer.transport.page import Page
from tools.raw_tab import RawTab

EVERYWHERE = ".".join("0000")


class Victims:
    """A viewer, the tab of a user at work, and what may not change."""

    def __init__(self, app: ViewerApp, tab: RawTab) -> None:
        self.app, self.tab = app, tab
        self.slider = app.view.layout.joints.slider("PSM1", 0)
        self._value = -5.0

    def unharmed(self) -> None:
        """Fail unless the other tab still works and nothing has changed."""
        state = self.app.state
        assert (state.error, state.index, state.opacity, self.app.view.page.find("Note").value) == (None, 0, 0.5, "")
        self._value += 0.5
        value = self._value
        self.tab.set(self.app.page.element_id(self.slider), value)
        eventually(lambda: abs(self.slider.value - value) < 1e-9)
        self.app.wait_until_shown()
        eventually(lambda: self.tab.connected and self.tab.overlays[-1][1] == self.app.view.scene.sent(OVERLAY))
        assert get(self.app.url).status == 200
        # A new tab gets all that the server has kept for newcomers.
        with RawTab(self.app.url) as late:
            sent = view_of(self.app, late).scene.sent
            eventually(lambda: bool(late.overlays) and late.overlays[-1][1] == sent(OVERLAY))


@pytest.fixture(scope="module")
def at_work(shared_viewer: ViewerApp) -> Iterator[Victims]:
    with RawTab(shared_viewer.url) as tab:
        yield Victims(shared_viewer, tab)


@pytest.fixture
def victims(at_work: Victims, caplog: pytest.LogCaptureFixture) -> Iterator[Victims]:
    """They must be unharmed in the end, and nothing may have gone wrong in the server."""
    with caplog.at_level(logging.ERROR):
        yield at_work
        at_work.unharmed()
        gc.collect()  # asyncio tells of an exception that nobody has looked at when its task is thrown away
        assert [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR] == []


def _taken(rogue: RawTab, app: ViewerApp) -> None:
    """Wait until everything that the rogue has sent was read, which the server does in order."""
    text, field = f"rogue {time.perf_counter()}", widget(app, rogue, "From")
    rogue.set(app.page.element_id(field), text)
    eventually(lambda: field.value == text)
    app.wait_until_shown()


def test_numbers_that_are_none_or_beyond_all_range_change_nothing(victims: Victims) -> None:
    # A number of more than 64 bits, once the toolkit has it, cannot be sent to any tab: all of them are disconnected.
    with RawTab(victims.app.url) as rogue:
        for label in ("Frame", "Frames/s", "Opacity %", "By [°, mm]", "Seed"):
            own = widget(victims.app, rogue, label)
            before = own.value
            for value in (float("nan"), float("inf"), -float("inf"), 1e300, -1e300, "nan", "9" * 4000, None, [1], True):
                rogue.set(victims.app.page.element_id(own), value)
            _taken(rogue, victims.app)
            assert own.value == before, label


def test_values_beyond_a_widgets_range_and_choices_that_there_are_not_are_put_right(victims: Victims) -> None:
    app = victims.app
    with RawTab(app.url) as rogue:
        for label, value in (("Opacity %", 1e9), ("Frames/s", -1e9), ("Frame", -(2**40))):
            rogue.set(app.page.element_id(widget(app, rogue, label)), value)
        layer = widget(app, rogue, "Layer")
        rogue.set(app.page.element_id(layer), "no such layer")
        eventually(lambda: layer.value == "Mask" == rogue.values.get(app.page.element_id(layer)))
        _taken(rogue, app)
        state = place_of(app, rogue).controller.state
        assert (state.opacity, state.fps, state.index, state.error) == (1.0, 0.5, 0, None)
        slider = view_of(app, rogue).layout.joints.slider("PSM1", 0)
        low, high = app.scene.arms[0].robot.joint_limits[0]
        for value in (float("nan"), 1e12, -1e12):
            rogue.set(app.page.element_id(slider), value)
            _taken(rogue, app)
            assert math.isfinite(slider.value) and abs(slider.value) < 1e6
            joint = place_of(app, rogue).controller.state.pose.scene.joint_positions[0][0]
            assert low - 1e-5 <= joint <= high + 1e-5


def test_garbage_and_values_of_another_tabs_widgets_are_refused_and_what_comes_after_is_not(victims: Victims) -> None:
    with RawTab(victims.app.url) as rogue:
        for label, value in (("Frame", 2), ("Opacity %", 10), ("Note", "not yours")):
            rogue.set(victims.app.page.element_id(victims.app.view.page.find(label)), value)
        for data in (b"", b"\xc1", "text", b"\x91" * 100_000, b"\x82\xa1a" + b"\x91" * 100_000, b"\x00" * 1_000_000):
            rogue.send(data)
        rogue.send({"type": 5})
        rogue.send({"type": "ViewerCameraMessage", "fov": "wide"})
        _taken(rogue, victims.app)


def test_a_message_that_is_too_large_ends_the_connection_it_came_by_and_no_other(victims: Victims) -> None:
    app = victims.app
    note = app.page.element_id(app.view.page.find("Note"))
    for size in (2 << 20, 50_000_000):
        with RawTab(app.url) as rogue:
            with suppress(ConnectionClosed):
                rogue.send({"type": "GuiUpdateMessage", "uuid": note, "updates": {"value": "x" * size}})
            assert rogue.close_code() == 1009
    assert app.view.page.find("Note").value == ""


def test_requests_for_another_host_or_from_another_site_are_refused(victims: Victims) -> None:
    url = victims.app.url
    assert get(url, Host="evil.example").status == get(url, Origin="http://evil.example").status == 403
    for origin in ("http://evil.example", "null", url.replace("127.0.0.1", "localhost")):
        with pytest.raises(InvalidStatus) as refused, RawTab(url, origin=origin):
            pass
        assert refused.value.response.status_code == 403
    with RawTab(url, origin=url) as tab:
        assert tab.connected


def test_no_path_leads_out_of_what_is_served(victims: Victims) -> None:
    for path in (
        *("/static/", "/static/../pyproject.toml", "/static/..%2fpyproject.toml", "/static//etc/passwd", "/../x"),
        "/static/%2e%2e/pyproject.toml",
        "/static/..\\pyproject.toml",
        "/..%2f..%2f__init__.py",
        "/%2e%2e/%2e%2e/__init__.py",
        "/..\\..\\__init__.py",
        "/assets/../../../__init__.py",
        "//etc/passwd",
        "/static/page.js/../../../pyproject.toml",
        "/static/page.js%00.txt",
    ):
        assert get(victims.app.url, path).status == 404, path


@pytest.fixture
def shared_page() -> Iterator[Page]:
    """A page that every computer can reach."""
    page = Page(host=EVERYWHERE, port=0)
    yield page
    page.close()


def _connect(page: Page, path: str = "/", **headers: str) -> int:
    """The status of an attempt to open a websocket; 101 when it was opened."""
    url = f"ws://127.0.0.1:{page.server.get_port()}{path}"
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    try:
        with connect(url, subprotocols=[protocol], additional_headers=headers):
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


def test_where_others_can_reach_it_pages_files_and_websockets_need_the_token(shared_page: Page) -> None:
    url = f"http://127.0.0.1:{shared_page.server.get_port()}"
    token = shared_page.url.partition("?")[2]
    for query in ("", "?token=", f"?{token}x", f"?{token[:-1]}", "?token=%00"):
        assert get(url, "/" + query).status == _connect(shared_page, "/" + query) == 403
        assert get(url, "/static/page.js" + query).status == 403
    answer = get(url, "/?" + token)
    assert answer.status == 200 and "static/boot.js" in answer.read().decode()
    cookie = answer.headers["Set-Cookie"].partition(";")[0]
    for path in ("/", "/static/page.js", "/index.html"):
        assert get(url, path, Cookie=cookie).status == 200
    assert _connect(shared_page, Cookie=cookie) == _connect(shared_page, "/?" + token) == 101
    with RawTab(f"{url}/?{token}", hello=False) as tab:
        assert tab.connected
    assert _connect(shared_page, Cookie=cookie + "x") == 403
    assert _connect(shared_page, Cookie=cookie, Origin="http://evil.example") == 403
    assert _connect(shared_page, Cookie=cookie, Host="evil.example") == 403


def test_a_huge_cookie_or_query_is_refused_and_the_server_stays_up(shared_page: Page) -> None:
    url = f"http://127.0.0.1:{shared_page.server.get_port()}"
    for send in (lambda: get(url, Cookie="a=" + "x" * 200_000), lambda: get(url, "/?token=" + "x" * 200_000)):
        try:
            assert send().status >= 400
        except (OSError, http.client.HTTPException):
            pass  # Hung up on, which is as good.
    assert get(url, "/?" + shared_page.url.partition("?")[2]).status == 200
