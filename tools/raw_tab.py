"""Tab without a browser, for measurements of the viewer and attacks on it."""

import asyncio
import itertools
import json
import threading
import time
from collections import deque
from typing import Any

import msgspec
import viser
import zstandard
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from carts_viewer.picture.scene_view import OVERLAY

_CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 0.0),
    "fov": 1.0,
    "near": 0.01,
    "far": 100.0,
    "image_height": 600,
    "image_width": 800,
    "look_at": (0.0, 0.0, 0.1),
    "up_direction": (0.0, -1.0, 0.0),
}


_NUMBERS = itertools.count(1)
_PATIENCE = 120.0
"""Timeout for the server, for busy machines [s]."""


class RawTab:
    """Client of viser's protocol that sets widgets to any value and records received messages; a context manager."""

    def __init__(
        self,
        url: str,
        *,
        draws: bool = True,
        keep: int | None = None,
        origin: str | None = None,
        hello: bool = True,
        key: str | None = None,
    ) -> None:
        """
        Args:
            url: The page's address.
            draws: Whether the tab acknowledges pictures.
            keep: Number of overlays that are kept; None for all.
            origin: Value of the header `Origin`; None to omit it, as programs do.
            hello: Whether the tab sends `Hello`, as the page does, and waits for the answer.
            key: Key of the tab; random if None.
        """
        self._url = url.replace("http://", "ws://")
        self._draws = draws
        self._origin = None if origin is None else Origin(origin)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._connection: ClientConnection | None = None
        self._reports = itertools.count(1)
        self._joined = threading.Event()
        self._hello = hello
        self.key = key or f"raw {next(_NUMBERS)}"
        """Key of the tab."""
        self._channel: str | None = None
        self._saying: asyncio.Task[None] | None = None
        self.overlays: deque[tuple[float, bytes]] = deque(maxlen=keep)
        """Arrival time [s, perf_counter] and PNG file of each overlay."""
        self.values: dict[str, Any] = {}
        """Newest value of each widget that the server has set since this tab connected, by id."""
        self.widgets: dict[str, dict[str, Any]] = {}
        """Newest known properties of every widget, by id."""

    def __enter__(self) -> "RawTab":
        self._thread.start()
        try:
            asyncio.run_coroutine_threadsafe(self._open(), self._loop).result(_PATIENCE)
            # Before that, it would take an old value for the present one.
            if not self._joined.wait(_PATIENCE):
                raise TimeoutError(f"The server did not bring the tab up to date within {_PATIENCE:g} s.")
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result(_PATIENCE)
        self._end()

    def set(self, element: str, value: Any) -> None:
        """Set a widget's value, without the checks of the page.

        Raises:
            ConnectionClosed: the server has closed the connection.
        """
        self.send(_update(element, value))

    def report(self, kind: str, **values: Any) -> None:
        """Report an event, as our page does; errors as in `set`."""
        self.send(self._report(kind, **values))

    def find(self, label: str) -> str:
        """Id of the widget or command with this label."""
        return next(element for element, widget in self.widgets.items() if widget.get("label") == label)

    def command(self, label: str) -> str:
        """Id of the command with this label."""
        return next(
            element for element, props in self.widgets.items() if props.get("label") == label and "hotkey" in props
        )

    def press(self, command: str) -> None:
        """Trigger the command of a key; errors as in `set`."""
        self.send({"type": "CommandTriggerMessage", "uuid": command})

    def send(self, message: dict[str, Any] | bytes | str) -> None:
        """Send a message, or any bytes or text; errors as in `set`."""
        data = msgspec.msgpack.encode(message) if isinstance(message, dict) else message
        asyncio.run_coroutine_threadsafe(self._push(data), self._loop).result(_PATIENCE)

    @property
    def connected(self) -> bool:
        """Whether the connection to the server is open."""
        return not self._reader.done()

    def close_code(self, timeout: float = _PATIENCE) -> int | None:
        """Wait until the server closes the connection; returns the code, or None after the timeout [s]."""
        end = time.monotonic() + timeout
        while self.connected and time.monotonic() < end:
            time.sleep(0.02)
        return None if self._connection is None or self.connected else self._connection.close_code

    async def _push(self, data: bytes | str) -> None:
        assert self._connection is not None
        await self._connection.send(data)

    async def _open(self) -> None:
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        self._connection = await connect(
            self._url,
            subprotocols=[protocol],
            max_size=None,
            compression=None,
            origin=self._origin,
            open_timeout=_PATIENCE,
        )
        # viser counts a tab as connected once it has said where its camera is.
        await self._push(msgspec.msgpack.encode(_CAMERA))
        self._reader = asyncio.create_task(self._read(self._connection))

    async def _close(self) -> None:
        assert self._connection is not None
        if self.connected:
            await self._connection.close()
        await asyncio.gather(self._reader, return_exceptions=True)
        if self._saying is not None:
            self._saying.cancel()
            await asyncio.gather(self._saying, return_exceptions=True)

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10)
        self._loop.close()

    async def _read(self, connection: ClientConnection) -> None:
        zstd = zstandard.ZstdDecompressor()
        async for data in connection:
            assert isinstance(data, bytes)
            arrived = time.perf_counter()
            size, packed = (int.from_bytes(data[start : start + 8], "little") for start in (0, 8))
            inner = msgspec.msgpack.decode(zstd.decompress(data[16 : 16 + packed], max_output_size=size))
            for message in inner["messages"]:
                await self._note(message, arrived)

    async def _say_hello(self) -> None:
        """Send `Hello` until it is answered."""
        while not self._joined.is_set() and self.connected:
            if self._channel is not None:
                await self._push(msgspec.msgpack.encode(self._report("Hello", tab=self.key)))
            await asyncio.sleep(0.1)

    async def _note(self, message: dict[str, Any], arrived: float) -> None:
        updates, props = message.get("updates", {}), message.get("props", {})
        if message["type"] == "ReplayDoneMessage":
            if not self._hello:
                self._joined.set()
            else:
                self._saying = asyncio.create_task(self._say_hello())
        if message["type"] == "RunJavascriptMessage" and '"setPage"' in message["source"]:
            self._joined.set()
        if self._draws and message["type"] == "RunJavascriptMessage" and '"expectPicture"' in message["source"]:
            picture = json.loads(message["source"])["args"][0]
            await self._push(msgspec.msgpack.encode(self._report("Drawn", picture=picture)))
        if props.get("label") == "channel":
            self._channel = message["uuid"]
        if message["type"] == "GuiUpdateMessage" and "value" in updates:
            self.values[message["uuid"]] = updates["value"]
        if "uuid" in message:
            known = {name: message[name] for name in ("value",) if name in message}
            self.widgets.setdefault(message["uuid"], {}).update({**known, **props, **updates})
        if message.get("name") == OVERLAY and "_data" in (updates or props):
            self.overlays.append((arrived, (updates or props)["_data"]))

    def _report(self, kind: str, **values: Any) -> dict[str, Any]:
        """The message of an event."""
        assert self._channel is not None
        return _update(self._channel, json.dumps([self.key, next(self._reports), {"type": kind, **values}]))


def _update(element: str, value: Any) -> dict[str, Any]:
    """The message that a widget has a new value."""
    return {"type": "GuiUpdateMessage", "uuid": element, "updates": {"value": value}}
