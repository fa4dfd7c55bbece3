"""What a tab may send: a widget's new value, a key, where its camera is. Everything else is refused unread.

The toolkit below us would let a tab set any attribute of any widget, upload files without limit, and ask for a tunnel
that opens the viewer to the internet; and a number that its wire format cannot carry, once broadcast, disconnects
every tab. So messages are checked before the toolkit sees them. Whether a value makes sense is decided later, by
the panels and the controller.
"""

import math
from collections.abc import Callable
from typing import Any

import msgspec

LARGEST_MESSAGE = 1 << 20
"""[bytes]; a larger one ends the connection."""
_LARGEST_NUMBER = float(1 << 53)
"""Up to here a float holds every integer."""
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
    """The tab's camera; the first one says that the tab is ready."""

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
    """Why a message must not be acted upon; None when it may.

    Args:
        data: What came over the websocket.
        value_of: The present value of the widget with this id; None when there is no such widget.
    """
    if not isinstance(data, bytes):
        return "it is text"
    try:
        message = _DECODER.decode(data)
    # The latter two are what it raises for text that is no UTF-8 and for depth without end.
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        return str(error)
    if isinstance(message, GuiUpdateMessage):
        return _value_refusal(message.updates.value, value_of(message.uuid))
    return None


def _value_refusal(value: bool | int | float | str, present: Any) -> str | None:
    if isinstance(present, int | float) and not isinstance(present, bool):
        if isinstance(value, bool | str):
            return f"{type(value).__name__} for a number"
        if not (math.isfinite(value) and abs(value) <= _LARGEST_NUMBER):
            return "a number out of all range"
    elif type(present) is not type(value) or not isinstance(present, bool | str):
        return f"{type(value).__name__} for {'no widget' if present is None else type(present).__name__}"
    return None
