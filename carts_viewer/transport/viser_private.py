"""Private viser APIs used by the viewer.

No other module uses them. viser is pinned to one minor version, tests/viewer/test_transport.py names every
attribute that is used, and the browser tests use all of them.
"""

import asyncio
import dataclasses
import functools
import warnings
from collections.abc import Callable, Iterable
from typing import Any
from zipfile import ZipFile

import viser
from viser import _gui_api, _gui_handles
from viser._icons import ICONS_DIR
from viser._messages import RunJavascriptMessage
from viser.infra import _infra
from viser.infra._async_message_buffer import AsyncMessageBuffer


def list_icons_once() -> None:
    """Make viser list its archive of icons only once; listing it for every icon takes 0.5 s per tab."""
    _gui_api.svg_from_icon = _gui_handles.svg_from_icon = icon  # pyright: ignore[reportPrivateImportUsage]


@functools.cache
def icon(name: str) -> str:
    """The SVG of an icon of the Tabler set."""
    return _icons().read(f"{name}.svg").decode()


def icon_paths(name: str) -> str:
    """The elements within the SVG of an icon, without the SVG itself."""
    return icon(name).split(">", 1)[1].rsplit("</svg>", 1)[0]


@functools.cache
def _icons() -> ZipFile:
    return ZipFile(ICONS_DIR / "tabler-icons.zip")


def element_id(handle: Any) -> str:
    """The `id` of a widget's input element in the page."""
    return handle._impl.uuid


def widgets(gui: viser.GuiApi) -> Iterable[Any]:
    """All widgets with a value, of the server or of a client."""
    return gui._gui_input_handle_from_uuid.values()


def value_of(server: viser.ViserServer, element: str) -> Any:
    """The current value of the widget with this id, of the server or of a client; None if there is no such widget."""
    for owner in (server, *server.get_clients().values()):
        handle = owner.gui._gui_input_handle_from_uuid.get(element)
        if handle is not None:
            return handle._impl.value
    return None


def image_file(handle: viser.ImageHandle) -> bytes:
    """The last sent PNG or JPEG file of an image."""
    return handle._data


def run_script(client: viser.ClientHandle, source: str) -> None:
    """Send a script to one tab, where `static/boot.js` accepts only JSON and runs no code.

    Never broadcast: viser replays a broadcast script to every tab that joins later.
    """
    client._websock_connection.queue_message(RunJavascriptMessage(source=source))


def on_tab_value(handle: Any, callback: Callable[[Any], None]) -> None:
    """Call `callback(value)` on the event loop whenever a tab sends a new value for a widget.

    viser's own `on_update` reads the value from the widget later, when the worker may have overwritten it with an older
    value.
    """
    impl = handle._impl
    update_other_tabs = impl.sync_cb

    def sent(client_id: int, updates: dict[str, Any]) -> None:
        update_other_tabs(client_id, updates)
        callback(updates["value"])

    impl.sync_cb = sent


class LoopEvent(asyncio.Event):
    """An event that can be set on its event loop only; calls of `set` from other threads have no effect."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._own_loop = loop

    def set(self) -> None:
        """Wake all waiting tasks, if this runs on the event loop."""
        try:
            running = asyncio.get_running_loop()
        except RuntimeError:
            return
        if running is self._own_loop:
            super().set()


@dataclasses.dataclass
class MessageBuffer(AsyncMessageBuffer):
    """viser's queue with a `LoopEvent`."""

    def __post_init__(self) -> None:
        self.message_event = LoopEvent(self.event_loop)


def queue_safely() -> None:
    """Use `MessageBuffer` in all servers that start later."""
    # Tabs disconnect at any time; messages to a closed tab are not needed.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
    _infra.AsyncMessageBuffer = MessageBuffer  # pyright: ignore[reportAttributeAccessIssue, reportPrivateImportUsage]
