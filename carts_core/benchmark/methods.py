"""The compared methods: the rows of the paper's main table."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from ..optimization import OptimizerSettings


@dataclass(frozen=True)
class Method:
    """One way from an image and measured kinematics to a mask."""

    label: str
    """For people."""
    settings: Callable[[int], OptimizerSettings] | None
    """From the number of steps in the paper's setting to the optimizer's settings; None takes the network's own mask
    and looks at no kinematics."""


METHODS = {
    "unet": Method("U-Net alone", None),
    "start": Method("CaRTS without optimization", lambda _: OptimizerSettings(solver="none")),
    "l1": Method("CaRTS L1 (paper's setting)", lambda _: replace(OptimizerSettings.paper(50), loss="l1")),
    "paper": Method("CaRTS ACS (paper's setting)", OptimizerSettings.paper),
    "ours": Method("CaRTS, ours", lambda _: OptimizerSettings()),
}
