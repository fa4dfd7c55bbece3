"""Keyboard shortcuts, which are also the command palette (Ctrl+K), and the help text."""

from collections.abc import Callable
from dataclasses import dataclass

import viser

from carts_core.resources import static_dir
from carts_viewer import intents as ask
from carts_viewer.layers import Layer
from carts_viewer.page import Page
from carts_viewer.panels.inputs import Emit


@dataclass(frozen=True)
class Shortcut:
    """A key and what it does."""

    key: str
    """As people read it."""
    label: str
    intent: ask.Intent | None
    """None for what happens in the tab alone."""
    hotkey: str
    modifier: str | None = None


def shortcuts(
    layers: list[Layer], perturb: Callable[[], ask.Intent]
) -> list[tuple[Shortcut, Callable[[], ask.Intent | None]]]:
    """Every shortcut with what makes its intent when the key is pressed.

    Letters that viser uses to fly the camera (W A S D Q E) are left alone, and so are the arrow keys, which move a
    slider that has the focus.
    """
    fixed = [
        Shortcut("Space", "Play or stop", ask.Play(), "space"),
        Shortcut("N", "Next frame", ask.MoveFrame(1), "N"),
        Shortcut("B", "Previous frame (back)", ask.MoveFrame(-1), "B"),
        Shortcut("R", "Run or pause the optimizer", ask.RunOrPause(), "R"),
        Shortcut("T", "One step of the optimizer", ask.Step(), "T"),
        Shortcut("X", "Reset to the start of the run", ask.Reset(), "X"),
        Shortcut("P", "Perturb all joints", None, "P"),
        Shortcut("M", "Back to measured joints", ask.BackToMeasured(), "M"),
        Shortcut("Ctrl+Z", "Undo", ask.Undo(), "Z", "cmd/ctrl"),
        Shortcut("V", "Endoscope view or 3D view", None, "V"),
        *(
            Shortcut(str(number), f"Overlay: {layer.lower()}", ask.ShowLayer(layer), str(number))
            for number, layer in enumerate(layers, start=1)
        ),
    ]
    return [(shortcut, perturb if shortcut.hotkey == "P" else lambda s=shortcut: s.intent) for shortcut in fixed]


class HelpPanel:
    """Registers the shortcuts and explains everything in a few words."""

    def __init__(self, page: Page, layers: list[Layer], perturb: Callable[[], ask.Intent], emit: Emit) -> None:
        gui = page.server.gui
        table = ["| Key | What it does |", "|---|---|"]
        for shortcut, make in shortcuts(layers, perturb):
            command = gui.add_command(shortcut.label, hotkey=shortcut.hotkey, modifier=shortcut.modifier)  # type: ignore[arg-type]
            table.append(f"| **{shortcut.key}** | {shortcut.label} |")
            _listen(page, command, make, emit)
        text = (static_dir() / "help.md").read_text(encoding="utf-8")
        gui.add_markdown(text.replace("{shortcuts}", "\n".join(table)))


def _listen(page: Page, command: viser.CommandHandle, make: Callable[[], ask.Intent | None], emit: Emit) -> None:
    @command.on_trigger
    async def _(event: viser.CommandEvent) -> None:
        intent = make()
        if intent is not None:
            emit(intent)
        elif event.client is not None:
            page.tell(event.client, "toggleView")
