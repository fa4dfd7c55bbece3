"""Widgets that emit intents; values from a browser are checked, and programmatic writes emit nothing."""

import math
from collections.abc import Callable, Hashable
from typing import Any, Protocol

import viser

from carts_viewer.actions.intents import Intent, Refresh
from carts_viewer.state import ViewState
from carts_viewer.transport.document import escaped
from carts_viewer.transport.page import TabPage
from carts_viewer.transport.viser_private import on_tab_value


class Panel(Protocol):
    """A group of widgets."""

    def show(self, state: ViewState) -> None:
        """Update the widgets."""


class PanelPage(TabPage):
    """A tab's page, whose widgets emit intents.

    Attributes:
        emit: queues an intent for the worker; never blocks.
        waits: whether an intent with this key is pending, so that its widget is ahead of the state.
        buttons: all buttons with their intents, for the list of actions.
        hints: hints of controls by element id, with names of actions in place of keys.
    """

    def __init__(
        self, client: viser.ClientHandle, emit: Callable[[Intent], None], waits: Callable[[Hashable], bool]
    ) -> None:
        super().__init__(client)
        self.emit, self.waits = emit, waits
        self.buttons: list[tuple[viser.GuiButtonHandle, Intent | Callable[[int], Intent]]] = []
        self.hints: dict[str, str] = {}
        self._windows: list[viser.PanelHandle] = []

    def open_window(self, window: viser.PanelHandle) -> None:
        """Show a floating panel, which `close_window` closes before those that were opened earlier."""
        self._windows = [*(other for other in self._windows if other is not window), window]
        window.visible = True

    def close_window(self) -> bool:
        """Close the floating panel that was opened last; returns whether there was one."""
        shown = [window for window in self._windows if window.visible]
        if shown:
            shown[-1].visible = False
        return bool(shown)

    def emit_from(self, intent: Intent | Callable[[int], Intent], client_id: int) -> None:
        """Emit an intent, or the result of `intent` for the client id."""
        self.emit(intent if isinstance(intent, Intent) else intent(client_id))

    def button(
        self, label: str, intent: Intent | Callable[[int], Intent], *, color: Any = "gray", **options: Any
    ) -> viser.GuiButtonHandle:
        """Add a button of `viser.GuiApi.add_button` to the current container.

        When pressed, it emits the intent, or the result of `intent` for the client id.
        """
        handle = self.gui.add_button(label, color=color, **options)
        self.buttons.append((handle, intent))

        @handle.on_click
        async def _(event: viser.GuiEvent) -> None:
            # A tab can send a click on a disabled button, so the controller checks every click.
            if event.client_id is not None:
                self.emit_from(intent, event.client_id)

        return handle

    def on_input(self, handle: Any, intent: Callable[[Any], Intent]) -> None:
        """Emit `intent(value)` when the user changes the widget.

        Programmatic writes, non-finite numbers and unknown choices are not input.
        """
        # After an invalid value, the widgets of the tab are reset to the state.
        on_tab_value(handle, lambda value: self.emit(intent(value) if valid(handle, value) else Refresh()))


def valid(handle: Any, value: Any) -> bool:
    """Whether a value is finite and one of the widget's options."""
    if isinstance(value, float) and not math.isfinite(value):
        return False
    options = getattr(handle, "options", None) if isinstance(handle, viser.GuiDropdownHandle) else None
    return options is None or value in options


def write(handle: Any, value: Any) -> None:
    """Set a widget's value if it differs; NaN always counts as different."""
    if handle.value != value:
        handle.value = value


def swatch(color: tuple[int, int, int], name: str) -> str:
    """Entry of a legend, as HTML."""
    square = f'<span class="carts-swatch" style="background: rgb{color}"></span>'
    return f'<span class="carts-key">{square}{escaped(name)}</span>'


def humanized(name: str) -> str:
    """Label of a joint's or field's identifier: `outer_yaw_joint` -> `Outer yaw`."""
    words = name.removesuffix("_joint").replace("_", " ").replace("-", " ").strip()
    return words[:1].upper() + words[1:]
