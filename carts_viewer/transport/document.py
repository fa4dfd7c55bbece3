"""A document over the page: HTML from the server, and the choices made in it.

An element with `data-do="NAME"` reports a click (a button) or a change of its value (a list, a field) as
`events.Chosen`. With an element `data-click="NAME"`, a click in the image reports NAME and its `position`. The handler
checks name and value, since a tab can send arbitrary strings.
"""

import functools
import html
from pathlib import Path
from typing import TYPE_CHECKING, Any

import viser

from carts_core.console import visible
from carts_viewer.transport.page import Page, call
from carts_viewer.transport.viser_private import icon

if TYPE_CHECKING:
    import jinja2


class Document:
    """HTML document shown over the page in all tabs; initially empty."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self._shown = ("", "")
        # Tabs that connect later also receive the document.
        page.server.on_client_connect(lambda client: self._send(client) if self._shown[0] else None)

    def show(self, content: str, place: str = "page") -> None:
        """Show HTML in all tabs, including tabs that connect later.

        Args:
            content: HTML with escaped values; "" removes the document.
            place: "page" covers the whole page; "side" covers its left side, so that the image remains visible.
        """
        self._shown = (content, place)
        for client in self.page.server.get_clients().values():
            self._send(client)

    def set_progress(self, share: float) -> None:
        """Set the progress bar of the document in all tabs to a share in [0, 1]."""
        for client in self.page.server.get_clients().values():
            call(client, "setProgress", share)

    @property
    def content(self) -> str:
        """The shown HTML; empty if there is none."""
        return self._shown[0]

    def _send(self, client: viser.ClientHandle) -> None:
        call(client, "showDocument", *self._shown)


def position(value: str, origin: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float] | None:
    """Position "U V" of a choice from an origin, relative to the image size; None if it is malformed or outside of the
    image."""
    try:
        u, v = (start + float(part) for start, part in zip(origin, value.split(), strict=True))
    except ValueError:
        return None
    return (u, v) if 0.0 <= u <= 1.0 and 0.0 <= v <= 1.0 else None


def escaped(value: Any) -> str:
    """The text escaped for use in HTML and its attributes."""
    return html.escape(visible(str(value)), quote=True)


def render(template: str, **values: Any) -> str:
    """HTML of a template in `carts_viewer/templates/`; values are escaped as by `escaped`, those with the filter
    `payload` for HTML only."""
    return _templates().get_template(template).render(values)


@functools.cache
def _templates() -> "jinja2.Environment":
    # Not needed by the viewer of one sequence.
    import jinja2  # noqa: PLC0415
    from markupsafe import Markup, escape  # noqa: PLC0415

    loader = jinja2.FileSystemLoader(Path(__file__).parent.parent / "templates")
    environment = jinja2.Environment(
        loader=loader,
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: value if hasattr(value, "__html__") else visible(str(value)),
    )
    # Lone surrogates, of names that are not UTF-8, cannot be reported.
    environment.filters["payload"] = lambda value: escape(str(value).encode("utf-8", "backslashreplace").decode())
    environment.globals["icon"] = lambda name: Markup(icon(name).replace("<svg ", '<svg aria-hidden="true" ', 1))
    return environment
