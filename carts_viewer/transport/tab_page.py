"""One tab's part of the page: its own widgets and scene, and calls of its script."""

import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import viser

from carts_viewer.transport.viser_private import element_id, run_script, widgets


class TabPage:
    """The page of one tab.

    Attributes:
        client: the tab's connection.
        gui: where widgets are added.
        scene: where nodes are added.
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
        """Call `callback(key)` when a key of `OWN_KEYS` is pressed in this tab; a tab can send any text."""
        self._pressed.append(callback)

    def press(self, key: str) -> None:
        """A key of `OWN_KEYS` was pressed in this tab."""
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

    def row(self, *handles: viser.GuiButtonHandle, weights: Sequence[float] | None = None) -> None:
        """Lay out consecutive buttons of the current container side by side, with relative widths."""
        shares = [1.0] * len(handles) if weights is None else list(weights)
        self._side_by_side([element_id(handle) for handle in handles], shares, "div:has(> [id='{}'])")

    def columns(self, handles: Sequence[Any], count: int = 2, *, narrow_labels: bool = False) -> None:
        """Lay out consecutive checkboxes or number fields of the current container in columns, in reading order.

        Args:
            handles: The widgets, in order.
            count: How many to a line.
            narrow_labels: Make labels as narrow as their text, and fields as wide as possible.
        """
        for first in range(0, len(handles), count):
            group = [element_id(handle) for handle in handles[first : first + count]]
            # A short last line keeps the width of the others.
            box = "div:has(> .mantine-Flex-root > div [id='{}'])"
            self._side_by_side(group, [1.0] * len(group), box, total=float(count))
            if narrow_labels:
                labels = ", ".join(f"{box.format(name)} > .mantine-Flex-root > div:first-child" for name in group)
                self.gui.add_html(f"<style>{labels} {{ width: auto !important; white-space: nowrap }}</style>")

    def _side_by_side(self, ids: Sequence[str], shares: Sequence[float], box: str, total: float | None = None) -> None:
        """Lay out the boxes of these elements in a line, by a style sheet for their ids."""
        total = sum(shares) if total is None else total
        boxes = [box.format(name) for name in ids]
        rules = [
            f"{', '.join(boxes)} {{ display: inline-block; box-sizing: border-box; vertical-align: top; "
            "margin-inline: 0 !important; padding-inline: 4px !important }"
        ]
        for one, share in zip(boxes, shares, strict=True):
            # The line is as wide as single elements, which keep 10 px from either side of the panel.
            rules.append(f"{one} {{ width: calc((100% - 12px) * {share / total:.4f}) }}")
        rules.append(f"{boxes[0]} {{ margin-left: 6px !important }}")
        self.gui.add_html(f"<style>{' '.join(rules)}</style>")


def call(client: viser.ClientHandle, name: str, *arguments: Any) -> None:
    """Call `window.carts[name](*arguments)` in one tab; unknown names are ignored there."""
    run_script(client, json.dumps({"name": name, "args": arguments}))
