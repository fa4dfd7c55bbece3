"""Puts a gate before a websocket server that somebody else starts: requests and messages are checked first."""

import contextlib
import http
import logging
import threading
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.typing import Data

from carts_viewer.transport.incoming import LARGEST_MESSAGE

_log = logging.getLogger(__name__)
_SERVER_CONSTRUCTION = threading.Lock()


@contextlib.contextmanager
def gated(
    respond: Callable[[Request], Response | Awaitable[Response] | None], refuse: Callable[[object], str | None]
) -> Iterator[None]:
    """While active, a websocket server that is started gets a gate.

    Args:
        respond: Answers a request; None leaves that to the server.
        refuse: Says why a message must not reach the server; None when it may.
    """
    original = websockets.asyncio.server.serve

    class Connection(ServerConnection):
        """Swallows the messages that are refused."""

        async def recv(self, decode: bool | None = None) -> Data:  # pyright: ignore[reportIncompatibleMethodOverride]
            """The next message that is not refused."""
            while True:
                data = await super().recv(decode)
                reason = refuse(data)
                if reason is None:
                    return data
                if not getattr(self, "warned", False):
                    self.warned = True
                    _log.warning("A tab sent a message that the viewer does not take: %.200r", reason)

    def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def guarded(connection: Any, request: Request) -> Any:
            answer = respond(request)
            if answer is not None or process_request is None:
                return answer
            return process_request(connection, request)

        options = {**options, "max_size": LARGEST_MESSAGE, "create_connection": Connection}
        return original(*arguments, process_request=guarded, **options)

    with _SERVER_CONSTRUCTION:
        websockets.asyncio.server.serve = serve  # type: ignore[assignment]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = original


def response(status: http.HTTPStatus, kind: str, body: bytes, **more: str) -> Response:
    """An answer that no browser guesses about, keeps, or shows inside another site.

    Args:
        status: HTTP status.
        kind: Content type.
        body: Content.
        more: Further headers, with `_` for `-`.
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
