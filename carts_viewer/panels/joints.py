"""Joint positions by hand: a slider with a number field per joint, in degrees and millimetres, and what undoes them."""

import math
from collections.abc import Callable

import numpy as np
import viser

from carts_viewer import intents
from carts_viewer.handlers.posing import LARGEST_PERTURBATION
from carts_viewer.joint_range import JointRange
from carts_viewer.panels.inputs import Emit, Waits, humanized, on_click, on_input, valid, write
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.transport.tab_page import TabPage

_WINDOWS = {"± 5": 5.0, "± 20": 20.0, "Full range": math.inf}
_STEP = 0.05
"""Of the sliders [deg] and [mm]."""


class JointsPanel:
    """One tab per arm with its joints, and the buttons that concern all arms."""

    def __init__(self, page: TabPage, session: Session, state: ViewState, emit: Emit, waits: Waits) -> None:
        """
        Args:
            page: Where to build the widgets, in the current container.
            session: The open sequence.
            state: The state to begin with.
            emit: Takes the intents.
            waits: Whether a slider is ahead of the state.
        """
        gui = page.gui
        self._session = session
        self._waits = waits
        self._page = page
        self._window = 5.0
        self._sliders: dict[tuple[str, int], tuple[JointRange, viser.GuiSliderHandle[float]]] = {}
        self._centred_on: object = None
        tabs = gui.add_tab_group()
        for arm in session.scene.arms:
            with tabs.add_tab(arm.name, viser.Icon.GRAIN):
                self._add_arm(page, arm.name, state, emit)
        window = gui.add_dropdown(
            "Slider range",
            list(_WINDOWS),
            initial_value="± 5",
            hint="How far the sliders reach from the measured values [° or mm]",
        )
        perturb = gui.add_button("Perturb all joints", color="gray")
        self._degrees = gui.add_number("By [°, mm]", 2.0, min=0.0, max=LARGEST_PERTURBATION, step=0.5)
        self._seed = gui.add_number("Seed", 0, min=0, max=2**31 - 1, step=1)
        page.columns([self._degrees, self._seed], narrow_labels=True)
        back = "All back to measured" if len(session.scene.arms) > 1 else "Back to measured"
        measured = gui.add_button(back, icon=viser.Icon.HISTORY, color="gray")
        before = gui.add_button("Copy previous", color="gray", hint="Correct by as much as the previous frame is")
        after = gui.add_button("Copy next", color="gray", hint="Correct by as much as the next frame is")
        page.row(before, after)
        self._names = {
            f"{limits.arm} {humanized(limits.joint)}": (limits.arm, number)
            for arm in session.scene.arms
            for number, limits in enumerate(limits for limits in session.ranges if limits.arm == arm.name)
        }
        self._nudged = gui.add_dropdown("Nudge (I, O)", list(self._names), hint="The joint that the keys I and O move")
        on_click(perturb, lambda _: self.perturb(), emit)
        on_click(measured, lambda _: intents.BackToMeasured(), emit)
        on_click(before, lambda _: intents.CopyCorrection(-1), emit)
        on_click(after, lambda _: intents.CopyCorrection(1), emit)
        on_input(self._nudged, lambda name: intents.ChooseJoint(self._names[name]), emit)

        @window.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client_id is not None and window.value in _WINDOWS:
                self._window = _WINDOWS[window.value]
                self._centred_on = None
                emit(intents.Refresh())

    def perturb(self) -> intents.Perturb:
        """The perturbation that the fields describe."""
        seed = int(self._seed.value) if valid(self._seed, self._seed.value) else 0
        return intents.Perturb(float(self._degrees.value), max(0, seed))

    def slider(self, arm: str, joint: int) -> viser.GuiSliderHandle[float]:
        """The slider of one joint."""
        return self._sliders[arm, joint][1]

    def show(self, state: ViewState) -> None:
        """Bring the widgets up to date."""
        joints = self._session.joints(state.pose.scene)
        with self._page.atomic():
            if self._centred_on != state.frame.index:
                self._centred_on = state.frame.index
                self._centre(state, joints)
            for (arm, joint), (limits, slider) in self._sliders.items():
                shown = to_shown(limits, float(joints[arm][joint]))
                # A slider that a person is moving is ahead of the state; writing would pull it back under their hand.
                near = math.isfinite(slider.value) and abs(slider.value - shown) < _STEP / 2
                if not near and not self._waits((intents.SetJoint, arm, joint)):
                    self._widen(slider, shown)
                    slider.value = round(shown, 2)
        if state.joint is not None:
            write(self._nudged, next(name for name, joint in self._names.items() if joint == state.joint))

    def _add_arm(self, page: TabPage, arm: str, state: ViewState, emit: Emit) -> None:
        gui = page.gui
        joints = self._session.joints(state.pose.scene)[arm]
        for joint, limits in enumerate(limits for limits in self._session.ranges if limits.arm == arm):
            low, high = to_shown(limits, limits.lower), to_shown(limits, limits.upper)
            value = to_shown(limits, float(joints[joint]))
            unit = "°" if limits.revolute else "mm"
            label = f"{humanized(limits.joint)} [{unit}]"
            slider = gui.add_slider(
                label, math.floor(min(low, value)), math.ceil(max(high, value)), _STEP, round(value, 2)
            )
            self._sliders[arm, joint] = (limits, slider)
            on_input(slider, self._intent(arm, joint, limits), emit)
        if len(self._session.scene.arms) > 1:
            reset = gui.add_button(f"{arm} back to measured", icon=viser.Icon.HISTORY, color="gray")
            on_click(reset, lambda _: intents.BackToMeasured(arm), emit)

    def _intent(self, arm: str, joint: int, limits: JointRange) -> Callable[[float], intents.Intent]:
        return lambda shown: intents.SetJoint(arm, joint, from_shown(limits, shown))

    def _centre(self, state: ViewState, joints: dict[str, np.ndarray]) -> None:
        """Put the sliders' ends around the measured values, within the joints' limits, and the sliders where they are.

        Whatever a slider showed before was of another frame.
        """
        measured = state.frame.measured
        for (arm, joint), (limits, slider) in self._sliders.items():
            low, high = to_shown(limits, limits.lower), to_shown(limits, limits.upper)
            middle = to_shown(limits, float(measured[arm][joint]))
            shown = round(to_shown(limits, float(joints[arm][joint])), 2)
            first, last = max(low, min(middle - self._window, high)), min(high, max(middle + self._window, low))
            slider.min = _tidy(min(first, math.floor(shown)))
            slider.max = _tidy(max(last, math.ceil(shown)))
            slider.value = shown

    @staticmethod
    def _widen(slider: viser.GuiSliderHandle[float], value: float) -> None:
        """Let the slider reach a value beyond its ends."""
        if value < slider.min:
            slider.min = math.floor(value)
        if value > slider.max:
            slider.max = math.ceil(value)


def to_shown(limits: JointRange, value: float) -> float:
    """A joint position [rad, m] as people read it [deg, mm]."""
    return math.degrees(value) if limits.revolute else 1e3 * value


def from_shown(limits: JointRange, shown: float) -> float:
    """A joint position [rad, m] from what people type [deg, mm]."""
    return math.radians(shown) if limits.revolute else shown / 1e3


def _tidy(value: float) -> float:
    return round(value) if math.isfinite(value) else value
