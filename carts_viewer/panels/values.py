"""A table of all joints: measured, shown, how far apart, and how far from the truth."""

import math

import viser

from carts_core.settings import SurfaceSolver
from carts_viewer.joint_range import JointRange
from carts_viewer.panels.inputs import escaped, humanized
from carts_viewer.panels.joints import to_shown
from carts_viewer.session import Session
from carts_viewer.state import ViewState

_UNSURE = 1.0
"""Standard deviation from which a joint's value is a guess [deg] and [mm]: less than half of what arms are off by."""
_EXPECTED = SurfaceSolver()
_UNUSUAL = (
    2.0 * _EXPECTED.prior_deg,
    2e3 * math.radians(_EXPECTED.prior_deg) * _EXPECTED.length_scale,
)
"""Corrections that are rare, twice the deviation that the solver expects of measured joints [deg] and [mm]."""
_EXPLAINED = (
    f"± is one standard deviation. <span class='carts-unsure'>Amber ±</span> (above {_UNSURE:g}° or mm): the images "
    "hardly show this joint. Its value is a guess; the mask hardly depends on it.<br>"
    f"<span class='carts-unsure'>Amber change</span>: more than {_UNUSUAL[0]:.0f}° or {_UNUSUAL[1]:.0f} mm, which is "
    "rare in real arms. Smaller changes are usual."
)


class ValuesPanel:
    """By how much every joint of the shown frame was corrected."""

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._session = session
        self._table = gui.add_html("")

    def show(self, state: ViewState) -> None:
        """Bring the table up to date."""
        shown = self._session.joints(state.pose.scene)
        truth = state.frame.truth or {}
        known = {arm: value.standard_deviations for arm, value in state.project.joints(state.index).items()}
        columns = ["", "Measured", "Now", "Change", "±", *(["Error"] if truth else [])]
        rows = ["".join(f"<th>{name}</th>" for name in columns)]
        for arm in self._session.scene.arms:
            rows.append(f'<th colspan="{len(columns)}">{escaped(arm.name)}</th>')
            ranges = [limits for limits in self._session.ranges if limits.arm == arm.name]
            for joint, limits in enumerate(ranges):
                measured = to_shown(limits, float(state.frame.measured[arm.name][joint]))
                now = to_shown(limits, float(shown[arm.name][joint]))
                cells = [
                    f"{measured:.2f}",
                    f"{now:.2f}",
                    _marked(_signed(now - measured), abs(now - measured) > _UNUSUAL[0 if limits.revolute else 1]),
                    _deviation(limits, known.get(arm.name), joint),
                ]
                if arm.name in truth:
                    cells.append(_signed(now - to_shown(limits, float(truth[arm.name][joint]))))
                unit = "°" if limits.revolute else "mm"
                name = f"<td>{escaped(humanized(limits.joint))} <small>{unit}</small></td>"
                rows.append(name + "".join(f"<td>{cell}</td>" for cell in cells))
        body = "".join(f"<tr>{row}</tr>" for row in rows)
        self._table.content = f'<table class="carts-values">{body}</table><p class="carts-caption">{_EXPLAINED}</p>'


def _signed(difference: float) -> str:
    """With its sign, unless it is nothing to speak of."""
    return f"{difference:+.2f}" if abs(difference) >= 0.005 else "0.00"


def _deviation(limits: JointRange, known: tuple[float | None, ...] | None, joint: int) -> str:
    """Standard deviation of a joint as people read it; nothing where it is not known."""
    value = known[joint] if known else None
    if value is None:
        return ""
    shown = to_shown(limits, value)
    return _marked(f"{shown:.2f}", shown > _UNSURE)


def _marked(text: str, on: bool) -> str:
    return f'<span class="carts-unsure">{text}</span>' if on else text
