"""Access control of the viewer: filters of requests and of tab messages."""

import contextlib
import http
import ipaddress
import logging
import math
import re
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.typing import Data

from carts_core.errors import SettingsError

PAGES = ("/", "/index.html")
"""Paths of the page."""
_REMOTE = "192.0.2.1"
"""Address reserved for documentation (RFC 5737), used to find the outgoing network interface."""


def check_address(host: str, port: int) -> None:
    """Raise `SettingsError` unless `host` is an address of this computer and `port` is valid."""
    if not 0 <= port <= 65535:
        raise SettingsError(f"Port {port} is invalid. Give 1 to 65535, or 0 for a free port.")
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


@dataclass(frozen=True)
class Proxy:
    """Reverse proxy in front of the viewer."""

    base_path: str = ""
    """Path of the page at the proxy, such as /x/y; accepted in requests, whether or not the proxy removes it."""
    trusted_origins: tuple[str, ...] = ()
    """Origins at which browsers see the page or the notebook that embeds it, such as https://host."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"(/[A-Za-z0-9._~@-]+)*", self.base_path):
            raise SettingsError(
                f"The base path is {self.base_path!r}. Give a path such as /x/y: names with a slash before each, and "
                "none at the end."
            )
        for origin in self.trusted_origins:
            if not re.fullmatch(r"https?://([a-z0-9.-]+|\[[0-9a-f:]+\])(:[1-9]\d{0,4})?", origin):
                raise SettingsError(
                    f"The trusted origin is {origin!r}. Give https://host or https://host:port, as a browser sends "
                    "it: in lower case and without a path."
                )

    def inside(self, target: str) -> str | None:
        """A requested target without the base path; None for the base path without a slash, which is redirected."""
        path, mark, query = target.partition("?")
        if not self.base_path or not f"{path}/".startswith(f"{self.base_path}/"):
            return target
        rest = path.removeprefix(self.base_path)
        return f"{rest}{mark}{query}" if rest else None


class Guard:
    """Decides which requests a server answers.

    Attributes:
        token: Token required in a first request; None if only this computer can reach the server.
        proxy: The reverse proxy.
    """

    def __init__(self, host: str, proxy: Proxy | None = None) -> None:
        self._host = host
        self.proxy = proxy or Proxy()
        self._proxy_hosts = {urlsplit(origin).netloc for origin in self.proxy.trusted_origins}
        self.token = None if _is_loopback(host) else secrets.token_urlsafe(32)
        # Differs from the token, which may remain in a browser's history or a terminal.
        self._session = secrets.token_urlsafe(32)

    def url(self, port: int) -> str:
        """Address of the page, with the token if there is one."""
        if self.token is None:
            return f"http://{_bracketed(self._host)}:{port}"
        host = _own_address() if _is_wildcard(self._host) else self._host
        return f"http://{_bracketed(host)}:{port}/?token={self.token}"

    def refusal(self, target: str, headers: Headers) -> str | None:
        """Reason to refuse a request; None to answer it.

        Args:
            target: Requested path and query.
            headers: Headers of the request.
        """
        hosts = headers.get_all("Host")
        own = len(hosts) == 1 and self._is_ours(_hostname(hosts[0]))
        if not own and (len(hosts) != 1 or hosts[0] not in self._proxy_hosts):
            return (
                f"Requests for {', '.join(hosts)!r} are refused. Use the viewer's own address, or allow the address of "
                "a proxy with --trusted-origin."
            )
        trusted = {*self.proxy.trusted_origins, *([f"http://{hosts[0]}"] if own else [])}
        for origin in headers.get_all("Origin"):
            if origin not in trusted:
                return f"Requests from {origin!r} are refused. Only the viewer's own page is allowed."
        if _from_another_page(target, headers, framed=bool(self.proxy.trusted_origins)):
            return "The viewer's files are available to its own page only. Open the page instead."
        if self.token is not None and not (self._has_token(target) or self._has_cookie(headers)):
            return "A token is required. Open the address that the viewer printed, with the token at its end."
        return None

    def cookie(self, target: str, headers: Headers) -> str | None:
        """`Set-Cookie` header of the response to a request with a token; None if the request has no token.

        Scripts cannot read the cookie, and no other site can make a browser send it.
        """
        if self.token is None or not self._has_token(target):
            return None
        return f"{_cookie_name(headers)}={self._session}; Path={self.proxy.base_path}/; HttpOnly; SameSite=Strict"

    def _is_ours(self, name: str | None) -> bool:
        """Whether a host name may refer to this server."""
        if name is not None and _is_loopback(name):
            return True
        if self.token is None or name is None:
            return False
        # DNS rebinding can use any other name, but neither an address nor this computer's own name.
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
    """Whether a value equals the secret; compares in constant time."""
    return any([secrets.compare_digest(value.encode("utf-8", "replace"), secret.encode()) for value in given])


def _from_another_page(target: str, headers: Headers, *, framed: bool) -> bool:
    """Whether a request comes from a page of another origin, which may only link to our pages.

    Websockets are checked by their `Origin`, which every browser sends. Frames are allowed if `framed`; the page's
    policy then names the origins that may embed it.
    """
    if headers.get("Upgrade") == "websocket" or set(headers.get_all("Sec-Fetch-Site")) <= {"same-origin", "none"}:
        return False
    places = (["document"], ["iframe"]) if framed else (["document"],)
    opened = headers.get_all("Sec-Fetch-Mode") == ["navigate"] and headers.get_all("Sec-Fetch-Dest") in places
    return not (opened and target.partition("?")[0] in PAGES)


def _cookie_name(headers: Headers) -> str:
    """Name of the cookie; one per port, since all ports of a computer share their cookies."""
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
    """Whether a server with this address listens on every address of this computer."""
    address = _address(host)
    return address is not None and address.is_unspecified


def _own_address() -> str:
    """The address by which other computers most likely reach this one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Sends nothing; the system only chooses a network interface.
            probe.connect((_REMOTE, 9))
        except OSError:
            return socket.gethostname()
        return str(probe.getsockname()[0])


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _hostname(host: str) -> str | None:
    """Host name in a `Host` header; None if the header is not a name with an optional port."""
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port  # Raises if the port is invalid.
    except ValueError:
        return None
    return parts.hostname if parts.netloc == host and parts.username is None else None


MAX_MESSAGE_SIZE = 1 << 20
"""Maximum size of a message [bytes]; a larger message ends the connection."""
_MAX_NUMBER = float(1 << 53)
"""Maximum absolute value of a number; floats represent all integers up to this value."""
_Point = tuple[float, float, float]


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    value: bool | int | float | str


class GuiUpdateMessage(msgspec.Struct, tag_field="type", tag=True, forbid_unknown_fields=True):
    """A widget has a new value."""

    uuid: str
    updates: _Value


class CommandTriggerMessage(msgspec.Struct, tag_field="type", tag=True, forbid_unknown_fields=True):
    """A key was pressed, or a command chosen."""

    uuid: str


class ViewerCameraMessage(msgspec.Struct, tag_field="type", tag=True, forbid_unknown_fields=True):
    """Camera of the tab; the first message shows that the tab is ready."""

    wxyz: tuple[float, float, float, float]
    position: _Point
    fov: float
    near: float
    far: float
    image_height: int
    image_width: int
    look_at: _Point
    up_direction: _Point


_DECODER = msgspec.msgpack.Decoder(GuiUpdateMessage | CommandTriggerMessage | ViewerCameraMessage)


def refusal(data: object, value_of: Callable[[str], Any]) -> str | None:
    """Reason to refuse a message; None to accept it.

    Args:
        data: The message.
        value_of: Returns the current value of the widget with an id; None if there is no such widget.
    """
    if not isinstance(data, bytes):
        return "text instead of bytes"
    try:
        message = _DECODER.decode(data)
    # Invalid UTF-8 raises UnicodeDecodeError, and excessive nesting raises RecursionError.
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        return str(error)
    if isinstance(message, GuiUpdateMessage):
        return _value_refusal(message.updates.value, value_of(message.uuid))
    return None


def _value_refusal(value: bool | int | float | str, present: Any) -> str | None:
    if isinstance(present, int | float) and not isinstance(present, bool):
        if isinstance(value, bool | str):
            return f"{type(value).__name__} for a number"
        if not (math.isfinite(value) and abs(value) <= _MAX_NUMBER):
            return "a number out of range"
    elif type(present) is not type(value) or not isinstance(present, bool | str):
        return f"{type(value).__name__} for {'no widget' if present is None else type(present).__name__}"
    return None


_log = logging.getLogger(__name__)
_SERVER_CONSTRUCTION = threading.Lock()


@contextlib.contextmanager
def gated(
    respond: Callable[[Request], Response | Awaitable[Response] | None],
    refuse: Callable[[object], str | None],
    handler_of: Callable[[str], Callable[[ServerConnection], Awaitable[None]] | None],
) -> Iterator[None]:
    """Context in which started websocket servers filter requests and messages.

    Args:
        respond: Returns the response to a request; None to let the server respond.
        refuse: Returns the reason to drop a message; None to accept it.
        handler_of: Returns the handler of connections to a path, which checks its messages itself and depends on
            nothing else; None for the server's handler.
    """
    original = websockets.asyncio.server.serve

    class Connection(ServerConnection):
        """A connection that drops refused messages."""

        async def recv(self, decode: bool | None = None) -> Data:  # pyright: ignore[reportIncompatibleMethodOverride]
            """The next message that is not refused."""
            while True:
                data = await super().recv(decode)
                reason = None if _own_handler(self) else refuse(data)
                if reason is None:
                    return data
                if not getattr(self, "warned", False):
                    self.warned = True
                    _log.warning("Refused a message from a tab: %.200r", reason)

    def _own_handler(connection: ServerConnection) -> Callable[[ServerConnection], Awaitable[None]] | None:
        return handler_of(connection.request.path.partition("?")[0]) if connection.request else None

    def serve(handler: Any, *arguments: Any, process_request: Any = None, **options: Any) -> Any:
        async def handled(connection: ServerConnection) -> None:
            await (_own_handler(connection) or handler)(connection)

        def guarded(connection: Any, request: Request) -> Any:
            answer = respond(request)
            if answer is not None or process_request is None:
                return answer
            return process_request(connection, request)

        options = {**options, "max_size": MAX_MESSAGE_SIZE, "create_connection": Connection}
        return original(handled, *arguments, process_request=guarded, **options)

    with _SERVER_CONSTRUCTION:
        websockets.asyncio.server.serve = serve  # type: ignore[assignment]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = original


def response(status: http.HTTPStatus, kind: str, body: bytes, **more: str) -> Response:
    """A response with headers against MIME sniffing, caching and framing; `more`: headers with `_` instead of `-`.

    `frame-ancestors` in a `Content-Security-Policy` takes precedence over `X-Frame-Options`.
    """
    headers = Headers()
    headers["Content-Type"] = kind
    headers["Content-Length"] = str(len(body))
    headers["Cache-Control"] = "no-cache"
    headers["X-Content-Type-Options"] = "nosniff"
    headers["X-Frame-Options"] = "DENY"
    headers["Cross-Origin-Resource-Policy"] = "same-origin"
    headers["Referrer-Policy"] = "no-referrer"
    for name, value in more.items():
        headers[name.replace("_", "-")] = value
    return Response(status.value, status.phrase, headers, body)
