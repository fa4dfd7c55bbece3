"""The page: a guarded viser server, its scripts and styles, its messages, and each tab's own widgets and scene.

The server is guarded (`guard.py`), and serves `static/` and pictures. A tab reports its events (`events.py`) as the
value of one invisible field.
"""

import contextlib
import functools
import hashlib
import html
import http
import io
import json
import logging
import mimetypes
import secrets
import threading
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import msgspec
import viser
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from carts_core.errors import CartsError
from carts_core.resources import static_dir

from .guard import PAGES, Guard, Proxy, check_address, gated, refusal, response
from .viser_private import element_id, icon_paths, list_icons_once, queue_safely, run_script, value_of, widgets


class TabPage:
    """The page of one tab.

    Attributes:
        client: the tab's connection.
        gui: the tab's widgets.
        scene: the tab's 3D scene.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        self.client = client
        self.gui = client.gui
        self.scene = client.scene
        self._pressed: list[Callable[[str], None]] = []

    def call(self, name: str, *arguments: Any) -> None:
        """Call `window.carts[name](*arguments)` in the tab; unknown names are ignored there."""
        call(self.client, name, *arguments)

    def on_pressed(self, callback: Callable[[str], None]) -> None:
        """Call `callback(name)` when the key of an action is pressed in this tab; the name may be any string."""
        self._pressed.append(callback)

    def press(self, key: str) -> None:
        """Call the callbacks for an action whose key was pressed in this tab."""
        for callback in self._pressed:
            callback(key)

    def atomic(self) -> AbstractContextManager[None]:
        """Context in which messages are collected and applied at once."""
        return self.client.atomic()

    def flush(self) -> None:
        """Send queued messages."""
        self.client.flush()

    def widgets(self) -> list[Any]:
        """Every widget of the tab that holds a value, buttons included."""
        return list(widgets(self.gui))

    def find(self, label: str) -> Any:
        """The widget with this label (for tests and scripts)."""
        return next(handle for handle in widgets(self.gui) if getattr(handle, "label", None) == label)

    def row(
        self,
        *handles: viser.GuiButtonHandle,
        weights: Sequence[float] | None = None,
        icons: Sequence[viser.GuiButtonHandle] = (),
    ) -> None:
        """Lay out consecutive buttons of the current container side by side, with relative widths.

        Buttons in `icons` show only their icon; their label is their name for screen readers.
        """
        shares = [1.0] * len(handles) if weights is None else list(weights)
        self._side_by_side([element_id(handle) for handle in handles], shares, "div:has(> [id='{}'])")
        if icons:
            labels = ", ".join(f"[id='{element_id(handle)}'] .mantine-Button-label" for handle in icons)
            sections = labels.replace("-label", "-section")
            buttons, pictures = (labels.replace(" .mantine-Button-label", part) for part in ("", " svg"))
            self.gui.add_html(
                f"<style>{labels} {{ position: absolute; width: 1px; height: 1px; overflow: hidden; "
                f"clip-path: inset(50%) }} {sections} {{ margin: 0 }} {buttons} {{ padding-inline: 0 !important }} "
                f"{pictures} {{ left: 0 !important }}</style>"
            )

    def columns(self, handles: Sequence[Any], count: int = 2, *, narrow_labels: bool = False) -> None:
        """Lay out consecutive checkboxes or number fields of the current container in columns, in reading order.

        Args:
            handles: The widgets, in order.
            count: Number of columns.
            narrow_labels: Make labels as narrow as their text, and fields as wide as possible.
        """
        for first in range(0, len(handles), count):
            group = [element_id(handle) for handle in handles[first : first + count]]
            # Widgets in an incomplete last row are as wide as the others.
            box = "div:has(> .mantine-Flex-root > div [id='{}'])"
            self._side_by_side(group, [1.0] * len(group), box, total=float(count))
            if narrow_labels:
                labels = ", ".join(f"{box.format(name)} > .mantine-Flex-root > div:first-child" for name in group)
                self.gui.add_html(f"<style>{labels} {{ width: auto !important; white-space: nowrap }}</style>")

    def _side_by_side(self, ids: Sequence[str], shares: Sequence[float], box: str, total: float | None = None) -> None:
        """Lay out the boxes of these elements in a row, by a style sheet for their ids."""
        total = sum(shares) if total is None else total
        boxes = [box.format(name) for name in ids]
        rules = [
            f"{', '.join(boxes)} {{ display: inline-block; box-sizing: border-box; vertical-align: top; "
            "margin-inline: 0 !important; padding-inline: 4px !important }"
        ]
        for one, share in zip(boxes, shares, strict=True):
            # The row is as wide as a single element, which keeps 10 px from either side of the panel.
            rules.append(f"{one} {{ width: calc((100% - 12px) * {share / total:.4f}) }}")
        rules.append(f"{boxes[0]} {{ margin-left: 6px !important }}")
        self.gui.add_html(f"<style>{' '.join(rules)}</style>")


def call(client: viser.ClientHandle, name: str, *arguments: Any) -> None:
    """Call `window.carts[name](*arguments)` in one tab; unknown names are ignored there."""
    run_script(client, json.dumps({"name": name, "args": arguments}))


_log = logging.getLogger(__name__)
_TITLE, _LOADER, _CLIENT = "<title>Viser</title>", "<script data-p=", 'e.type="module";'
"""Replaced parts of viser's page: its title, the script that unpacks the client, and the client's script element."""


def viser_index(head: str, nonce: str) -> str:
    """HTML of viser's page with `head` in place of its title, and a nonce for its inline scripts.

    Raises:
        CartsError: another version of viser is installed.
    """
    before, after = _parts()
    return before + head + after.replace(_LOADER, f'<script nonce="{nonce}" data-p=', 1)


@functools.cache
def _parts() -> tuple[str, str]:
    """The parts of the page before and after its title."""
    index = Path(viser.__file__).parent / "client" / "build" / "index.html"
    text = index.read_text(encoding="utf-8")
    if any(text.count(part) != 1 for part in (_TITLE, _LOADER, _CLIENT)):
        raise CartsError(
            f"{index} is not the page of viser 1.1. Install the supported version: pip install 'viser~=1.1.1'"
        )
    # The client's script element gets the nonce of the script that unpacks the client.
    text = text.replace(_CLIENT, f'{_CLIENT}e.nonce=document.querySelector("script[data-p]").nonce;')
    before, _, after = text.partition(_TITLE)
    return before, after


MEDIA = "media/"
"""Start of the addresses of pictures, relative to the page."""
_MAX_PICTURES = 256
"""Maximum number of kept pictures; the oldest are removed first."""


class Media:
    """Pictures that are served under hashes of their content."""

    def __init__(self) -> None:
        self._contents: OrderedDict[str, bytes] = OrderedDict()
        self._lock = threading.Lock()

    def publish(self, jpeg: bytes) -> str:
        """Serve a JPEG file, and return its address."""
        name = f"{hashlib.sha256(jpeg).hexdigest()[:24]}.jpg"
        with self._lock:
            self._contents[name] = jpeg
            self._contents.move_to_end(name)
            while len(self._contents) > _MAX_PICTURES:
                self._contents.popitem(last=False)
        return MEDIA + name

    def answer(self, name: str) -> Response:
        """The picture with this name; status 404 if there is none."""
        with self._lock:
            content = self._contents.get(name)
        if content is None:
            return response(http.HTTPStatus.NOT_FOUND, "text/plain; charset=utf-8", b"No such picture.")
        return response(http.HTTPStatus.OK, "image/jpeg", content)


UPLOAD = "/upload"
"""Path of the websocket of uploads."""

_ICONS = (
    "minus",
    "plus",
    "zoom-in-area",
    "maximize",
    "contrast",
    "help",
    "chevron-down",
    "chevron-up",
    "x",
    "brackets-contain-start",
    "brackets-contain-end",
    "table",
    "pointer",
    "hand-grab",
    "target",
    "brush",
    "polygon",
    "eraser",
    "wand",
    "ban",
    "trash",
)
"""Icons that the page's scripts use."""

_THUMBNAIL = "/thumbnail/"
_SCRIPTS = (
    "page",
    "paint",
    "keys",
    "tools",
    "compare",
    "marks",
    "loupe",
    "drag",
    "lanes",
    "timeline",
    "frames",
    "tour",
    "shell",
    "document",
    "upload",
    "clicks",
)
"""Files of `static/`, in the order in which they run."""

_STYLES = ("tokens", "page", "document")
"""Style sheets of `static/`."""

_POLICY = (
    "default-src 'none'; script-src 'self' 'nonce-{nonce}' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src data:; worker-src blob:; connect-src 'self' {sockets} data: blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors {ancestors}"
)
"""`Content-Security-Policy` of the page. viser's client is an inline script (hence the nonce) that unpacks itself with
WebAssembly, writes style sheets, and makes its workers and textures from blobs."""


class Page:
    """A viser server that answers only requests from its own page, and the scripts of this page."""

    def __init__(
        self, *, host: str = "127.0.0.1", port: int = 8080, title: str = "CaRTS", proxy: Proxy | None = None
    ) -> None:
        """Start serving.

        Args:
            host: The address to listen on. The URL contains a token if other computers can reach the address.
            port: The port to listen on; 0 for any free port. If the port is busy, the next free port is used.
            title: The browser tab's title.
            proxy: The reverse proxy in front of the server; None without one.

        Raises:
            SettingsError: `host` is not an address of this computer.
        """
        check_address(host, port)
        self._guard = Guard(host, proxy)
        self._title = title
        self.keys: dict[str, Any] = {}
        """Keys of the page (`actions.shortcuts.key_sheet`)."""
        self.project = ""
        """Name of the shown recording; empty if there is none."""
        self.media = Media()
        self.thumbnail: Callable[[str], Awaitable[Response]] | None = None
        """Answers requests below `/thumbnail/`; None if no recording is shown."""
        self.receive_upload: Callable[[ServerConnection], Awaitable[None]] | None = None
        """Receives the connections to `UPLOAD`; None if there are no uploads, and connections are closed."""
        self._files = {path.name: path for path in static_dir().iterdir() if path.is_file()}
        queue_safely()
        list_icons_once()
        with (
            gated(
                self._respond,
                lambda data: refusal(data, self._value_of),
                lambda path: self._receive_upload if self._guard.proxy.inside(path) == UPLOAD else None,
            ),
            contextlib.redirect_stdout(io.StringIO()),
        ):
            self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.url = self._guard.url(self.server.get_port())
        self._add_channel()
        self._set_initial_view()
        self._name = secrets.token_hex(8)
        self.server.on_client_connect(lambda client: call(client, "reloadIfServerChanged", self._name))
        self._disconnect_callbacks: list[Callable[[int], None]] = []
        self.server.on_client_disconnect(self._disconnected)

    def on_disconnect(self, callback: Callable[[int], None]) -> None:
        """Call `callback(client_id)` whenever a tab disconnects, until the page is cleared."""
        self._disconnect_callbacks.append(callback)

    def _disconnected(self, client: viser.ClientHandle) -> None:
        for callback in list(self._disconnect_callbacks):
            callback(client.client_id)

    def _add_channel(self) -> None:
        """Add the hidden text field that all tabs share: JSON with the tab's key, a counter that makes each value
        distinct, and the event."""
        self._channel = self.server.gui.add_text("channel", "", visible=False)

    def clear(self, title: str) -> None:
        """Remove all widgets, commands, nodes and callbacks; tabs must be reloaded once new widgets exist."""
        self._title = title
        self._disconnect_callbacks.clear()
        self.keys = {}
        self.project = ""
        self.thumbnail = None
        self.server.gui.reset()
        self.server.scene.reset()
        self._add_channel()
        self._set_initial_view()

    def _set_initial_view(self) -> None:
        """Set OpenCV's axes and the initial view along the optical axis."""
        self.server.scene.set_up_direction("-y")
        initial = self.server.initial_camera
        initial.up, initial.position, initial.look_at = (0.0, -1.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.1)

    def reload(self) -> None:
        """Reload the page in every tab, without the frame in its address.

        A tab that has loaded the page but is not connected yet reloads it after connecting.
        """
        self._name = secrets.token_hex(8)
        for client in self.server.get_clients().values():
            call(client, "reload")

    def close(self) -> None:
        """Stop serving and disconnect every tab."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def listen(self, kinds: Any, callback: Callable[[int, Any], None]) -> None:
        """Call `callback(client_id, event)` on the event loop for events of a tab, until the page is cleared.

        Args:
            kinds: Union of the structs that are decoded; other events are refused.
            callback: Receives an event; only the types of its values have been checked.
        """
        decoder, channel = msgspec.json.Decoder(tuple[str, int, kinds]), self._channel

        @channel.on_update
        async def _(update: viser.GuiEvent) -> None:
            if update.client_id is None:
                return
            try:
                event = decoder.decode(channel.value)[2]
            except (msgspec.DecodeError, ValueError, RecursionError) as error:
                _log.info("Refused an event from a tab: %.200s", error)
                return
            callback(update.client_id, event)

    def element_id(self, handle: Any) -> str:
        """The `id` of a widget's input element in the page (for tests and scripts)."""
        return element_id(handle)

    def _respond(self, request: Request) -> Response | Awaitable[Response] | None:
        """The viewer's response to a request; None to let viser respond."""
        target = self._guard.proxy.inside(request.path)
        reason = self._guard.refusal(target or "/", request.headers)
        if reason is not None:
            return response(http.HTTPStatus.FORBIDDEN, "text/plain; charset=utf-8", reason.encode())
        if request.headers.get("Upgrade") == "websocket":
            return None
        if target is None:
            # Addresses in the page are relative to a folder.
            slash = f"{self._guard.proxy.base_path}/"
            return response(http.HTTPStatus.PERMANENT_REDIRECT, "text/plain; charset=utf-8", b"", Location=slash)
        path = target.partition("?")[0]
        return self._page(request) if path in PAGES else self._file(path)

    def _file(self, path: str) -> Response | Awaitable[Response]:
        if path.startswith(f"/{MEDIA}"):
            return self.media.answer(path.removeprefix(f"/{MEDIA}"))
        if path.startswith(_THUMBNAIL) and self.thumbnail is not None:
            return self.thumbnail(path.removeprefix(_THUMBNAIL))
        return self._static(path.removeprefix("/static/") if path.startswith("/static/") else "")

    def _page(self, request: Request) -> Response:
        nonce = secrets.token_urlsafe(16)
        # Without a policy, viser's client would connect to any server in `?websocket=` and execute its messages.
        trusted = self._guard.proxy.trusted_origins
        sockets = " ".join(
            [f"ws://{request.headers['Host']}", *(origin.replace("http", "ws", 1) for origin in trusted)]
        )
        policy = _POLICY.format(nonce=nonce, sockets=sockets, ancestors=" ".join(trusted) or "'none'")
        cookie = self._guard.cookie(request.path, request.headers)
        more = {"Content_Security_Policy": policy} | ({} if cookie is None else {"Set_Cookie": cookie})
        return response(http.HTTPStatus.OK, "text/html; charset=utf-8", self._index(nonce), **more)

    async def _receive_upload(self, connection: ServerConnection) -> None:
        if self.receive_upload is not None:
            await self.receive_upload(connection)

    def _value_of(self, element: str) -> Any:
        # A tab may connect before the server's constructor has returned.
        return value_of(self.server, element) if hasattr(self, "server") else None

    def _static(self, name: str) -> Response:
        # Only names from a listing of the folder are served, so no path can leave it.
        file = self._files.get(name)
        if file is None:
            return response(http.HTTPStatus.NOT_FOUND, "text/plain; charset=utf-8", b"No such file.")
        kind = mimetypes.guess_type(name, strict=False)[0] or "application/octet-stream"
        return response(http.HTTPStatus.OK, kind, file.read_bytes())

    def _index(self, nonce: str) -> bytes:
        said = {
            "channel": element_id(self._channel),
            "keys": self.keys,
            "icons": {name: icon_paths(name) for name in _ICONS},
            "project": self.project,
            "server": self._name,
        }
        configuration = html.escape(json.dumps(said), quote=True)
        styles = "".join(f'<link rel="stylesheet" href="static/{name}.css" />' for name in _STYLES)
        head = (
            f"<title>{html.escape(self._title)}</title>"
            f'<link rel="icon" href="static/icon.svg" />{styles}'
            f'<script src="static/boot.js" data-configuration="{configuration}"></script>'
        )
        scripts = "".join(f'<script src="static/{name}.js" defer></script>' for name in _SCRIPTS)
        return viser_index(head + scripts, nonce).encode()
