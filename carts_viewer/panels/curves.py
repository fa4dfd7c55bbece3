"""Live curves of a run: the loss, and with truth at hand the overlap and the joint error."""

import numpy as np
import viser
from viser import uplot

from carts_viewer.state import Curves, ViewState

_TEAL, _BLUE, _ORANGE = "#2dd4a7", "#60a5fa", "#fb923c"
_HEIGHT = 118
_WHOLE = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
_LOSS = "Loss"
_TICKS = uplot.Axis_Ticks(size=4, width=1)
_TITLE = '<p class="carts-curve"><span style="color: {}">■</span> {} {}</p>'


class CurvesPanel:
    """Small charts, one per quantity, each with its newest value."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._shown: Curves | None = None
        self._charts = [_Chart(gui, name, color) for name, color in _QUANTITIES]

    def show(self, state: ViewState) -> None:
        """Draw the curves of the state's run."""
        curves = state.run.curves
        if curves is self._shown:
            return
        self._shown = curves
        values = (
            curves.loss,
            tuple(score.dice for score in curves.scores),
            tuple(score.joint_degrees for score in curves.scores),
        )
        for chart, series in zip(self._charts, values, strict=True):
            chart.show(series, curves.best)


_QUANTITIES = ((_LOSS, _TEAL), ("Dice", _BLUE), ("Joint error [°]", _ORANGE))


class _Chart:
    def __init__(self, gui: viser.GuiApi, name: str, color: str) -> None:
        self._name, self._color = name, color
        self._title = gui.add_html("", visible=False)
        empty = np.zeros(1)
        self._plot = gui.add_uplot(
            (empty, empty),
            (uplot.Series(label="iteration"), uplot.Series(label=name, stroke=color, width=2)),
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)},
            axes=(uplot.Axis(size=26, incrs=_WHOLE, ticks=_TICKS), uplot.Axis(size=48, space=24, ticks=_TICKS)),
            legend=uplot.Legend(show=False),
            cursor=uplot.Cursor(show=False),
            height=_HEIGHT,
            padding=(6, 12, 0, 0),
            visible=False,
        )

    def show(self, series: tuple[float | None, ...], best: int) -> None:
        known = [value for value in series if value is not None]
        self._title.visible = self._plot.visible = bool(known)
        if not known:
            return
        self._title.content = _TITLE.format(self._color, self._name, self._newest_and_best(series, best))
        values = np.array([np.nan if value is None else value for value in series], float)
        self._plot.data = (np.arange(len(values), dtype=float), values)

    def _newest_and_best(self, series: tuple[float | None, ...], best: int) -> str:
        newest, kept = series[-1], series[best]
        text = "" if newest is None else f"<b>{newest:.3g}</b>"
        if kept is None:
            return text
        if self._name == _LOSS:
            return f"{text} · kept <b>{kept:.3g}</b> of iteration {best}"
        return f"{text} · kept <b>{kept:.3g}</b>"
