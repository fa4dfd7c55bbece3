"""Who may talk to the viewer: this computer alone, or others who have the token; never another site's page.

The toolkit below us checks neither `Host` nor `Origin`, so any page the user visits could open a websocket to the
viewer and drive it. Three rules close that: `Host` names this computer (no DNS rebinding); an `Origin`, which every
browser sends with a websocket, is the origin that the page itself was loaded from; and `Sec-Fetch-Site`, which browsers
send with every request to this computer, names no other site, except for the page itself when a link leads there.

Where other computers can reach the viewer, a fourth rule holds: every request, the websocket's included, carries the
token that was printed when the viewer started, or the cookie that a browser got for it.
"""

import ipaddress
import secrets
import socket
from collections.abc import Iterable
from urllib.parse import parse_qs, urlsplit

from websockets.datastructures import Headers

from carts_core.errors import SettingsError

PAGES = ("/", "/index.html")
"""Paths of the page."""
_ELSEWHERE = "192.0.2.1"
"""An address that is reserved for documentation, to ask the system which way it would send."""


def check_address(host: str, port: int) -> None:
    """Raise `SettingsError` unless `host` is an address of this computer and `port` a port."""
    if not 0 <= port <= 65535:
        raise SettingsError(f"The viewer was asked to use port {port}. Ports go from 1 to 65535; 0 picks a free one.")
    try:
        if not host:
            raise OSError("it is empty")
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        raise SettingsError(
            f"The viewer cannot listen on {host!r} ({error}). Use 127.0.0.1, or an address of this computer."
        ) from error


class Guard:
    """Decides which requests one server answers.

    Attributes:
        token: What a first request must carry; None where only this computer can reach the server.
    """

    def __init__(self, host: str) -> None:
        """
        Args:
            host: The address that the server listens on.
        """
        self._host = host
        self.token = None if _is_loopback(host) else secrets.token_urlsafe(32)
        # Not the token itself, which may stay behind in a browser's history or a terminal.
        self._session = secrets.token_urlsafe(32)

    def url(self, port: int) -> str:
        """Where to open the page, with the token if there is one."""
        if self.token is None:
            return f"http://{_bracketed(self._host)}:{port}"
        host = _own_address() if _is_wildcard(self._host) else self._host
        return f"http://{_bracketed(host)}:{port}/?token={self.token}"

    def refusal(self, target: str, headers: Headers) -> str | None:
        """Why a request must not be answered; None when it may.

        Args:
            target: What is asked for: path and query.
            headers: Of the request.
        """
        hosts = headers.get_all("Host")
        if len(hosts) != 1 or not self._is_ours(_hostname(hosts[0])):
            return f"The viewer answers by its own address only, and was asked for {', '.join(hosts)!r}."
        for origin in headers.get_all("Origin"):
            if origin != f"http://{hosts[0]}":
                return f"The viewer answers its own page only, and this request came from {origin!r}."
        if _from_another_page(target, headers):
            return "The viewer's files are for its own page only. Open the page itself."
        if self.token is not None and not (self._has_token(target) or self._has_cookie(headers)):
            return "Open the address that the viewer printed when it started, with the token at its end."
        return None

    def cookie(self, target: str, headers: Headers) -> str | None:
        """The `Set-Cookie` that answers a request for the page with a token; None without one.

        Scripts cannot read it, and no other site can make a browser send it.
        """
        if self.token is None or not self._has_token(target):
            return None
        return f"{_cookie_name(headers)}={self._session}; Path=/; HttpOnly; SameSite=Strict"

    def _is_ours(self, name: str | None) -> bool:
        """Whether a request may call this server so."""
        if name is not None and _is_loopback(name):
            return True
        if self.token is None or name is None:
            return False
        # DNS rebinding makes any other name lead here, but neither an address nor this computer's own name.
        own = socket.gethostname().lower().partition(".")[0]
        names = {self._host.lower(), socket.gethostname().lower(), own, f"{own}.local"}
        return _address(name) is not None or name in names

    def _has_token(self, target: str) -> bool:
        query = target.partition("?")[2]
        return _any_equal(parse_qs(query, errors="replace").get("token", []), self.token or "")

    def _has_cookie(self, headers: Headers) -> bool:
        name = _cookie_name(headers)
        pairs = [pair.strip().partition("=") for line in headers.get_all("Cookie") for pair in line.split(";")]
        return _any_equal([value for key, _, value in pairs if key == name], self._session)


def _any_equal(given: Iterable[str], secret: str) -> bool:
    """Whether one of these is the secret; takes as long for a nearly right one as for a wrong one."""
    return any([secrets.compare_digest(value.encode("utf-8", "replace"), secret.encode()) for value in given])


def _from_another_page(target: str, headers: Headers) -> bool:
    """Whether a browser asks for a page of another origin; such a page may only link to ours, for the user to go to.

    A websocket is judged by its `Origin`, which every browser sends with it.
    """
    if headers.get("Upgrade") == "websocket" or set(headers.get_all("Sec-Fetch-Site")) <= {"same-origin", "none"}:
        return False
    to_a_tab = headers.get_all("Sec-Fetch-Mode") == ["navigate"] and headers.get_all("Sec-Fetch-Dest") == ["document"]
    return not (to_a_tab and target.partition("?")[0] in PAGES)


def _cookie_name(headers: Headers) -> str:
    """One for each port, since cookies, unlike origins, do not tell the ports of a computer apart."""
    return f"carts-{urlsplit('//' + headers['Host']).port or 80}"


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _is_loopback(host: str) -> bool:
    address = _address(host)
    return host == "localhost" or (address is not None and address.is_loopback)


def _is_wildcard(host: str) -> bool:
    """Whether a server there listens on every address of this computer."""
    address = _address(host)
    return address is not None and address.is_unspecified


def _own_address() -> str:
    """The address by which other computers most likely reach this one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Sends nothing: it only makes the system choose a network interface.
            probe.connect((_ELSEWHERE, 9))
        except OSError:
            return socket.gethostname()
        return str(probe.getsockname()[0])


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _hostname(host: str) -> str | None:
    """Of what a `Host` header says; None for what is more, or less, than a name and a port."""
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port  # Raises when it is none.
    except ValueError:
        return None
    return parts.hostname if parts.netloc == host and parts.username is None else None
