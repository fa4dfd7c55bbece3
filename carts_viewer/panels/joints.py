"""Panels of joint positions: sliders, a table of values, and keypoints."""

import math

import viser

from carts_core.settings import SurfaceSolver
from carts_viewer.actions import intents
from carts_viewer.actions.posing import MAX_PERTURBATION
from carts_viewer.panels.inputs import PanelPage, humanized, valid, write
from carts_viewer.picture.overlay import labelled_keypoints
from carts_viewer.session import Session
from carts_viewer.state import JointRange, Reach, ViewState
from carts_viewer.transport.document import escaped

_STEP = 0.05
"""Step of the sliders [deg] and [mm]."""


class JointsPanel:
    """One tab per arm with its joints, and buttons for all arms."""

    def __init__(self, page: PanelPage, session: Session, state: ViewState) -> None:
        gui = page.gui
        self._session = session
        self._waits = page.waits
        self._page = page
        self._sliders: dict[tuple[str, int], tuple[JointRange, viser.GuiSliderHandle[float]]] = {}
        tabs = gui.add_tab_group()
        for arm in session.scene.arms:
            with tabs.add_tab(arm.name, viser.Icon.GRAIN):
                self._add_arm(page, arm.name, state)
        self._reach = gui.add_dropdown(
            "Slider range",
            [str(reach) for reach in Reach],
            initial_value=str(state.reach),
            hint="Range of the sliders around the measured values [° or mm]",
        )
        page.button("Perturb all joints", lambda _: self.perturb())
        self._degrees = gui.add_number("By [°, mm]", 2.0, min=0.0, max=MAX_PERTURBATION, step=0.5)
        self._seed = gui.add_number("Seed", 0, min=0, max=2**31 - 1, step=1)
        page.columns([self._degrees, self._seed], narrow_labels=True)
        back = "All back to measured" if len(session.scene.arms) > 1 else "Back to measured"
        page.button(back, intents.BackToMeasured(), icon=viser.Icon.HISTORY)
        before = page.button(
            "Copy previous", intents.CopyCorrection(-1), hint="Copy the correction of the previous frame"
        )
        after = page.button("Copy next", intents.CopyCorrection(1), hint="Copy the correction of the next frame")
        page.row(before, after)
        self._names = {
            f"{limits.arm} {humanized(limits.joint)}": (limits.arm, number)
            for arm in session.scene.arms
            for number, limits in enumerate(session.ranges[arm.name])
        }
        self._nudged = gui.add_dropdown("Nudge (I, O)", list(self._names), hint="Joint that the keys I and O move")
        page.on_input(self._reach, lambda name: intents.SetReach(Reach(name)))
        page.on_input(self._nudged, lambda name: intents.ChooseJoint(self._names[name]))

    def perturb(self) -> intents.Perturb:
        """Perturbation with the amount and seed in the fields."""
        seed = int(self._seed.value) if valid(self._seed, self._seed.value) else 0
        return intents.Perturb(float(self._degrees.value), max(0, seed))

    def slider(self, arm: str, joint: int) -> viser.GuiSliderHandle[float]:
        """The slider of one joint."""
        return self._sliders[arm, joint][1]

    def show(self, state: ViewState) -> None:
        """Update the widgets."""
        joints = self._session.joints(state.pose.scene)
        with self._page.atomic():
            for (arm, joint), (limits, slider) in self._sliders.items():
                # A slider that is being dragged is ahead of the state; writing would pull it back.
                if not self._waits((intents.SetJoint, arm, joint)):
                    measured, shown = (limits.to_shown(float(of[arm][joint])) for of in (state.frame.measured, joints))
                    self._set_slider(slider, limits, state, measured, shown)
        write(self._reach, str(state.reach))
        if state.joint is not None:
            write(self._nudged, next(name for name, joint in self._names.items() if joint == state.joint))

    def _add_arm(self, page: PanelPage, arm: str, state: ViewState) -> None:
        gui = page.gui
        joints = self._session.joints(state.pose.scene)[arm]
        for joint, limits in enumerate(self._session.ranges[arm]):
            low, high = limits.to_shown(limits.lower), limits.to_shown(limits.upper)
            value = limits.to_shown(float(joints[joint]))
            unit = limits.unit
            label = f"{humanized(limits.joint)} [{unit}]"
            ends = f"limits {low:.0f} to {high:.0f} {unit}"
            hint = f"{'Angle' if limits.revolute else 'Position'} of this joint of {arm} [{unit}], {ends}"
            slider = gui.add_slider(
                label, math.floor(min(low, value)), math.ceil(max(high, value)), _STEP, round(value, 2), hint=hint
            )
            self._sliders[arm, joint] = (limits, slider)
            page.on_input(
                slider,
                lambda shown, joint=joint, limits=limits: intents.SetJoint(arm, joint, limits.from_shown(shown)),
            )
        if len(self._session.scene.arms) > 1:
            hint = f"Reset {arm} in this frame to the measured joints"
            page.button(f"{arm} back to measured", intents.BackToMeasured(arm), icon=viser.Icon.HISTORY, hint=hint)

    @staticmethod
    def _set_slider(
        slider: viser.GuiSliderHandle[float], limits: JointRange, state: ViewState, measured: float, shown: float
    ) -> None:
        """Set a slider's ends around the measured value, within the joint's limits, and its value.

        The range extends to the shown value and shrinks again later, but not during a drag: this would change the value
        under the pointer.
        """
        low, high = limits.to_shown(limits.lower), limits.to_shown(limits.upper)
        middle, width = max(low, min(measured, high)), state.reach.width
        first = _tidy(min(max(low, middle - width), math.floor(shown)))
        last = _tidy(max(min(high, middle + width), math.ceil(shown)))
        if state.unsaved:
            first, last = min(first, slider.min), max(last, slider.max)
        if slider.min != first:
            slider.min = first
        if slider.max != last:
            slider.max = last
        near = math.isfinite(slider.value) and abs(slider.value - shown) < _STEP / 2
        if not near:
            slider.value = round(shown, 2)


def _tidy(value: float) -> float:
    return round(value) if math.isfinite(value) else value


_UNSURE = 1.0
"""Standard deviation above which a joint counts as undetermined [deg, mm]; less than half of a typical error."""
_EXPECTED = SurfaceSolver()
_UNUSUAL = (
    2.0 * _EXPECTED.prior_deg,
    2e3 * math.radians(_EXPECTED.prior_deg) * _EXPECTED.length_scale,
)
"""Threshold of unusually large corrections: two standard deviations of the solver's prior [deg], [mm]."""
_EXPLAINED = (
    f"± is one standard deviation. <span class='carts-unsure'>Amber ±</span> (above {_UNSURE:g}° or {_UNSURE:g} mm): "
    "the images hardly determine this joint. Its value is a guess, but hardly affects the mask.<br>"
    f"<span class='carts-unsure'>Amber change</span>: more than {_UNUSUAL[0]:.0f}° or {_UNUSUAL[1]:.0f} mm, which is "
    "rare in real arms. Smaller changes are common."
)


class ValuesPanel:
    """Table of the corrections of all joints of the shown frame."""

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._session = session
        self._table = gui.add_html("")

    def show(self, state: ViewState) -> None:
        """Update the table."""
        shown = self._session.joints(state.pose.scene)
        truth = state.frame.truth or {}
        known = {arm: value.standard_deviations for arm, value in state.project.joints(state.index).items()}
        columns = ["", "Measured", "Now", "Change", "±", *(["Error"] if truth else [])]
        rows = ["".join(f"<th>{name}</th>" for name in columns)]
        for arm in self._session.scene.arms:
            rows.append(f'<th colspan="{len(columns)}">{escaped(arm.name)}</th>')
            for joint, limits in enumerate(self._session.ranges[arm.name]):
                measured = limits.to_shown(float(state.frame.measured[arm.name][joint]))
                now = limits.to_shown(float(shown[arm.name][joint]))
                cells = [
                    f"{measured:.2f}",
                    f"{now:.2f}",
                    _marked(_signed(now - measured), abs(now - measured) > _UNUSUAL[0 if limits.revolute else 1]),
                    _standard_deviation(limits, known.get(arm.name), joint),
                ]
                if arm.name in truth:
                    cells.append(_signed(now - limits.to_shown(float(truth[arm.name][joint]))))
                unit = limits.unit
                name = f"<td>{escaped(humanized(limits.joint))} <small>{unit}</small></td>"
                rows.append(name + "".join(f"<td>{cell}</td>" for cell in cells))
        body = "".join(f"<tr>{row}</tr>" for row in rows)
        self._table.content = f'<table class="carts-values">{body}</table><p class="carts-caption">{_EXPLAINED}</p>'


def _signed(difference: float) -> str:
    """Difference as text with its sign, unless it rounds to zero."""
    return f"{difference:+.2f}" if abs(difference) >= 0.005 else "0.00"


def _standard_deviation(limits: JointRange, known: tuple[float | None, ...] | None, joint: int) -> str:
    """Standard deviation of a joint as text; empty if unknown."""
    value = known[joint] if known else None
    if value is None:
        return ""
    shown = limits.to_shown(value)
    return _marked(f"{shown:.2f}", shown > _UNSURE)


def _marked(text: str, on: bool) -> str:
    return f'<span class="carts-unsure">{text}</span>' if on else text


_NEAREST = "Nearest to the pointer"


class KeypointsPanel:
    """Choice of the keypoint to place, and residuals of placed keypoints."""

    def __init__(self, page: PanelPage, session: Session) -> None:
        gui = page.gui
        self._labels = {point: label for label, point in labelled_keypoints(session.scene).items()}
        with gui.add_folder("Keypoints"):
            gui.add_html(
                '<p class="carts-caption"><b>Shift+click</b> places the chosen keypoint in the image; <b>Shift+'
                "drag</b> moves it. The arm follows immediately. A run starts from this pose; keypoints do not "
                "constrain it.</p>"
            )
            options = [_NEAREST, *self._labels.values()]
            self._chosen = gui.add_dropdown("Keypoint", options)
            self._shown = gui.add_checkbox("Show keypoints", False)
            self._residuals = gui.add_html("")
            self._forget = page.button("Clear clicks", intents.RemovePins(), icon=viser.Icon.X, visible=False)
        page.on_input(self._chosen, lambda label: intents.ChooseKeypoint(None if label == _NEAREST else label))
        page.on_input(self._shown, lambda on: intents.ShowKeypoints(bool(on)))

    def show(self, state: ViewState) -> None:
        """Update the widgets."""
        keypoints = state.keypoints
        write(self._chosen, keypoints.chosen or _NEAREST)
        write(self._shown, keypoints.shown)
        self._forget.visible = bool(keypoints.pins)
        rows = [
            f"<tr><td>{escaped(self._labels[pin.keypoint])} <small>({escaped(pin.camera)})</small></td>"
            f"<td>{residual:.1f} px off</td></tr>"
            for pin, residual in zip(keypoints.pins, keypoints.residuals, strict=True)
        ]
        self._residuals.content = f'<table class="carts-values">{"".join(rows)}</table>'
