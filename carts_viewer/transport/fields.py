"""What a tab writes into invisible fields: its own name, a counter, and what it has to say."""

import math
from collections.abc import Callable
from typing import Any

import viser


def on_numbers(field: viser.GuiTextHandle, count: int, callback: Callable[..., None]) -> None:
    """Call back with a tab's number and the finite numbers that it has written behind its own name and a counter."""

    @field.on_update
    async def _(event: viser.GuiEvent) -> None:
        try:
            numbers = [float(part) for part in str(field.value).split()[2:]]
        except ValueError:
            return
        if event.client_id is not None and len(numbers) == count and all(map(math.isfinite, numbers)):
            callback(event.client_id, *numbers)


def said(value: Any) -> str:
    """What a tab has written behind its own name and a counter."""
    parts = str(value).split(maxsplit=2)
    return parts[2] if len(parts) == 3 else ""


def on_text(field: viser.GuiTextHandle, callback: Callable[[int, str], None]) -> None:
    """Call back with the tab's number and what it has written into a field behind its own name and a counter."""

    @field.on_update
    async def _(event: viser.GuiEvent) -> None:
        parts = str(field.value).split(maxsplit=2)
        if event.client_id is not None and len(parts) == 3:
            callback(event.client_id, parts[2])
