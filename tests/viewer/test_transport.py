"""Who may talk to the viewer, what may be sent, messages queued by several threads, and private names of viser."""

import ast
import asyncio
import random
import re
import socket
import threading
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import pytest
from viser import _messages
from viser._messages import GuiUpdateMessage
from websockets.datastructures import Headers

import carts_viewer
from carts_core.errors import SettingsError
from carts_core.resources import static_dir
from carts_viewer.serving import opened_in_browser, webbrowser
from carts_viewer.transport.guard import Guard, check_address, refusal
from carts_viewer.transport.viser_private import MessageBuffer

EVERYWHERE = ".".join("0000")


def _refusal(guard: Guard, host: str | None, *, target: str = "/", **headers: str) -> str | None:
    return guard.refusal(target, Headers(**({} if host is None else {"Host": host}), **headers))


@pytest.fixture
def local() -> Guard:
    """Of a server that only this computer reaches."""
    return Guard("127.0.0.1")


@pytest.fixture
def shared() -> Guard:
    """Guard of a server that other computers can reach."""
    return Guard(EVERYWHERE)


def _with_token(guard: Guard) -> str:
    return f"/?token={guard.token}"


def _cookie(guard: Guard, host: str = "192.168.0.7:8080") -> str:
    """The cookie that a browser would send back."""
    answer = guard.cookie(_with_token(guard), Headers(Host=host))
    assert answer is not None
    return answer.partition(";")[0]


def test_this_computers_own_names_are_answered_and_others_are_refused_against_dns_rebinding(local: Guard) -> None:
    for host in "127.0.0.1:8080 localhost:8080 localhost [::1]:8080 127.0.0.1:9000 127.0.0.2:8080".split():
        assert _refusal(local, host) is None and _refusal(local, host, Origin=f"http://{host}") is None, host
    foreign = ("evil.example", "evil.example:8080", "127.0.0.1.evil.example", "", "192.168.0.7:8080")
    odd = ("[", "localhost:x", "localhost/x", "localhost?x", "a; b@localhost", "localhost:1 localhost", "@localhost")
    for host in (*foreign, *odd):
        assert "are refused" in (_refusal(local, host) or ""), host
    both = Headers(Host="localhost:8080")
    both["Host"] = "evil.example"
    assert local.refusal("/", both) is not None and _refusal(local, None) is not None


def test_another_sites_page_is_refused_even_on_this_computer_and_with_the_right_token(
    local: Guard, shared: Guard
) -> None:
    for origin in (
        "http://evil.example",
        "https://localhost:8080",
        "http://localhost:3000",
        "null",
        "http://localhost",
    ):
        assert "Requests from" in (_refusal(local, "localhost:8080", Origin=origin) or "")
    for origin in ("http://evil.example", "null", "http://192.168.0.7"):
        said = _refusal(shared, "192.168.0.7:8080", target=_with_token(shared), Origin=origin)
        assert "Requests from" in (said or "")


@pytest.mark.parametrize("host", ["127.0.0.2", "127.0.0.1", "::1", "localhost", EVERYWHERE])
def test_the_printed_address_is_answered(host: str) -> None:
    guard = Guard(host)
    url = urlsplit(guard.url(8080))
    assert guard.refusal(f"{url.path or '/'}?{url.query}", Headers(Host=url.netloc)) is None


_NAVIGATION = {"Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}


@pytest.mark.parametrize(
    ("site", "target", "more", "answered"),
    [
        ("same-origin", "/thumbnail/0/0/0.jpg", {}, True),
        ("none", "/thumbnail/0/0/0.jpg", _NAVIGATION, True),
        ("cross-site", "/thumbnail/0/0/0.jpg", {"Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"}, False),
        ("same-site", "/thumbnail/0/0/0.jpg", {"Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"}, False),
        ("cross-site", "/thumbnail/0/0/0.jpg", _NAVIGATION, False),
        ("cross-site", "/static/page.js", {"Sec-Fetch-Dest": "script"}, False),
        ("cross-site", "/?frame=3", _NAVIGATION, True),
        ("cross-site", "/", {"Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "iframe"}, False),
        ("cross-site", "/", {"Sec-Fetch-Mode": "cors", "Sec-Fetch-Dest": "empty"}, False),
    ],
)
def test_another_sites_page_may_link_to_the_page_and_load_nothing(
    local: Guard, site: str, target: str, more: dict[str, str], answered: bool
) -> None:
    headers = Headers({"Host": "localhost:8080", "Sec-Fetch-Site": site} | more)
    assert (local.refusal(target, headers) is None) == answered


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_a_server_that_only_this_computer_reaches_needs_no_token(host: str) -> None:
    guard = Guard(host)
    assert guard.token is None and guard.cookie("/?token=", Headers(Host="localhost")) is None
    assert guard.url(8080) == f"http://{'[::1]' if host == '::1' else host}:8080"


@pytest.mark.parametrize("host", [EVERYWHERE, "192.168.0.7", "::", "fe80::1", "example.org"])
def test_any_other_server_needs_a_token_of_its_own(host: str) -> None:
    first, second = Guard(host), Guard(host)
    assert first.token and second.token and first.token != second.token and len(first.token) >= 43
    url = urlsplit(first.url(8080))
    assert parse_qs(url.query) == {"token": [first.token]} and url.port == 8080
    assert url.hostname not in (EVERYWHERE, "::")


def test_with_the_token_or_its_cookie_every_request_is_answered_and_without_none(shared: Guard) -> None:
    host = "192.168.0.7:8080"
    assert "with the token" in (_refusal(shared, host) or "")
    assert _refusal(shared, host, target=_with_token(shared)) is None
    assert _refusal(shared, host, target=_with_token(shared) + "&fixedDpr=1") is None
    assert _refusal(shared, host, target="/static/page.js", Cookie=f"other=1; {_cookie(shared)}; last=2") is None
    # This computer's own names need it as well: anybody here could ask by them.
    assert _refusal(shared, "localhost:8080") is not None


def test_a_wrong_token_or_cookie_is_refused(shared: Guard) -> None:
    host, other = "192.168.0.7:8080", Guard(EVERYWHERE)
    token = shared.token or ""
    for wrong in ("", token[:-1], token + "x", token.swapcase(), "%00", "ä", str(other.token), "%ff%fe"):
        assert _refusal(shared, host, target=f"/?token={wrong}") is not None
        assert shared.cookie(f"/?token={wrong}", Headers(Host=host)) is None
    name = _cookie(shared).partition("=")[0]
    # The token is no cookie, and a cookie of another server or of another port is none of ours.
    for wrong in (f"{name}={token}", _cookie(other), f"{name}=", name, _cookie(shared, "192.168.0.7:9000"), ";=;"):
        assert _refusal(shared, host, Cookie=wrong) is not None
    assert _refusal(shared, host, target=f"/?other={token}") is not None


def test_no_script_and_no_other_site_gets_at_the_cookie(shared: Guard) -> None:
    answer = shared.cookie(_with_token(shared), Headers(Host="192.168.0.7:8080")) or ""
    assert {"HttpOnly", "SameSite=Strict", "Path=/"} <= set(answer.split("; "))
    assert shared.token is not None and shared.token not in answer


def test_where_others_reach_the_server_it_answers_by_address_and_own_name_but_by_no_other_name(shared: Guard) -> None:
    for host in ("192.168.0.7:8080", "[fe80::1]:8080", "localhost:8080", f"{socket.gethostname()}:8080"):
        assert _refusal(shared, host, target=_with_token(shared)) is None
    assert "are refused" in (_refusal(shared, "evil.example:8080", target=_with_token(shared)) or "")
    assert _refusal(Guard("example.org"), "Example.org:8080", Cookie="x") == _refusal(shared, "192.168.0.7:8080")


def test_only_addresses_of_this_computer_and_possible_ports_may_be_listened_on() -> None:
    for host in ("127.0.0.1", "::1", "localhost", EVERYWHERE):
        check_address(host, 0)
    for host in ("192.0.2.7", "not a name", "", "\udcff"):
        with pytest.raises(SettingsError, match=r"cannot listen on .* Use 127\.0\.0\.1"):
            check_address(host, 0)
    for port in (-1, 65536):
        with pytest.raises(SettingsError, match="Give 1 to 65535"):
            check_address("127.0.0.1", port)


def test_a_token_is_not_on_the_command_line_of_the_browser(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    url = "http://192.168.0.7:8080/?token=secret&more"
    with opened_in_browser(url):
        (given,) = opened
        page = Path(given.removeprefix("file://"))
        assert "secret" not in given and "url=http://192.168.0.7:8080/?token=secret&amp;more" in page.read_text()
        assert page.stat().st_mode & 0o777 == 0o600 and page.parent.stat().st_mode & 0o777 == 0o700
    assert not page.parent.exists()
    with opened_in_browser("http://127.0.0.1:8080"):
        assert opened[1:] == ["http://127.0.0.1:8080"]


# ---- Incoming messages; a real viewer under fire is in test_hostile.py ----------------------------------------------


WIDGETS = {"slider": 1.5, "frame": 3, "box": True, "text": "a", "colour": (1, 2, 3)}


def _refused(data: Any) -> str | None:
    packed = data if isinstance(data, bytes | str) else msgspec.msgpack.encode(data)
    return refusal(packed, WIDGETS.get)


def _update(element: str, value: Any, **more: Any) -> dict[str, Any]:
    return {"type": "GuiUpdateMessage", "uuid": element, "updates": {"value": value}, **more}


def test_a_value_is_taken_if_it_is_of_the_widgets_own_kind_and_in_range() -> None:
    taken = {"slider": (2.5, 2, -1e9), "frame": (2, 2.0), "box": (False,), "text": ("ä" * 999,)}
    assert [_refused(_update(name, value)) for name, values in taken.items() for value in values] == [None] * 7
    for element in ("slider", "frame"):
        for value in (float("nan"), float("inf"), -float("inf"), 1e300, -1e17, 2**63):
            assert _refused(_update(element, value)) == "a number out of range"
    for element, values in {
        "slider": ("nan", "9" * 4000, True, None, [1.0], {"a": 1}, b"1"),
        "frame": ("1", False, []),
        "text": (1, 1.0, True, None, ["a"]),
        "box": (1, "True", None),
        "colour": (1, "a", [1, 2, 3]),
        "no such widget": (1, "a", True),
    }.items():
        for value in values:
            assert _refused(_update(element, value)), value


def test_only_the_value_of_a_widget_can_be_set() -> None:
    for name in "removed sync_cb update_cb uuid disabled label max options is_button content".split():
        assert _refused({"type": "GuiUpdateMessage", "uuid": "text", "updates": {name: "a"}})
        assert _refused({"type": "GuiUpdateMessage", "uuid": "text", "updates": {"value": "a", name: "a"}})
        assert _refused(_update("text", "a", **{name if name != "uuid" else "id": "a"}))


def test_of_the_messages_of_viser_three_are_taken_and_all_others_refused() -> None:
    taken = {"GuiUpdateMessage", "CommandTriggerMessage", "ViewerCameraMessage"}
    known = {kind.__name__ for kind in _messages.Message.get_subclasses()}
    assert known >= taken | {"ShareUrlRequest", "FileTransferStartUpload", "FileTransferPart"}
    for name in known - taken:
        assert _refused({"type": name, "uuid": "text"}), name


def test_what_is_no_message_at_all_is_refused_and_raises_nothing() -> None:
    for data in (
        *(b"", b"\xc1", b"\x93\x01\x02", "text", b"\x81\xa4type\xa2\xff\xfe"),
        b"\x82\xa1a" + b"\x91" * 200_000 + b"\xc0\xa4type\xb0GuiUpdateMessage",
        msgspec.msgpack.encode(_update("text", "a")) + b"\x00",
        msgspec.msgpack.encode([_update("text", "a")]),
        msgspec.msgpack.encode({"uuid": "text"}),
    ):
        assert _refused(data), data[:20]
    dice, whole = random.Random(0), msgspec.msgpack.encode(_update("slider", 2.5))
    refused = 0
    for _ in range(5000):
        data = bytearray(whole)
        for _ in range(dice.randrange(1, 4)):
            data[dice.randrange(len(data))] = dice.randrange(256)
        refused += refusal(bytes(data), WIDGETS.get) is not None
    assert refused > 4000


# ---- Outgoing messages ----------------------------------------------------------------------------------------------


@pytest.fixture
def event_loop_in_a_thread():
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    yield loop
    loop.call_soon_threadsafe(loop.stop)
    thread.join()
    loop.close()


def test_every_tab_gets_what_threads_queue_at_the_same_time(event_loop_in_a_thread: asyncio.AbstractEventLoop) -> None:
    loop, tabs, threads, messages = event_loop_in_a_thread, 8, 3, 1000
    buffer = MessageBuffer(loop, persistent_messages=True, window_duration_sec=0.0)
    failures: list[BaseException] = []

    async def receive(tab: int) -> set[str]:
        seen: set[str] = set()
        async for window in buffer.window_generator(tab):
            seen |= {message.uuid for message in window if isinstance(message, GuiUpdateMessage)}
            if len(seen) == threads * messages:
                break
        return seen

    def send(thread: int) -> None:
        try:
            for number in range(messages):
                buffer.push(GuiUpdateMessage(f"{thread}-{number}", {"value": number}))
        except BaseException as error:
            failures.append(error)

    received = [asyncio.run_coroutine_threadsafe(receive(tab), loop) for tab in range(tabs)]
    senders = [threading.Thread(target=send, args=(thread,)) for thread in range(threads)]
    for sender in senders:
        sender.start()
    for sender in senders:
        sender.join()
    assert not failures
    expected = {f"{thread}-{number}" for thread in range(threads) for number in range(messages)}
    assert all(future.result(60) == expected for future in received)


# ---- Private names of viser and websockets --------------------------------------------------------------------------


PACKAGE = Path(carts_viewer.__file__).parent
USED = set(
    "viser._gui_api viser._gui_handles viser._icons viser._messages viser.infra._infra "
    "viser.infra._async_message_buffer _impl _gui_input_handle_from_uuid _data _websock_connection".split()
)
"""Every private name of theirs, all in one module. Check each when viser is updated."""
SCRIPTS = {f"{name}.js" for name in "page paint tools compare marks loupe timeline shell drag document".split()}


def private_names(path: Path) -> set[str]:
    """Private modules that a module imports, and private attributes of anything but its own objects."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            module = node.module or ""
            found |= {module} if "._" in module else {f"{module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.startswith("__"):
            if not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")):
                found.add(node.attr)
    return {name for name in found if name.startswith("_") or "._" in name} - {"__future__"}


def test_private_names_of_viser_are_used_in_one_module_and_are_in_the_list() -> None:
    modules = [*PACKAGE.rglob("*.py"), *(PACKAGE.parent / "tools").rglob("*.py")]
    used = [(path.name, names) for path in modules if (names := private_names(path))]
    assert used == [("viser_private.py", USED)]
    found = {path.name: set(re.findall(r"__viser\w*", path.read_text("utf-8"))) for path in static_dir().glob("*.js")}
    assert {name: names for name, names in found.items() if names} == {name: {"__viserMutable"} for name in SCRIPTS}
