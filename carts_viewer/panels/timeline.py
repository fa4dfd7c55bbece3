"""All frames in one line: how badly each fits, what was said about it, and a click to go there."""

import viser

from carts_core.project import ProjectState
from carts_viewer.panels.review import STATE_COLORS
from carts_viewer.state import ViewState

_COLUMNS = 140
_HEIGHT = 36
_LEAST = 3.0
"""Height of a frame that is known to fit, so that it can be seen."""


class TimelinePanel:
    """A column per frame, or per some neighbouring frames, of which it shows the worst."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._chart = gui.add_html("")
        self._shown: ProjectState | None = None
        self._bars = ""

    def show(self, state: ViewState) -> None:
        """Bring the chart up to date; what is not saved yet is not in it."""
        project = state.project
        if self._shown is None or not (state.unsaved or project is self._shown):
            self._shown, self._bars = project, _bars(project)
        frames = len(project.identity.frame_ids)
        width = 100 / frames
        here = f'<rect class="carts-here" x="{state.index * width:.3f}" y="0" width="{width:.3f}" height="{_HEIGHT}"/>'
        self._chart.content = (
            f'<svg class="carts-timeline" role="img" aria-label="Timeline of all frames" data-frames="{frames}" '
            f'viewBox="0 0 100 {_HEIGHT}" preserveAspectRatio="none">{here}{self._bars}</svg>'
        )


def badness(project: ProjectState) -> dict[int, float]:
    """Of each frame with figures, 0 (fits) to 1: 1 - Dice where any frame has Dice, else the loss over the largest."""
    figures = {index: found for index in project.records if (found := project.figures(index)) is not None}
    dice = {index: 1.0 - found.dice for index, found in figures.items() if found.dice is not None}
    loss = {index: found.loss for index, found in figures.items() if found.loss is not None}
    largest = max(loss.values(), default=0.0)
    return dice or {index: value / largest if largest > 0 else 0.0 for index, value in loss.items()}


def _bars(project: ProjectState) -> str:
    frames = len(project.identity.frame_ids)
    columns = min(frames, _COLUMNS)
    bad = badness(project)
    worst: dict[int, int] = {}
    for index in (index for index in project.records if index >= 0):
        column = index * columns // frames
        if bad.get(index, -1.0) > bad.get(worst.get(column, -1), -1.0) or column not in worst:
            worst[column] = index
    width = 100 / columns
    bars = []
    for column, index in worst.items():
        height = max(_LEAST, min(bad.get(index, 0.0), 1.0) * _HEIGHT)
        color = STATE_COLORS[project.review(index).state]
        bars.append(
            f'<rect x="{column * width:.3f}" y="{_HEIGHT - height:.2f}" width="{0.85 * width:.3f}" '
            f'height="{height:.2f}" fill="{color}"/>'
        )
    return "".join(bars)
