"""The optimizer's settings and free parameters, built from the dataclasses that declare them."""

import math
import re
from dataclasses import fields
from enum import StrEnum
from typing import Any, get_args, get_type_hints

import viser

from carts_core.settings import DescentSolver, SurfaceSolver
from carts_core.settings.serialization import field_docstrings
from carts_viewer import intents
from carts_viewer.panels.inputs import Emit, escaped, humanized, on_click, on_input, write
from carts_viewer.presets import PRESETS
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.transport.tab_page import TabPage

_GROUPS = {"base_frames": "Base frames", "extrinsics": "Camera pose", "intrinsics": "Camera intrinsics"}


class SettingsPanel:
    """A preset, and a window with one widget per number of the chosen solver's settings, explained by its docstring.

    Stages are not edited here: a settings file holds them (`carts evaluate --settings`).
    """

    def __init__(self, page: TabPage, state: ViewState, emit: Emit) -> None:
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
            reset = gui.add_button("Reset all to the preset", icon=viser.Icon.HISTORY, color="gray")
            close = gui.add_button("Close", icon=viser.Icon.X, color="gray")
            page.row(reset, close, weights=(2, 1))
            self._folder = gui.add_folder("Of the chosen solver")
            with self._folder:
                for example in (SurfaceSolver(), DescentSolver()):
                    self._add(example, type(state.settings), emit)
        self._window.float(x=40, y=60, width=400, height=620)
        on_input(self._preset, intents.ResetSettings, emit)
        on_click(reset, lambda _: intents.ResetSettings(self._preset.value), emit)

        @advanced.on_click
        async def _(_: viser.GuiEvent) -> None:
            self._window.visible = not self._window.visible

        @close.on_click
        async def _(_: viser.GuiEvent) -> None:
            self._window.visible = False

    def show(self, state: ViewState) -> None:
        """Bring the widgets up to date."""
        self._show_error(state)
        for kind, widgets in self._widgets.items():
            chosen = isinstance(state.settings, kind)
            for name, widget in widgets.items():
                widget.visible = chosen
                if chosen and state.settings_error is None:
                    write(widget, getattr(state.settings, name))

    def _add(self, example: Any, shown: type, emit: Emit) -> None:
        kind = type(example)
        self._widgets[kind] = {
            field.name: _widget(self._gui, kind, field.name, getattr(example, field.name))
            for field in fields(kind)
            if field.name != "stages"
        }
        for name, widget in self._widgets[kind].items():
            widget.visible = kind is shown
            on_input(widget, _setter(name), emit)

    def _show_error(self, state: ViewState) -> None:
        """Say what is wrong right below the field that it is about."""
        if self._error is not None:
            self._error.remove()
            self._error = None
        widget = self._widgets[type(state.settings)].get(state.settings_field or "")
        if state.settings_error is not None:
            text = f'<p class="carts-error" role="alert">{escaped(state.settings_error)}</p>'
            with self._folder:
                self._error = self._gui.add_html(text, order=None if widget is None else widget.order + 0.5)


class FreePanel:
    """Which joints and which calibration the optimizer may move."""

    def __init__(self, page: TabPage, session: Session, state: ViewState, emit: Emit) -> None:
        gui = page.gui
        self._joints: dict[tuple[str, str], Any] = {}
        self._groups: dict[str, Any] = {}
        with gui.add_folder("Free parameters", expand_by_default=False):
            for arm in session.scene.arms:
                gui.add_html(f'<p class="carts-caption"><b>{escaped(arm.name)}</b> joints</p>')
                for joint in arm.robot.joint_names:
                    hint = f"Let the optimizer move this joint of {arm.name}"
                    box = gui.add_checkbox(humanized(joint), is_free(state, arm.name, joint), hint=hint)
                    self._joints[arm.name, joint] = box
                    on_input(box, _free_joint(arm.name, joint), emit)
                page.columns([self._joints[arm.name, joint] for joint in arm.robot.joint_names])
            gui.add_html('<p class="carts-caption"><b>Calibration</b></p>')
            for name, label in _GROUPS.items():
                box = gui.add_checkbox(label, getattr(state.free, name))
                self._groups[name] = box
                on_input(box, _free_group(name), emit)
            page.columns(list(self._groups.values()))

    def show(self, state: ViewState) -> None:
        """Bring the widgets up to date."""
        for (arm, joint), box in self._joints.items():
            write(box, is_free(state, arm, joint))
        for name, box in self._groups.items():
            write(box, getattr(state.free, name))


def is_free(state: ViewState, arm: str, joint: str) -> bool:
    """Whether the optimizer may move this joint."""
    locked = state.free.locked_joints
    chosen = not state.free.arms or arm in state.free.arms
    return state.free.joints and chosen and joint not in locked and f"{arm}/{joint}" not in locked


def _widget(gui: Any, kind: type, name: str, value: Any) -> Any:
    hint = field_docstrings(kind).get(name)
    unit = re.search(r"\[([^\]]*)\]", hint or "")
    # "[px of the working image]" is for the hint; the label has room for "px". [1] is no unit to show.
    short = unit.group(1).split()[0] if unit else "1"
    # `prior_deg` in degrees needs its unit once only.
    words = humanized(name.removesuffix(f"_{short}"))
    label = words if short == "1" else f"{words} [{short.replace('^2', '²')}]"
    if isinstance(value, str):
        choices = list(type(value)) if isinstance(value, StrEnum) else get_args(get_type_hints(kind)[name])
        return gui.add_dropdown(label, [str(choice) for choice in choices], initial_value=str(value), hint=hint)
    if isinstance(value, bool):
        return gui.add_checkbox(label, value, hint=hint)
    step = 1 if isinstance(value, int) else 10.0 ** (math.floor(math.log10(value)) - 1 if value > 0 else -5)
    return gui.add_number(label, value, step=step, hint=hint)


def _setter(name: str):
    return lambda value: intents.SetSetting(name, value)


def _free_joint(arm: str, joint: str):
    return lambda on: intents.SetFreeJoint(arm, joint, bool(on))


def _free_group(name: str):
    return lambda on: intents.SetFreeGroup(name, bool(on))
