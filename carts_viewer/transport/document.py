"""A document over the page: HTML from the server, and the choices made in it.

An element with `data-do="NAME"` reports a click (a button) or a change of its value (a list, a field). The handler of
the name checks the value: a tab can send anything.
"""

import html
import json
from collections.abc import Callable
from typing import Any

import viser

from carts_core.console import visible
from carts_viewer.transport.page import Page
from carts_viewer.transport.tab_page import call

_LONGEST = 4096
"""Longest value that is taken [characters]."""


class Document:
    """A document over the page in all tabs; empty at first."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._shown = ("", "")
        page.server.on_client_connect(self._greet)

    def show(self, content: str, place: str = "page") -> None:
        """Show HTML in all tabs and in those that join later.

        Args:
            content: HTML in which everything foreign is escaped; "" takes the document away.
            place: "page" covers the whole page, "side" its left side, and the picture stays to be seen.
        """
        self._shown = (content, place)
        for client in self._page.server.get_clients().values():
            self._send(client)

    @property
    def content(self) -> str:
        """The HTML that is shown; empty if none is."""
        return self._shown[0]

    def on_chosen(self, callback: Callable[[str, str], None]) -> None:
        """Call `callback(name, value)` on the event loop for what is chosen; any two texts."""

        def said(text: str) -> None:
            if (choice := _choice(text)) is not None:
                callback(*choice)

        self._page.on_chosen(said)

    def _greet(self, client: viser.ClientHandle) -> None:
        if self._shown[0]:
            self._send(client)

    def _send(self, client: viser.ClientHandle) -> None:
        call(client, "showDocument", *self._shown)


def _choice(text: str) -> tuple[str, str] | None:
    try:
        name, value = json.loads(text)
    except (ValueError, TypeError, RecursionError):
        return None
    known = isinstance(name, str) and isinstance(value, str) and len(name) < _LONGEST and len(value) < _LONGEST
    return (name, value) if known else None


def escaped(value: Any) -> str:
    """Text for use inside HTML and its attributes."""
    return html.escape(visible(str(value)), quote=True)


def alert(problem: object) -> str:
    """A problem as HTML; nothing for an empty one."""
    return f'<div class="problem" role="alert">{escaped(problem)}</div>' if problem else ""


def button(name: str, label: str, value: str = "", *, kind: str = "", disabled: bool = False) -> str:
    """A button as HTML; `kind` is a class: "main" or "quiet" or "card"."""
    off = " disabled" if disabled else ""
    return (
        f'<button type="button" class="{escaped(kind)}" data-do="{escaped(name)}" '
        f'data-value="{escaped(value)}"{off}>{escaped(label)}</button>'
    )


def choices(name: str, options: dict[str, str], chosen: str, *, label: str = "") -> str:
    """A list to choose from as HTML; `options` are labels by value."""
    entries = "".join(
        f'<option value="{escaped(value)}"{" selected" if value == chosen else ""}>{escaped(text)}</option>'
        for value, text in options.items()
    )
    return f'<select data-do="{escaped(name)}" aria-label="{escaped(label or name)}">{entries}</select>'


def text_field(name: str, value: str, *, label: str = "", hint: str = "") -> str:
    """A field for a short text as HTML."""
    return (
        f'<input type="text" data-do="{escaped(name)}" value="{escaped(value)}" '
        f'aria-label="{escaped(label or name)}" placeholder="{escaped(hint)}" spellcheck="false">'
    )


def check_box(name: str, checked: bool, label: str) -> str:
    """A box to tick as HTML; its value is "1" or "0"."""
    on = " checked" if checked else ""
    return f'<label class="tick"><input type="checkbox" data-do="{escaped(name)}"{on}> {escaped(label)}</label>'
