"""Curves of a run: the loss, and with truth at hand the overlap and the joint error."""

from collections.abc import Sequence

import numpy as np
import viser
from viser import uplot

from carts_viewer.state import Curves, ViewState

_TEAL, _BLUE, _ORANGE, _GRAY = "#14b8a6", "#3b82f6", "#f97316", "#8a9696"
_HEIGHT = 168
_WHOLE = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
_TICKS = uplot.Axis_Ticks(size=4, width=1)
_TITLE = '<p class="carts-curve{}"><span style="color: {}">■</span> {} {}</p>'
_QUANTITIES = (("Loss", "1", _TEAL), ("Dice", "1", _BLUE), ("Joint error", "°", _ORANGE))


class CurvesPanel:
    """Small charts, one per quantity; the pointer reads values off, markers show stages and the result."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._shown: tuple[Curves | None, bool] = (None, False)
        self._note = gui.add_html("", visible=False)
        self._charts = [_Chart(gui, *quantity) for quantity in _QUANTITIES]

    def show(self, state: ViewState) -> None:
        """Draw the curves of the state's run."""
        curves, outdated = state.run.curves, state.run_outdated
        if (curves, outdated) == self._shown:
            return
        self._shown = curves, outdated
        self._note.visible = bool(curves.loss)
        self._note.content = f'<p class="carts-caption">{note(curves, outdated)}</p>'
        values = (
            curves.loss,
            tuple(score.dice for score in curves.scores),
            tuple(score.joint_degrees for score in curves.scores),
        )
        for chart, series in zip(self._charts, values, strict=True):
            chart.show(series, curves, outdated)


def note(curves: Curves, outdated: bool) -> str:
    """What the curves show, for people."""
    if outdated:
        return "Of the last run; the pose, the image or a setting was changed since."
    if curves.comparable:
        return "○ a stage of the solver begins · ● the result. At the end losses are drawn anew, so that all compare."
    return "○ a stage of the solver begins; until the run has ended, losses only compare within a stage."


class _Chart:
    def __init__(self, gui: viser.GuiApi, name: str, unit: str, color: str) -> None:
        self._name, self._unit, self._color = name, unit, color
        self._outdated = False
        self._title = gui.add_html("", visible=False)
        empty = np.zeros(1)
        self._plot = gui.add_uplot(
            (empty, empty, empty, empty),
            self._series(),
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)},
            axes=(
                uplot.Axis(size=30, incrs=_WHOLE, ticks=_TICKS, label="Iteration", labelSize=16, stroke=_GRAY),
                uplot.Axis(size=46, space=24, ticks=_TICKS, label=f"{name} [{unit}]", labelSize=16, stroke=_GRAY),
            ),
            legend=uplot.Legend(show=True, live=True),
            cursor=uplot.Cursor(show=True, y=False, drag=uplot.Cursor_Drag(x=False, y=False)),
            height=_HEIGHT,
            padding=(6, 12, 0, 0),
            visible=False,
        )

    def show(self, values: Sequence[float | None], curves: Curves, outdated: bool) -> None:
        """Draw one value per iterate, None where there is none."""
        known = [value for value in values if value is not None]
        self._title.visible = self._plot.visible = bool(known)
        if not known:
            return
        if outdated != self._outdated:
            self._outdated = outdated
            self._plot.series = self._series()
        text = self._newest_and_result(values, curves.best)
        self._title.content = _TITLE.format(" carts-outdated" if outdated else "", self._drawn, self._name, text)
        line = np.array([np.nan if value is None else value for value in values], float)
        numbers = np.arange(len(line))
        stages = np.array(curves.stages or [0] * len(line))[: len(line)]
        begins = np.array([place == 0 or stages[place] != stages[place - 1] for place in range(len(stages))])
        marks = np.where(begins, line, np.nan)
        kept = np.where(numbers == curves.best, line, np.nan)
        self._plot.data = (numbers.astype(float), line, marks, kept)

    @property
    def _drawn(self) -> str:
        return _GRAY if self._outdated else self._color

    def _series(self) -> tuple[uplot.Series, ...]:
        color = self._drawn
        hollow = uplot.Series_Points(show=True, size=7, fill="#00000000", stroke=color, width=1.5)
        full = uplot.Series_Points(show=True, size=9, fill=color, stroke=color)
        return (
            uplot.Series(label="Iteration"),
            uplot.Series(
                label=f"{self._name} [{self._unit}]", stroke=color, width=2, points=uplot.Series_Points(show=False)
            ),
            uplot.Series(label="○", stroke=color, width=0, auto=False, points=hollow),
            uplot.Series(label="●", stroke=color, width=0, auto=False, points=full),
        )

    def _newest_and_result(self, series: Sequence[float | None], best: int) -> str:
        newest, kept = series[-1], series[best]
        text = "" if newest is None else f"<b>{newest:.3g}</b>"
        return text if kept is None else f"{text} · result <b>{kept:.3g}</b>, iteration {best}"
