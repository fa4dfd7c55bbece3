"""Panel of the painting tools, their layer, and the pixels painted on this frame."""

import viser

from carts_core.model.parts import part_classes
from carts_core.settings import DescentSolver
from carts_viewer.actions import intents
from carts_viewer.panels.inputs import PanelPage, swatch, write
from carts_viewer.picture.layers import ADDED_COLOR, IGNORED_COLOR, REMOVED_COLOR, label_color
from carts_viewer.picture.strokes import DIAMETERS, Target, Tool
from carts_viewer.session import Session
from carts_viewer.state import ViewState

_ICONS = {
    Tool.OFF: viser.Icon.POINTER,
    Tool.BRUSH: viser.Icon.BRUSH,
    Tool.ERASER: viser.Icon.ERASER,
    Tool.POLYGON: viser.Icon.POLYGON,
    Tool.PROMPT: viser.Icon.WAND,
}
_HINTS = {
    Tool.OFF: "Select a tool to correct the mask, or to mark occluders for the optimizer to ignore.",
    Tool.BRUSH: "<b>Drag</b> to paint; hold <b>Shift</b> to erase.",
    Tool.ERASER: "<b>Drag</b> to erase; hold <b>Shift</b> to paint.",
    Tool.POLYGON: "<b>Click</b> the corners; <b>double click</b> or <b>Enter</b> fills the polygon, with <b>Shift</b> "
    "erases it. <b>Backspace</b> removes the last corner.",
    Tool.PROMPT: "<b>Click</b> an object to add it, or drag a <b>box</b> to replace the layer inside it. Further "
    "clicks on the object, or with <b>Shift</b> (or Alt) beside it, refine it; <b>Enter</b> starts the next object. "
    "<b>Shift</b>+click on another object removes it.",
}
_ANY = "Any arm"
_MOVING = "<b>Right-drag</b> pans, <b>wheel</b> zooms."


class PaintPanel:
    """Painting tools and layers; also sends the selected tool to the page's script."""

    def __init__(self, page: PanelPage, session: Session, state: ViewState) -> None:
        gui = page.gui
        self._page, self._scene, self._waits = page, session.scene, page.waits
        self._classes = {_ANY: 0} | {one.name: one.number for one in part_classes(session.scene.arms)}
        self._sent: dict[str, object] = self._message(state)
        with gui.add_folder("Paint", expand_by_default=False):
            self._tools = {
                tool: page.button(str(tool), intents.SetTool(tool), icon=icon, color=None)
                for tool, icon in _ICONS.items()
            }
            for first in range(0, len(Tool), 2):
                page.row(*list(self._tools.values())[first : first + 2])
            self._targets = {
                target: page.button(str(target), intents.SetTarget(target), color=None) for target in Target
            }
            page.row(*self._targets.values(), weights=(2, 3))
            self._class = gui.add_dropdown(
                "Class",
                list(self._classes),
                hint="Painted class: a part of an arm (layer Parts), or any arm. Pixels of Any arm are assigned to "
                "the nearest arm in the overlay, also in exports with a category per arm",
            )
            self._size = gui.add_slider("Size [px]", *DIAMETERS, 1, state.brush.diameter)
            self._text = gui.add_html("")
            self._clear = page.button("Clear", intents.ClearLayer(), icon=viser.Icon.TRASH)
        page.on_input(self._class, lambda name: intents.SetPaintClass(self._classes[name]))
        page.on_input(self._size, intents.SetDiameter)
        page.call("setBrush", self._sent)

    def show(self, state: ViewState) -> None:
        """Update the widgets and the page's scripts."""
        brush = state.brush
        for tool, button in self._tools.items():
            _highlight(button, tool is brush.tool)
        for target, button in self._targets.items():
            _highlight(button, target is brush.target)
        if not self._waits(intents.SetDiameter):
            write(self._size, brush.diameter)
        write(self._class, next(name for name, number in self._classes.items() if number == brush.label))
        self._class.visible = brush.target is Target.MASK
        self._size.disabled = brush.tool in (Tool.POLYGON, Tool.PROMPT)
        layer = state.mask_correction if brush.target is Target.MASK else state.ignore_region
        self._clear.label = "Clear the correction" if brush.target is Target.MASK else "Clear the ignore region"
        self._clear.disabled = layer is None and (
            brush.target is Target.IGNORE or state.part_labels_of(state.camera) is None
        )
        hint = f"{_HINTS[brush.tool]} {_MOVING}" if brush.tool is not Tool.OFF else _HINTS[brush.tool]
        if brush.target is Target.IGNORE and isinstance(state.settings, DescentSolver):
            hint += " The chosen solver does not use the ignore region; the solver <b>Surface maps</b> does."
        self._text.content = f'<p class="carts-caption">{hint}<br>{_counts(state)}</p>'
        message = self._message(state)
        if message != self._sent:
            self._sent = message
            self._page.call("setBrush", message)

    def _message(self, state: ViewState) -> dict[str, object]:
        """State for the script that draws strokes in the page."""
        camera, brush = self._scene.camera(state.camera), state.brush
        add, erase = (ADDED_COLOR, REMOVED_COLOR) if brush.target is Target.MASK else (IGNORED_COLOR, (255, 255, 255))
        label = brush.label if brush.target is Target.MASK else 0
        if label:
            add = label_color(label)
        return {
            "label": label,
            "tool": brush.tool.lower(),
            "target": brush.target,
            "diameter": brush.diameter,
            "frame": state.index,
            "camera": camera.name,
            "width": camera.width,
            "height": camera.height,
            "colors": {"add": f"rgb{add}", "erase": f"rgb{erase}"},
        }


def _highlight(button: viser.GuiButtonHandle, on: bool) -> None:
    color = "teal" if on else "gray"
    if button.color != color:
        button.color = color


def _counts(state: ViewState) -> str:
    """Numbers of painted pixels by colour, as HTML."""
    correction, region = state.mask_correction, state.ignore_region
    added, removed = (0, 0) if correction is None else (correction.added().sum(), correction.removed().sum())
    ignored = 0 if region is None else region.region().sum()
    return " ".join(
        swatch(color, f"{count} px {name}")
        for color, count, name in (
            (ADDED_COLOR, added, "added"),
            (REMOVED_COLOR, removed, "removed"),
            (IGNORED_COLOR, ignored, "ignored"),
        )
    )
