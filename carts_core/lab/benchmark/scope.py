"""Scope of a benchmark: runs, compared methods, and numbers of frames."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import get_args

from ...errors import SettingsError
from ...settings import DOMAINS, DescentSolver, Loss, SolverName, SolverSettings, SurfaceSolver, solver
from ...settings.training import Augmentation, BaselineName, BaselineNetwork

SYNTHETIC = "synthetic"
REAL = "real"
ROOMS = "rooms"
"""Instruments in other rooms; a source of that name and the camera's, or `synthetic`."""
FAMILY = "family"
"""Instruments in no training data; a source of that name and the instrument's."""
PAPERS_STEPS = 50
"""The paper's number of steps."""


@dataclass(frozen=True)
class Run:
    """One method on one frame from one start."""

    source: str
    """`synthetic`, `real`, `rooms` and a camera, or `family` and an instrument."""
    domain: str
    """One of the synthetic domains, `occlusion`, `crossing arms`, a room, or one of `conditions.WRONG`."""
    frame: int
    """Position in the sequence."""
    method: str
    """A name in `METHODS`."""
    error_deg: float | None = None
    """Error of every joint at the start [deg; mm for prismatic joints], from the true joint positions if known; None
    starts at the measured ones."""


@dataclass(frozen=True)
class Scope:
    """How much is measured; defaults are those of the full form."""

    frames: int = 8
    """Frames of each sequence, evenly spread, on which all methods are evaluated."""
    sequence_frames: int = 24
    """Frames of the synthetic sequence that is made; all of them serve the estimate of the background."""
    samples: int = 8
    """Paths per pixel of the synthetic sequence."""
    paper_iterations: int = 100
    """Steps in the paper's setting from the measured joint positions, `PAPERS_STEPS` at most from others. Its schedule
    does not depend on their number, so one run holds all shorter ones."""
    error_domains: tuple[str, ...] = DOMAINS
    """Synthetic domains with errors at the start."""
    errors_deg: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    """Sizes of that error for the default solver [deg]."""
    paper_errors_deg: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    """The same for the paper's setting, in the regular domain [deg]."""
    further_errors_deg: tuple[float, ...] = (1.0, 2.0, 3.0, 5.0)
    """The same for the default solver on the other frames of the synthetic sequence [deg]."""
    real_errors_deg: tuple[float, ...] = (1.0, 2.0, 3.0)
    """The same on real frames, both methods, in the regular domain, from the measured joint positions [deg]."""
    hard_errors_deg: tuple[float, ...] = (2.0,)
    """The same on synthetic frames with occluders, and with all cameras at once [deg]."""
    crossing_errors_deg: tuple[float, ...] = (1.0, 2.0, 3.0)
    """The same on synthetic frames whose arms cross, for the default solver and ACS [deg]."""
    consecutive: int = 30
    """Largest number of first frames of each sequence that are corrected together."""
    consecutive_domains: tuple[str, ...] = DOMAINS
    """Domains of these frames."""
    consecutive_errors_deg: tuple[float, ...] = (1.0, 2.0, 3.0)
    """Sizes of an error at the start that all synthetic frames share, in those domains [deg]."""
    calibration_frames: int = 20
    """Frames of a calibration of a real sequence, evenly spread."""
    room_frames: int = 2
    """Frames of a real sequence that are put before each of the other rooms, evenly spread."""
    room_consecutive: int = 8
    """The same for frames that are corrected together there."""
    room_share: int = 1
    """Every n-th room is measured."""
    family_frames: int = 6
    """Frames of each instrument that is in no training data; may be 0."""
    hand_eye_starts: int = 10
    """Starts of each hand-eye calibration of another robot."""

    def steps(self, run: Run) -> int:
        """Steps in the paper's setting for a run."""
        return self.paper_iterations if run.error_deg is None else min(self.paper_iterations, PAPERS_STEPS)

    def with_frames(self, frames: int) -> "Scope":
        """The same with another number of evaluated frames.

        Raises:
            SettingsError: it is less than one, or more than the synthetic sequence has.
        """
        if not 1 <= frames <= self.sequence_frames:
            raise SettingsError(
                f"--frames is {frames}; the synthetic sequence has {self.sequence_frames}. Give 1 to "
                f"{self.sequence_frames}."
            )
        return replace(self, frames=frames)


FULL = Scope()
QUICK = Scope(
    frames=2,
    sequence_frames=3,
    samples=4,
    paper_iterations=PAPERS_STEPS,
    error_domains=("regular",),
    paper_errors_deg=(2.0,),
    further_errors_deg=(),
    real_errors_deg=(),
    crossing_errors_deg=(2.0,),
    consecutive=6,
    consecutive_domains=("regular",),
    consecutive_errors_deg=(2.0,),
    calibration_frames=8,
    room_frames=1,
    room_consecutive=0,
    room_share=8,
    family_frames=1,
    hand_eye_starts=1,
)


@dataclass(frozen=True)
class Method:
    """A method of the comparison, from images and measured kinematics to a mask."""

    label: str
    """Label in tables."""
    settings: Callable[[int], SolverSettings] | None
    """From the number of steps in the paper's setting to the optimizer's settings; None takes the network's own mask
    and looks at no kinematics."""
    occluders_given: bool = False
    """The pixels of occluders are given."""
    every_camera: bool = False
    """All cameras enter one objective."""
    poses: bool = False
    """The poses of all cameras but the first are free, too."""
    calibrated: bool = False
    """Base frames are those of one calibration of the whole recording."""
    together: bool = False
    """Frames are corrected together, as a sequence."""
    masks_given: bool = False
    """Given masks are fitted, without a network."""
    baseline: bool = False
    """A network from the literature, whose weights have to be given."""
    image_alone: bool = False
    """Its only input is the image."""


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
_NETWORKS: dict[BaselineName, str] = {"unet": "U-Net", "hrnet": "HRNet", "swin": "Swin", "colleoni": "Colleoni's"}
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
"""Networks from the literature, by network and augmentation; measured if weights are given."""
METHODS |= BASELINES
MAIN = ("unet", "start", "l1", "paper", "ours")
"""Methods of the main table: each frame alone, in one camera."""
RENDERING = "surface"
"""The surface network's mask from an image and the rendering at the measured joint positions, the inputs of Colleoni et
al."""
