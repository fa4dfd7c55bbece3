"""The compared methods: the rows of the paper's main table, and what the default solver does with more to go by."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import get_args

from ...settings import DescentSolver, Loss, SolverName, SolverSettings, SurfaceSolver, solver
from ...settings.baseline import Augmentation, BaselineName, BaselineNetwork


@dataclass(frozen=True)
class Method:
    """One way from images and measured kinematics to a mask."""

    label: str
    """For people."""
    settings: Callable[[int], SolverSettings] | None
    """From the number of steps in the paper's setting to the optimizer's settings; None takes the network's own mask
    and looks at no kinematics."""
    occluders_given: bool = False
    """It is given the occluders' pixels."""
    every_camera: bool = False
    """All cameras enter one objective."""
    poses: bool = False
    """The poses of all cameras but the first are free, too."""
    calibrated: bool = False
    """Base frames are those of one calibration of the whole recording."""
    together: bool = False
    """Frames are corrected together, as a sequence."""
    masks_given: bool = False
    """The given masks are what is fitted, and no network is used."""
    baseline: bool = False
    """It is a network of others, whose weights have to be given."""
    image_alone: bool = False
    """It sees the image, and neither kinematics nor a rendering."""


def _ours(_: int) -> SolverSettings:
    return SurfaceSolver()


def _start(_: int) -> SolverSettings:
    return solver(SolverName.NONE)


METHODS = {
    "unet": Method("U-Net alone", None, image_alone=True),
    "surface": Method("surface network alone, given the rendering", None),
    "start": Method("CaRTS without optimization", _start),
    "l1": Method("CaRTS L1 (paper's setting)", lambda _: DescentSolver.paper(50, Loss.L1)),
    "paper": Method("CaRTS ACS (paper's setting)", DescentSolver.paper),
    "acs": Method("CaRTS ACS, our schedule", lambda _: DescentSolver()),
    "ours": Method("CaRTS, ours", _ours),
    "ours_given": Method("ours, occluder given", _ours, occluders_given=True),
    "ours_proposed": Method("ours, ignore mask proposed", lambda _: solver(SolverName.OCCLUDED)),
    "stereo": Method("ours, all cameras", _ours, every_camera=True),
    "stereo_posed": Method("ours, all cameras, posed", _ours, every_camera=True, poses=True),
    "calibrated": Method("one calibration, joints as measured", _start, calibrated=True),
    "calibrated_ours": Method("one calibration, then ours", _ours, calibrated=True),
    "sequence": Method("ours, sequence mode", _ours, together=True),
    "temporal": Method("TC-CaRTS, its temporal pipeline", DescentSolver.paper, together=True),
    "masks": Method("ours, masks as target", _ours, masks_given=True),
}
_NETWORKS: dict[BaselineName, str] = {
    "unet": "U-Net",
    "hrnet": "HRNet",
    "swin": "Swin",
    "colleoni": "Colleoni's",
}
_AUGMENTATIONS: dict[Augmentation, str] = {
    "none": "no augmentation",
    "smoke": "simulated smoke",
    "autoaugment": "AutoAugment",
    "elastic": "elastic",
    "projective": "projective",
}
assert set(_NETWORKS) == set(get_args(BaselineName)) and set(_AUGMENTATIONS) == set(get_args(Augmentation))
BASELINES = {
    f"{network}_{change}": Method(
        f"{label}, {what}", None, baseline=True, image_alone=not BaselineNetwork(network).looks_at_kinematics
    )
    for network, label in _NETWORKS.items()
    for change, what in _AUGMENTATIONS.items()
}
"""Rows of networks of others, by network and augmentation; measured where weights are given."""
METHODS |= BASELINES
MAIN = ("unet", "start", "l1", "paper", "ours")
"""Methods of the main table: each frame alone, in one camera."""
RENDERING = "surface"
"""The surface network's mask of an image and of what is rendered at the measured joint positions: two inputs, as
Colleoni et al. have them, and where ours begins."""
