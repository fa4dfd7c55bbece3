"""Who may talk to the viewer."""

import socket
from urllib.parse import parse_qs, urlsplit

import pytest
from websockets.datastructures import Headers

from carts_core.errors import SettingsError
from carts_viewer.transport.guard import Guard, check_address

EVERYWHERE = ".".join("0000")


def _refusal(guard: Guard, host: str | None, *, target: str = "/", **headers: str) -> str | None:
    return guard.refusal(target, Headers(**({} if host is None else {"Host": host}), **headers))


@pytest.fixture
def local() -> Guard:
    """Of a server that only this computer reaches."""
    return Guard("127.0.0.1")


@pytest.fixture
def shared() -> Guard:
    """Of a server that everybody reaches."""
    return Guard(EVERYWHERE)


def _with_token(guard: Guard) -> str:
    return f"/?token={guard.token}"


def _cookie(guard: Guard, host: str = "192.168.0.7:8080") -> str:
    """The cookie that a browser would send back."""
    answer = guard.cookie(_with_token(guard), Headers(Host=host))
    assert answer is not None
    return answer.partition(";")[0]


@pytest.mark.parametrize(
    "host", ["127.0.0.1:8080", "localhost:8080", "localhost", "[::1]:8080", "127.0.0.1:9000", "127.0.0.2:8080"]
)
def test_this_computers_own_names_are_answered(local: Guard, host: str) -> None:
    assert _refusal(local, host) is None
    assert _refusal(local, host, Origin=f"http://{host}") is None


@pytest.mark.parametrize(
    "host",
    [
        *("evil.example", "evil.example:8080", "127.0.0.1.evil.example", "", "192.168.0.7:8080"),
        *("[", "localhost:x", "localhost/x", "localhost?x", "a; b@localhost", "localhost:1 localhost", "@localhost"),
    ],
)
def test_a_foreign_host_name_is_refused_so_that_dns_rebinding_does_not_work(local: Guard, host: str) -> None:
    assert "was asked for" in (_refusal(local, host) or "")


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "https://localhost:8080", "http://localhost:3000", "null", "http://localhost"]
)
def test_another_sites_page_is_refused_even_on_this_computer(local: Guard, origin: str) -> None:
    assert "own page only" in (_refusal(local, "localhost:8080", Origin=origin) or "")


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


def test_a_request_with_two_hosts_or_none_is_refused(local: Guard) -> None:
    both = Headers(Host="localhost:8080")
    both["Host"] = "evil.example"
    assert local.refusal("/", both) is not None
    assert _refusal(local, None) is not None


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


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://192.168.0.7"])
def test_another_sites_page_is_refused_with_the_right_token_too(shared: Guard, origin: str) -> None:
    refusal = _refusal(shared, "192.168.0.7:8080", target=_with_token(shared), Origin=origin)
    assert "own page only" in (refusal or "")


def test_where_others_reach_the_server_it_answers_by_address_and_own_name_but_by_no_other_name(shared: Guard) -> None:
    for host in ("192.168.0.7:8080", "[fe80::1]:8080", "localhost:8080", f"{socket.gethostname()}:8080"):
        assert _refusal(shared, host, target=_with_token(shared)) is None
    assert "was asked for" in (_refusal(shared, "evil.example:8080", target=_with_token(shared)) or "")
    assert _refusal(Guard("example.org"), "Example.org:8080", Cookie="x") == _refusal(shared, "192.168.0.7:8080")


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost", EVERYWHERE])
def test_addresses_of_this_computer_may_be_listened_on(host: str) -> None:
    check_address(host, 0)


@pytest.mark.parametrize("host", ["192.0.2.7", "not a name", "", "\udcff"])
def test_an_address_of_another_computer_is_an_error_that_names_it(host: str) -> None:
    with pytest.raises(SettingsError, match=r"cannot listen on .* Use 127\.0\.0\.1"):
        check_address(host, 0)


@pytest.mark.parametrize("port", [-1, 65536])
def test_a_port_that_is_none_is_an_error(port: int) -> None:
    with pytest.raises(SettingsError, match="Ports go from 1 to 65535"):
        check_address("127.0.0.1", port)
