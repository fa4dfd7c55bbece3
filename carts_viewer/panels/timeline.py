"""All frames in one line: how badly each fits, what was said about it, who made it, and a click to go there."""

import viser

from carts_core.project import ProjectState, Source
from carts_viewer.finding import BY_HAND, SOLVED
from carts_viewer.panels.review import STATE_COLORS
from carts_viewer.state import ViewState

_COLUMNS = 140
_HEIGHT = 36
_STRIP = 4
"""Height of the line below the bars."""
_FULL = 0.2
"""Badness of a bar of full height, unless a frame is worse still."""
_LEAST = 3.0
"""Height of a frame that is known to fit, so that it can be seen."""
SOURCE_COLORS = {Source.HAND: "#facc15", Source.OPTIMIZER: "#60a5fa", Source.PROPAGATED: "#e879f9"}
"""Of the line below the bars: who made a frame's joint positions."""
_EXPLAINED = "All frames: the higher a bar, the worse the fit. Click to go there."
_LEGEND = {BY_HAND: Source.HAND, "optimized": Source.OPTIMIZER, SOLVED: Source.PROPAGATED}


class TimelinePanel:
    """A column per frame, or per some neighbouring frames, of which it shows the worst; below, who made them."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._chart = gui.add_html("")
        self._shown: ProjectState | None = None
        self._bars = ""
        keys = "".join(
            f'<span class="carts-key"><span class="carts-swatch" style="background: {SOURCE_COLORS[source]}"></span>'
            f"{name}</span>"
            for name, source in _LEGEND.items()
        )
        gui.add_html(f'<p class="carts-caption carts-small">{keys}<span class="carts-key">▲ kept</span></p>')

    def show(self, state: ViewState) -> None:
        """Bring the chart up to date; what is not saved yet is not in it."""
        project = state.project
        if self._shown is None or not (state.unsaved or project is self._shown):
            self._shown, self._bars = project, _bars(project) + _strip(project) + _kept(project)
        frames = len(project.identity.frame_ids)
        here = _rectangle("carts-here", state.index / frames, 1 / frames)
        self._chart.content = (
            f'<svg class="carts-timeline" role="img" aria-label="Timeline of all frames" data-frames="{frames}" '
            f'viewBox="0 0 100 {_HEIGHT + _STRIP}" preserveAspectRatio="none">'
            f"<title>{_EXPLAINED}</title>{_solving(state)}{here}{self._bars}</svg>"
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
    full = max([_FULL, *bad.values()])
    worst: dict[int, int] = {}
    for index in (index for index in project.records if index >= 0):
        column = index * columns // frames
        if bad.get(index, -1.0) > bad.get(worst.get(column, -1), -1.0) or column not in worst:
            worst[column] = index
    width = 100 / columns
    bars = []
    for column, index in worst.items():
        height = max(_LEAST, bad.get(index, 0.0) / full * _HEIGHT)
        color = STATE_COLORS[project.review(index).state]
        bars.append(
            f'<rect x="{column * width:.3f}" y="{_HEIGHT - height:.2f}" width="{0.85 * width:.3f}" '
            f'height="{height:.2f}" fill="{color}"/>'
        )
    return "".join(bars)


def _strip(project: ProjectState) -> str:
    """Who made the frames: of neighbours that share a column, the most informative one."""
    frames = len(project.identity.frame_ids)
    columns = min(frames, _COLUMNS)
    ranks = list(SOURCE_COLORS)
    made: dict[int, Source] = {}
    for index, record in project.records.items():
        column = index * columns // frames
        for source in record.sources:
            if source in ranks and (column not in made or ranks.index(source) < ranks.index(made[column])):
                made[column] = source
    width = 100 / columns
    return "".join(
        f'<rect class="carts-source" data-source="{source}" x="{column * width:.3f}" y="{_HEIGHT + 0.5}" '
        f'width="{width:.3f}" height="{_STRIP - 0.5}" fill="{SOURCE_COLORS[source]}"/>'
        for column, source in made.items()
    )


def _kept(project: ProjectState) -> str:
    """A tick above the line for every frame, or some neighbouring ones, that propagation must not change."""
    frames = len(project.identity.frame_ids)
    columns = min(frames, _COLUMNS)
    return "".join(
        f'<path class="carts-kept" d="M{100 * (column + 0.5) / columns - 1:.3f} {_HEIGHT} l1 -5 l1 5 z"/>'
        for column in sorted({index * columns // frames for index in project.kept_frames})
    )


def _solving(state: ViewState) -> str:
    """The frames that are being solved, and how many of them are done."""
    if not state.solving or state.solve is None:
        return ""
    frames = len(state.project.identity.frame_ids)
    first, count, done = state.solve.frames[0] / frames, len(state.solve.frames) / frames, state.solve.done / frames
    start = first if state.direction == "forward" else first + count - done
    return _rectangle("carts-solving", first, count) + _rectangle("carts-solved", start, done)


def _rectangle(name: str, start: float, share: float) -> str:
    return f'<rect class="{name}" x="{100 * start:.3f}" y="0" width="{100 * share:.3f}" height="{_HEIGHT + _STRIP}"/>'
