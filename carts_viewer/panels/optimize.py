"""Panels of the optimizer: controls of a run, solver settings, free parameters, and curves."""

import math
import re
from collections.abc import Sequence
from dataclasses import fields
from enum import StrEnum
from typing import Any, get_args, get_type_hints

import numpy as np
import viser
from viser import uplot

from carts_core.project import ReviewState
from carts_core.settings import DescentSolver, SolverName, SurfaceSolver
from carts_core.settings.serialization import field_docstrings
from carts_viewer.actions import intents
from carts_viewer.panels.inputs import PanelPage, humanized, write
from carts_viewer.panels.sequence import CalibrationHint
from carts_viewer.session import Session
from carts_viewer.state import PRESETS, Curves, Phase, ViewState
from carts_viewer.transport.document import escaped

SOLVER_LABELS = {
    SolverName.SURFACE: "Surface maps (default)",
    SolverName.OCCLUDED: "Surface maps, with occluders",
    SolverName.ACS: "ACS, normalized by attended area",
    SolverName.PAPER: "ACS as in the paper",
    SolverName.ACS_REFERENCE: "ACS as in the paper's code",
    SolverName.L1: "L1 on predictions",
    SolverName.NONE: "None (compare only)",
}
"""Labels of the solvers."""
OBSERVED = {"Network predictions": "network", "Masks": "masks", "Masks and network": "both"}
"""Labels of the targets of a run."""
MASKS = {"Recording": "recording", "Imported": "imported", "Painted": "painted"}
"""Labels of the masks that a run fits."""
_BEFORE_RUN = {
    ReviewState.ACCEPTED: "Accepted. A run that moves the arms clears the review.",
    ReviewState.REJECTED: "Rejected",
    ReviewState.OPTIMIZED: "Optimized",
}
"""Status text before a run, by review state."""


class OptimizePanel:
    """Buttons that control a run, and its status as text."""

    def __init__(self, page: PanelPage, session: Session) -> None:
        gui = page.gui
        self._run = page.button("Run", intents.Run(), icon=viser.Icon.PLAYER_PLAY, color="teal")
        self._pause = page.button("Pause", intents.Pause(), icon=viser.Icon.PLAYER_PAUSE, disabled=True)
        self._step = page.button("Step", intents.Step(), icon=viser.Icon.PLAYER_SKIP_FORWARD)
        self._reset = page.button("Reset", intents.Reset(), icon=viser.Icon.PLAYER_TRACK_PREV)
        icons = (self._pause, self._step, self._reset)
        page.row(self._run, *icons, weights=(3, 1, 1, 1), icons=icons)
        self._page = page
        self._all = page.button(
            "Solve all frames",
            lambda _: self._solve(),
            icon=viser.Icon.ARROWS_HORIZONTAL,
            hint="Fit all frames, or those in the timeline's range, together; kept frames do not change",
        )
        self._status = gui.add_html("")
        self._calibration = CalibrationHint(page, session)
        self._unfamiliar = gui.add_html("", visible=False)
        self._adapt = page.button(
            "Adapt the network to this recording", intents.Adapt(), icon=viser.Icon.SCHOOL, visible=False, color=None
        )

    def show(self, state: ViewState) -> None:
        """Update the widgets."""
        running = state.run.phase is Phase.RUNNING
        self._run.label = "Continue" if state.run.phase is Phase.PAUSED else "Run"
        self._run.disabled = self._step.disabled = running or state.busy is not None
        self._all.label = "Solve all frames" if state.range is None else "Solve the range"
        self._all.disabled = state.solving or state.busy is not None
        self._pause.disabled = not running
        self._reset.disabled = not state.run.curves.loss
        self._unfamiliar.content = "".join(
            f'<p class="carts-notice" role="status">{escaped(warning)}</p>' for warning in state.unfamiliar
        )
        self._unfamiliar.visible = self._adapt.visible = bool(state.unfamiliar)
        self._status.content = f'<p class="carts-status">{status_line(state)}</p>'
        self._calibration.show(state.run.base_frame_gain, state)

    def _solve(self) -> intents.Solve:
        """Solve all frames, and show the progress."""
        self._page.call("chooseTabs", ["Review"])
        return intents.Solve(whole=True)


class ObjectivePanel:
    """Choice of the solver, and of what it fits."""

    def __init__(self, page: PanelPage, session: Session, state: ViewState) -> None:
        gui = page.gui
        self._solvers = {label: name for name, label in SOLVER_LABELS.items()}
        self._solver = gui.add_dropdown("Solver", list(self._solvers), initial_value=SOLVER_LABELS[state.solver])
        self._observed = gui.add_dropdown("Fit to", list(OBSERVED))
        self._masks = gui.add_dropdown(
            "Mask source",
            list(MASKS),
            visible=False,
            hint="Imported: see Review, Import. Painted: rendered masks corrected with the brush.",
        )
        cameras = [camera.name for camera in session.scene.cameras]
        self._cameras = gui.add_dropdown("Cameras", ["All cameras", "Shown camera"], visible=len(cameras) > 1)
        page.on_input(self._solver, lambda label: intents.SetSetting("solver", self._solvers[label]))
        page.on_input(self._observed, lambda what: intents.SetObserved(OBSERVED[what], MASKS[self._masks.value]))
        page.on_input(self._masks, lambda masks: intents.SetObserved(OBSERVED[self._observed.value], MASKS[masks]))
        page.on_input(self._cameras, lambda label: intents.SetCameras(label == "All cameras"))

    def show(self, state: ViewState) -> None:
        """Update the widgets."""
        write(self._solver, SOLVER_LABELS[state.solver])
        write(self._observed, next(label for label, what in OBSERVED.items() if what == state.observed.what))
        write(self._masks, next(label for label, masks in MASKS.items() if masks == state.observed.masks))
        self._masks.visible = state.observed.what != "network"
        write(self._cameras, "All cameras" if state.every_camera else "Shown camera")


def status_line(state: ViewState) -> str:
    """Iteration, time per iteration and stop reason, as HTML."""
    curves, phase = state.run.curves, state.run.phase
    if state.busy is not None:
        return f'<span class="carts-spinner"></span>{escaped(state.busy)} …'
    parts = []
    if curves.loss:
        mean = f"{1e3 * sum(curves.seconds) / len(curves.seconds):.0f} ms per iteration"
        parts.append(f'<span title="{mean}">{len(curves.loss) - 1} of {state.settings.iterations} iterations</span>')
    if phase is Phase.RUNNING:
        parts.append("running")
    elif phase is Phase.PAUSED:
        parts.append("paused")
    elif state.run.reason:
        parts.append(escaped(state.run.reason))
    if state.run_outdated and phase is Phase.IDLE:
        parts.append("changed since the run")
    return " · ".join(parts) or _BEFORE_RUN.get(state.review.state, "")


_GROUPS = {"base_frames": "Base frames", "extrinsics": "Camera pose", "intrinsics": "Camera intrinsics"}


class SettingsPanel:
    """Preset, and a window with one widget per field of the solver's settings; docstrings of fields are the hints.

    Stages can be edited only in a settings file (`carts evaluate --settings`).
    """

    def __init__(self, page: PanelPage, state: ViewState) -> None:
        gui = page.gui
        self._gui = gui
        self._widgets: dict[type, dict[str, Any]] = {}
        self._error: viser.GuiHtmlHandle | None = None
        self._preset = gui.add_dropdown(
            "Preset", list(PRESETS), hint=" ".join(f"{name}: {preset.meaning}" for name, preset in PRESETS.items())
        )
        advanced = gui.add_button("Advanced settings", icon=viser.Icon.ADJUSTMENTS, color="gray")
        self._window = gui.add_panel(visible=False)
        with self._window.add_tab("Solver settings"):
            reset = page.button(
                "Reset to preset", lambda _: intents.ResetSettings(self._preset.value), icon=viser.Icon.HISTORY
            )
            close = gui.add_button("Close", icon=viser.Icon.X, color="gray")
            page.row(reset, close, weights=(2, 1))
            self._folder = gui.add_folder("Settings of the chosen solver")
            with self._folder:
                for example in (SurfaceSolver(), DescentSolver()):
                    self._add(page, example, type(state.settings))
        self._window.float(x=40, y=60, width=400, height=620)
        page.on_input(self._preset, intents.ResetSettings)

        @advanced.on_click
        async def _(_: viser.GuiEvent) -> None:
            page.open_window(self._window)

        @close.on_click
        async def _(_: viser.GuiEvent) -> None:
            self._window.visible = False

    def show(self, state: ViewState) -> None:
        """Update the widgets."""
        self._show_error(state)
        for kind, widgets in self._widgets.items():
            chosen = isinstance(state.settings, kind)
            for name, widget in widgets.items():
                widget.visible = chosen
                if chosen and state.settings_error is None:
                    write(widget, getattr(state.settings, name))

    def _add(self, page: PanelPage, example: Any, shown: type) -> None:
        kind = type(example)
        self._widgets[kind] = {
            field.name: _widget(self._gui, kind, field.name, getattr(example, field.name))
            for field in fields(kind)
            if field.name != "stages"
        }
        for name, widget in self._widgets[kind].items():
            widget.visible = kind is shown
            page.on_input(widget, lambda value, name=name: intents.SetSetting(name, value))

    def _show_error(self, state: ViewState) -> None:
        """Show the error below its field."""
        if self._error is not None:
            self._error.remove()
            self._error = None
        widget = self._widgets[type(state.settings)].get(state.settings_field or "")
        if state.settings_error is not None:
            text = f'<p class="carts-error" role="alert">{escaped(state.settings_error)}</p>'
            with self._folder:
                self._error = self._gui.add_html(text, order=None if widget is None else widget.order + 0.5)


class FreePanel:
    """Choice of the joints and the calibration parameters that the optimizer may change."""

    def __init__(self, page: PanelPage, session: Session, state: ViewState) -> None:
        gui = page.gui
        self._joints: dict[tuple[str, str], Any] = {}
        self._groups: dict[str, Any] = {}
        with gui.add_folder("Free parameters", expand_by_default=False):
            for arm in session.scene.arms:
                gui.add_html(f'<p class="carts-caption"><b>{escaped(arm.name)}</b> joints</p>')
                for joint in arm.robot.joint_names:
                    hint = f"Allow the optimizer to move this joint of {arm.name}"
                    box = gui.add_checkbox(humanized(joint), state.free.frees(arm.name, joint), hint=hint)
                    self._joints[arm.name, joint] = box
                    page.on_input(box, lambda on, arm=arm.name, joint=joint: intents.SetFreeJoint(arm, joint, bool(on)))
                page.columns([self._joints[arm.name, joint] for joint in arm.robot.joint_names])
            gui.add_html('<p class="carts-caption"><b>Calibration</b></p>')
            for name, label in _GROUPS.items():
                box = gui.add_checkbox(label, getattr(state.free, name))
                self._groups[name] = box
                page.on_input(box, lambda on, name=name: intents.SetFreeGroup(name, bool(on)))
            page.columns(list(self._groups.values()))

    def show(self, state: ViewState) -> None:
        """Update the widgets."""
        for (arm, joint), box in self._joints.items():
            write(box, state.free.frees(arm, joint))
        for name, box in self._groups.items():
            write(box, getattr(state.free, name))


def _widget(gui: Any, kind: type, name: str, value: Any) -> Any:
    hint = field_docstrings(kind).get(name)
    unit = re.search(r"\[([^\]]*)\]", hint or "")
    # The label has room for the first word of a unit, such as "px" of "[px of the working image]"; [1] is not shown.
    short = unit.group(1).split()[0] if unit else "1"
    # The name `prior_deg` already contains its unit.
    words = humanized(name.removesuffix(f"_{short}"))
    label = words if short == "1" else f"{words} [{short.replace('^2', '²')}]"
    if isinstance(value, str):
        choices = list(type(value)) if isinstance(value, StrEnum) else get_args(get_type_hints(kind)[name])
        return gui.add_dropdown(label, [str(choice) for choice in choices], initial_value=str(value), hint=hint)
    if isinstance(value, bool):
        return gui.add_checkbox(label, value, hint=hint)
    step = 1 if isinstance(value, int) else 10.0 ** (math.floor(math.log10(value)) - 1 if value > 0 else -5)
    return gui.add_number(label, value, step=step, hint=hint)


_COLOR, _GRAY = "#0d9488", "#8a9696"
_HEIGHT = 160
_WHOLE = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
_TICKS = uplot.Axis_Ticks(size=4, width=1)
_GRID = uplot.Axis_Grid(stroke="#8a969633", width=1)
_FONT = "11px system-ui, sans-serif"
_QUANTITIES = ("Loss", "Dice", "Joint error [°]")


class CurvesPanel:
    """Small charts, one per quantity; values appear at the pointer, and markers show stages and the result."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._shown: tuple[Curves | None, bool] = (None, False)
        self._charts = [_Chart(gui, quantity) for quantity in _QUANTITIES]

    def show(self, state: ViewState) -> None:
        """Draw the curves of the state's run."""
        curves, outdated = state.run.curves, state.run_outdated
        if (curves, outdated) == self._shown:
            return
        self._shown = curves, outdated
        values = (
            curves.loss,
            tuple(score.dice for score in curves.scores),
            tuple(score.joint_degrees for score in curves.scores),
        )
        for chart, series in zip(self._charts, values, strict=True):
            chart.show(series, curves, outdated)


def note(curves: Curves, outdated: bool) -> str:
    """Hint of the curves."""
    if outdated:
        return "Outdated: the pose, the image or a setting has changed since the run."
    if curves.comparable:
        return "○ start of a stage, ● result. After a run, all losses are recomputed, so they are comparable."
    return "○ start of a stage. During a run, losses are comparable only within a stage."


class _Chart:
    def __init__(self, gui: viser.GuiApi, name: str) -> None:
        self._name = name
        self._outdated = False
        self._title = gui.add_html("", visible=False)
        empty = np.zeros(1)
        self._plot = gui.add_uplot(
            (empty, empty, empty, empty),
            self._series(),
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)},
            axes=(
                uplot.Axis(
                    size=30,
                    incrs=_WHOLE,
                    ticks=_TICKS,
                    grid=_GRID,
                    label="Iteration",
                    labelSize=14,
                    labelFont=_FONT,
                    stroke=_GRAY,
                ),
                uplot.Axis(size=46, space=24, ticks=_TICKS, grid=_GRID, stroke=_GRAY),
            ),
            legend=uplot.Legend(show=True, live=True),
            cursor=uplot.Cursor(show=True, y=False, drag=uplot.Cursor_Drag(x=False, y=False)),
            height=_HEIGHT,
            padding=(6, 12, 0, 0),
            visible=False,
        )

    def show(self, values: Sequence[float | None], curves: Curves, outdated: bool) -> None:
        """Draw one value per iterate; None if unknown."""
        known = [value for value in values if value is not None]
        self._title.visible = self._plot.visible = bool(known)
        if not known:
            return
        if outdated != self._outdated:
            self._outdated = outdated
            self._plot.series = self._series()
        text = self._newest_and_result(values, curves.best)
        style = "carts-curve carts-outdated" if outdated else "carts-curve"
        mark = " · outdated" if outdated else ""
        self._title.content = (
            f'<p class="{style}" title="{note(curves, outdated)}"><b>{self._name}</b> {text}{mark}</p>'
        )
        line = np.array([np.nan if value is None else value for value in values], float)
        numbers = np.arange(len(line))
        stages = np.array(curves.stages or [0] * len(line))[: len(line)]
        begins = np.array([place == 0 or stages[place] != stages[place - 1] for place in range(len(stages))])
        marks = np.where(begins, line, np.nan)
        kept = np.where(numbers == curves.best, line, np.nan)
        self._plot.data = (numbers.astype(float), line, marks, kept)

    @property
    def _drawn(self) -> str:
        return _GRAY if self._outdated else _COLOR

    def _series(self) -> tuple[uplot.Series, ...]:
        color = self._drawn
        hollow = uplot.Series_Points(show=True, size=7, fill="#00000000", stroke=color, width=1.5)
        full = uplot.Series_Points(show=True, size=9, fill=color, stroke=color)
        return (
            uplot.Series(label="Iteration"),
            uplot.Series(label=self._name, stroke=color, width=2, points=uplot.Series_Points(show=False)),
            uplot.Series(label="○", stroke=color, width=0, auto=False, points=hollow),
            uplot.Series(label="●", stroke=color, width=0, auto=False, points=full),
        )

    def _newest_and_result(self, series: Sequence[float | None], best: int) -> str:
        newest, kept = series[-1], series[best]
        if kept is None:
            return "" if newest is None else f"{newest:.3g}"
        now = "" if newest is None or newest == kept else f"{newest:.3g} · "
        return f"{now}result {kept:.3g}, iteration {best}"
