"""The optimizer's settings and free parameters, built from the dataclasses that declare them."""

import ast
import inspect
import math
import re
import textwrap
from dataclasses import fields
from functools import cache
from typing import Any, get_args, get_type_hints

from carts_core.optimization import OptimizerSettings
from carts_viewer import intents as ask
from carts_viewer.page import Page
from carts_viewer.panels.inputs import Emit, escaped, humanized, on_input, write
from carts_viewer.session import Session
from carts_viewer.state import ViewState

_ELSEWHERE = ("loss",)
"""Fields that have a widget of their own in another panel."""
_GROUPS = {"base_frames": "Base frames", "extrinsics": "Camera pose", "intrinsics": "Camera intrinsics"}


class SettingsPanel:
    """One widget per field of `OptimizerSettings`; the field's own docstring is its hint."""

    def __init__(self, page: Page, state: ViewState, emit: Emit) -> None:
        gui = page.server.gui
        hints = field_docstrings(OptimizerSettings)
        self._widgets: dict[str, Any] = {}
        with gui.add_folder("Solver settings", expand_by_default=False):
            self._error = gui.add_html("", visible=False)
            for field in fields(OptimizerSettings):
                if field.name not in _ELSEWHERE:
                    self._widgets[field.name] = _widget(gui, field.name, getattr(state.settings, field.name), hints)
                    on_input(self._widgets[field.name], _setter(field.name, getattr(state.settings, field.name)), emit)

    def show(self, state: ViewState) -> None:
        """Bring the widgets up to date."""
        self._error.visible = state.settings_error is not None
        self._error.content = f'<p class="carts-error">{escaped(state.settings_error or "")}</p>'
        if state.settings_error is None:
            for name, widget in self._widgets.items():
                value = getattr(state.settings, name)
                write(widget, _listed(value) if isinstance(value, tuple) else value)


class FreePanel:
    """Which joints and which calibration the optimizer may move."""

    def __init__(self, page: Page, session: Session, state: ViewState, emit: Emit) -> None:
        gui = page.server.gui
        self._joints: dict[tuple[str, str], Any] = {}
        self._groups: dict[str, Any] = {}
        with gui.add_folder("Free parameters", expand_by_default=False):
            for arm in session.scene.arms:
                gui.add_html(f'<p class="carts-caption"><b>{escaped(arm.name)}</b> joints</p>')
                for joint in arm.robot.joint_names:
                    box = gui.add_checkbox(humanized(joint), is_free(state, arm.name, joint))
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


@cache
def field_docstrings(kind: type) -> dict[str, str]:
    """The string below each field of a dataclass, which Python itself throws away."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
            found[field.target.id] = " ".join(str(ast.literal_eval(text.value)).split())
    return found


def _widget(gui: Any, name: str, value: Any, hints: dict[str, str]) -> Any:
    choices = get_args(get_type_hints(OptimizerSettings)[name])
    hint = hints.get(name)
    unit = re.search(r"\[([^\]]*)\]", hint or "")
    # "[px of the working image]" is for the hint; the label has room for "px". [1] is no unit to show.
    short = unit.group(1).split()[0] if unit else "1"
    # `prior_deg` in degrees needs its unit once only.
    words = humanized(name.removesuffix(f"_{short}"))
    label = words if short == "1" else f"{words} [{short.replace('^2', '²')}]"
    if isinstance(value, tuple):
        return gui.add_text(label, _listed(value), hint=hint)
    if choices:
        return gui.add_dropdown(label, list(choices), initial_value=value, hint=hint)
    if isinstance(value, bool):
        return gui.add_checkbox(label, value, hint=hint)
    step = 1 if isinstance(value, int) else 10.0 ** (math.floor(math.log10(value)) - 1 if value > 0 else -5)
    return gui.add_number(label, value, step=step, hint=hint)


def _setter(name: str, example: Any):
    if isinstance(example, tuple):
        return lambda text: ask.SetSetting(name, _numbers(text))
    return lambda value: ask.SetSetting(name, value)


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:g}" for value in values)


def _numbers(text: str) -> tuple[float, ...]:
    """Numbers from a text field; none at all, which no setting takes, when it is not a list of them."""
    try:
        return tuple(float(part) for part in text.replace(",", " ").split())
    except ValueError:
        return ()


def _free_joint(arm: str, joint: str):
    return lambda on: ask.SetFreeJoint(arm, joint, bool(on))


def _free_group(name: str):
    return lambda on: ask.SetFreeGroup(name, bool(on))
