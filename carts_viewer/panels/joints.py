"""Panels of joint positions: sliders, and a table of values."""

import math

import viser

from carts_core.optimization import undetermined_joints
from carts_core.settings import SurfaceSolver
from carts_viewer.actions import intents
from carts_viewer.actions.posing import MAX_PERTURBATION
from carts_viewer.panels.inputs import PanelPage, humanized, valid, write
from carts_viewer.session import Session
from carts_viewer.state import JointRange, Phase, Reach, ViewState
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
        self._nudged = gui.add_dropdown(
            "Nudged joint", list(self._names), hint="Joint that the keys {Nudge 0.1} and {Nudge -0.1} move"
        )
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


_EXPECTED = SurfaceSolver()
_UNUSUAL = (
    2.0 * _EXPECTED.prior_deg,
    2e3 * math.radians(_EXPECTED.prior_deg) * _EXPECTED.length_scale,
)
"""Threshold of unusually large corrections: two standard deviations of the solver's prior [deg], [mm]."""
_COLUMNS = {
    "Change": f"Correction of the measured value. More than {_UNUSUAL[0]:.0f}° or {_UNUSUAL[1]:.0f} mm is rare.",
    "Run": "Change by the last run",
    "±": "One standard deviation",
    "Image": "Whether the image determines the joint; the mask hardly depends on an undetermined joint.",
    "Error": "Difference from the ground truth",
}
"""Columns of the table, with their hints."""


class ValuesPanel:
    """Table of the joints of the shown frame: corrections, standard deviations, and observability."""

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._session = session
        self._table = gui.add_html("")

    def show(self, state: ViewState) -> None:
        """Update the table."""
        self._table.content = f'<table class="carts-values">{"".join(value_rows(state, self._session))}</table>'


def value_rows(state: ViewState, session: Session) -> list[str]:
    """Rows of the table of joints, and of other unknowns of the last run that the images hardly determine, as HTML."""
    shown, truth = session.joints(state.pose.scene), state.frame.truth or {}
    known = {arm: value.standard_deviations or () for arm, value in state.project.joints(state.index).items()}
    undetermined = undetermined_joints(session.scene, known)
    # Changes by a run are those of the shown frame only until another frame is shown, which forgets the run.
    before = None if state.run.start is None else session.joints(state.run.start)
    absent = {"Run"} if before is None else set()
    absent |= set() if truth else {"Error"}
    absent |= {"±", "Image"} if undetermined is None else set()
    columns = [name for name in _COLUMNS if name not in absent]
    heads = "".join(f'<th scope="col" title="{_COLUMNS[name]}">{name}</th>' for name in columns)
    rows = [f'<tr><th scope="col">Joint</th>{heads}</tr>']
    for arm in session.scene.arms:
        rows.append(f'<tr><th colspan="{1 + len(columns)}">{escaped(arm.name)}</th></tr>')
        for joint, limits in enumerate(session.ranges[arm.name]):
            measured = limits.to_shown(float(state.frame.measured[arm.name][joint]))
            now = limits.to_shown(float(shown[arm.name][joint]))
            std = dict(enumerate(known.get(arm.name, ()))).get(joint)
            cells = {
                "Change": _marked(_signed(now - measured), abs(now - measured) > _UNUSUAL[0 if limits.revolute else 1]),
                "±": "" if std is None else f"{limits.to_shown(std):.2f}",
                "Image": "" if std is None else _chip(f"{arm.name}.{limits.joint}" not in (undetermined or ())),
            }
            if before is not None:
                cells["Run"] = _signed(now - limits.to_shown(float(before[arm.name][joint])))
            if arm.name in truth:
                cells["Error"] = _signed(now - limits.to_shown(float(truth[arm.name][joint])))
            name = f"{escaped(humanized(limits.joint))} <small>{limits.unit}</small>"
            title = f"measured {measured:.2f}, now {now:.2f} {limits.unit}"
            values = "".join(f"<td>{cells.get(column, '')}</td>" for column in columns)
            rows.append(f'<tr title="{title}"><td>{name}</td>{values}</tr>')
    rows += [
        f'<tr><td colspan="{len(columns)}">{escaped(name.replace("/", " ").replace("_", " "))}</td>'
        f"<td>{_chip(False)}</td></tr>"
        for name in _open_unknowns(state, session)
    ]
    return rows


def _open_unknowns(state: ViewState, session: Session) -> list[str]:
    """Unknowns of the last run besides joints, such as `psm1/base/x`, that the images do not determine."""
    known = None if state.maps is None or not state.maps.of_run else state.maps.iterate.uncertainty
    if known is None or state.run.phase is Phase.RUNNING:
        return []
    joints = {f"{limits.arm}/{limits.joint}" for ranges in session.ranges.values() for limits in ranges}
    return [name for name in known.names if name not in joints and known.observability(name) != "determined"]


def _chip(determined: bool) -> str:
    return '<span class="carts-chip">yes</span>' if determined else '<span class="carts-chip doubtful">no</span>'


def _signed(difference: float) -> str:
    """Difference as text with its sign, unless it rounds to zero."""
    return f"{difference:+.2f}" if abs(difference) >= 0.005 else "0.00"


def _marked(text: str, on: bool) -> str:
    return f'<span class="carts-unsure">{text}</span>' if on else text
