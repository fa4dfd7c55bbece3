"""The help text, and the keyboard shortcuts, which are also the command palette (Ctrl+K)."""

from collections.abc import Callable

import viser

from carts_core.resources import static_dir
from carts_viewer import intents
from carts_viewer.keys import Shortcut, key_table, shortcuts
from carts_viewer.panels.inputs import Emit
from carts_viewer.transport.page import OWN_KEYS
from carts_viewer.transport.tab_page import TabPage


class HelpPanel:
    """Registers the shortcuts and explains everything in a few words."""

    def __init__(self, page: TabPage, perturb: Callable[[], intents.Intent], emit: Emit) -> None:
        gui = page.gui
        own = {}
        for shortcut in shortcuts():
            hotkey = None if shortcut.hotkey in OWN_KEYS else shortcut.hotkey
            # viser shows the keys that it listens to itself.
            described = shortcut.key if hotkey is None else None
            command = gui.add_command(shortcut.label, description=described, hotkey=hotkey, modifier=shortcut.modifier)  # type: ignore[arg-type]
            _listen(page, command, shortcut, perturb, emit)
            if hotkey is None and isinstance(shortcut.action, intents.Intent):
                own[shortcut.hotkey] = shortcut.action
        page.on_pressed(lambda key: emit(own[key]) if key in own else None)
        text = (static_dir() / "help.md").read_text(encoding="utf-8")
        gui.add_markdown(text.replace("{shortcuts}", key_table()))


def _listen(
    page: TabPage, command: viser.CommandHandle, shortcut: Shortcut, perturb: Callable[[], intents.Intent], emit: Emit
) -> None:
    @command.on_trigger
    async def _(event: viser.CommandEvent) -> None:
        if isinstance(shortcut.action, intents.Intent):
            emit(shortcut.action)
        elif shortcut.action == "perturb":
            emit(perturb())
        else:
            page.call("toggleView")
