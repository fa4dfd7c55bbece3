"""What is drawn over the frame, and what its colours mean."""

import numpy as np

from carts_core.model.parts import part_classes
from carts_core.project import Key
from carts_core.wording import counted
from carts_viewer import intents
from carts_viewer.compare import Against
from carts_viewer.imported import with_imported
from carts_viewer.layers import ARM_COLORS, TRUTH_COLORS, Layer, label_color
from carts_viewer.panels.inputs import Emit, Waits, on_input, swatch, write
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.transport.tab_page import TabPage

_NOTHING = "Nothing"
_RAMPS = {
    Layer.ATTENTION: '<span class="carts-ramp"></span> 0 (left out) to 1 (counts fully)',
    Layer.SIMILARITY: '<span class="carts-ramp"></span> 0 (unlike) to 1 (alike)',
}


class OverlayPanel:
    """Layer and opacity, with a legend and the fit to the truth."""

    def __init__(self, page: TabPage, session: Session, state: ViewState, emit: Emit, waits: Waits) -> None:
        gui = page.gui
        self._waits, self._session = waits, session
        self._arms = [arm.name for arm in session.scene.arms]
        self._classes = part_classes(session.scene.arms)
        with gui.add_folder("Overlay"):
            self._layer = gui.add_dropdown("Layer", [str(layer) for layer in Layer], initial_value=str(state.layer))
            self._opacity = gui.add_slider("Opacity %", 0, 100, 5, round(100 * state.opacity))
            self._legend = gui.add_html("")
            self._against = gui.add_dropdown(
                "Compare with", [_NOTHING, *map(str, Against)], hint="Hold . to see only the other pose"
            )
            self._swipe = gui.add_slider("Swipe %", 0, 100, 1, 50, visible=False)
        on_input(self._layer, lambda value: intents.ShowLayer(Layer(value)), emit)
        on_input(self._against, lambda name: intents.CompareWith(None if name == _NOTHING else Against(name)), emit)
        on_input(self._swipe, lambda value: intents.SetSwipe(value / 100), emit)
        on_input(self._opacity, lambda value: intents.SetOpacity(value / 100), emit)

    def show(self, state: ViewState) -> None:
        """Bring the widgets up to date."""
        write(self._layer, str(state.layer))
        if not self._waits(intents.SetOpacity):
            write(self._opacity, round(100 * state.opacity))
        write(self._against, str(state.compare.against or _NOTHING))
        self._swipe.visible = state.compare.against is not None
        if not self._waits(intents.SetSwipe):
            write(self._swipe, round(100 * state.compare.swipe))
        self._legend.content = f'<div class="carts-legend">{self._explain(state)}</div>'

    def _explain(self, state: ViewState) -> str:
        if state.layer in (Layer.MASK, Layer.CONTOUR):
            return " ".join(
                swatch(ARM_COLORS[number % len(ARM_COLORS)], name) for number, name in enumerate(self._arms)
            )
        if state.layer is Layer.PARTS:
            return " ".join(swatch(label_color(one.number), one.name) for one in self._classes)
        if state.layer is Layer.TRUTH:
            if state.camera not in (with_imported(state.frame, self._session.scene, state.project).masks or {}):
                return "This frame has no mask to compare with."
            return " ".join(swatch(color, name.capitalize()) for name, color in TRUTH_COLORS.items())
        if state.layer is Layer.IMPORTED:
            return self._explain_imported(state)
        return _RAMPS.get(state.layer, "")

    def _explain_imported(self, state: ViewState) -> str:
        """The labels of others; those of the shown frame."""
        layer = state.project.get(Key.imported_mask(state.index, state.camera))
        points = state.project.get(Key.imported_keypoints(state.index, state.camera))
        known = state.project.get(Key.imported_labels())
        names = () if known is None else known.names
        if layer is None and points is None:
            return "Nothing was imported for this frame and camera."
        there = set() if layer is None else set(np.unique(layer.labels()).tolist())
        swatches = [swatch(label_color(n), name) for n, name in enumerate(names, start=1) if n in there]
        count = 0 if points is None else len(points.points)
        return " ".join([*swatches, *([counted(count, "keypoint")] if count else [])]) or "This mask is empty."
