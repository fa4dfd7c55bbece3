"""State of the tool palette over the image (`static/tools.js`): the selected tool and its options."""

import math
from typing import Any

from carts_core.model.parts import part_classes
from carts_core.settings import DescentSolver
from carts_viewer.picture.layers import ADDED_COLOR, IGNORED_COLOR, REMOVED_COLOR, label_color
from carts_viewer.picture.overlay import labelled_keypoints
from carts_viewer.picture.strokes import Target, Tool
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.transport.page import TabPage


class ToolPalette:
    """Sends the selected tool, its options and the numbers of painted pixels to the page when they have changed."""

    def __init__(self, page: TabPage, session: Session) -> None:
        self._page = page
        self._classes = [(one.number, one.name) for one in part_classes(session.scene.arms)]
        self._keypoints = list(labelled_keypoints(session.scene))
        self._sent: dict[str, Any] = {}

    def show(self, state: ViewState) -> None:
        """Send changes."""
        message = self._message(state)
        if message != self._sent:
            self._sent = message
            self._page.call("setBrush", message)

    def _message(self, state: ViewState) -> dict[str, Any]:
        brush, keypoints = state.brush, state.keypoints
        add, erase = (ADDED_COLOR, REMOVED_COLOR) if brush.target is Target.MASK else (IGNORED_COLOR, (255, 255, 255))
        label = brush.label if brush.target is Target.MASK else 0
        residuals = keypoints.residuals
        return {
            "label": label,
            "tool": brush.tool.lower(),
            "target": brush.target,
            "diameter": brush.diameter,
            "loupe": state.loupe,
            "colors": {"add": f"rgb{label_color(label) if label else add}", "erase": f"rgb{erase}"},
            "classes": self._classes,
            "painted": _counts(state) if brush.tool.paints else [],
            "unused": brush.target is Target.IGNORE and isinstance(state.settings, DescentSolver),
            "keypoints": self._keypoints if brush.tool is Tool.KEYPOINT else [],
            "keypoint": keypoints.chosen,
            "keypointsShown": keypoints.shown,
            "pins": len(residuals),
            "residual": math.sqrt(sum(one**2 for one in residuals) / len(residuals)) if residuals else None,
        }


def _counts(state: ViewState) -> list[tuple[str, int, str]]:
    """Numbers of painted pixels in the chosen layer, as colour, number and name."""
    correction, region, labels = state.mask_correction, state.ignore_region, state.part_labels_of(state.camera)
    if state.brush.target is Target.IGNORE:
        found = [] if region is None else [(IGNORED_COLOR, region.region(), "ignored")]
    else:
        found = [] if labels is None else [((148, 163, 184), labels.labels() > 0, "with a class")]
        if correction is not None:
            found = [
                (ADDED_COLOR, correction.added(), "added"),
                (REMOVED_COLOR, correction.removed(), "removed"),
                *found,
            ]
    return [(f"rgb{color}", int(pixels.sum()), name) for color, pixels, name in found]
