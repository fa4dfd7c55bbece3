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
"""Prefix of sources with instruments in other rooms, followed by the camera or `synthetic`."""
FAMILY = "family"
"""Prefix of sources with instruments absent from the training data, followed by the instrument."""
PAPERS_STEPS = 50
"""Number of steps in the paper."""


@dataclass(frozen=True)
class Run:
    """Application of a method to a frame, from an initial estimate."""

    source: str
    """`synthetic`, `real`, `rooms` and a camera, or `family` and an instrument."""
    domain: str
    """One of the synthetic domains, `occlusion`, `crossing arms`, a room, or one of `conditions.WRONG`."""
    frame: int
    """Index in the sequence."""
    method: str
    """A name in `METHODS`."""
    error_deg: float | None = None
    """Initial error of every joint [deg; mm for prismatic joints] relative to the true joint positions if known, else
    to the measured joint positions; None starts at the measured joint positions."""


@dataclass(frozen=True)
class Scope:
    """Extent of the benchmark; defaults are those of the full benchmark."""

    frames: int = 8
    """Number of evenly spaced frames per sequence on which all methods are evaluated."""
    sequence_frames: int = 24
    """Number of frames of the synthetic sequence, from which the background is estimated."""
    samples: int = 8
    """Samples per pixel in path tracing of the synthetic sequence."""
    paper_iterations: int = 100
    """Steps in the paper's setting from the measured joint positions; at most `PAPERS_STEPS` from other starts. The
    schedule does not depend on the number of steps, so a run contains all shorter runs."""
    error_domains: tuple[str, ...] = DOMAINS
    """Synthetic domains with initial errors."""
    errors_deg: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    """Initial errors for the default solver [deg]."""
    paper_errors_deg: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    """Initial errors for the paper's setting, in the regular domain [deg]."""
    further_errors_deg: tuple[float, ...] = (1.0, 2.0, 3.0, 5.0)
    """Initial errors for the default solver on the other frames of the synthetic sequence [deg]."""
    real_errors_deg: tuple[float, ...] = (1.0, 2.0, 3.0)
    """Initial errors on real frames in the regular domain, relative to the measured joints, for the default solver and
    for the paper's setting [deg]."""
    hard_errors_deg: tuple[float, ...] = (2.0,)
    """Initial errors on synthetic frames with occluders, given masks or other instruments, and for joint optimization
    of all cameras [deg]."""
    crossing_errors_deg: tuple[float, ...] = (1.0, 2.0, 3.0)
    """Initial errors on synthetic frames with crossing arms, for the default solver and ACS [deg]."""
    consecutive: int = 30
    """Maximum number of frames that are corrected together in each sequence, starting with the first frame."""
    consecutive_domains: tuple[str, ...] = DOMAINS
    """Domains of frames corrected together."""
    consecutive_errors_deg: tuple[float, ...] = (1.0, 2.0, 3.0)
    """Initial errors of jointly corrected frames, equal in all frames [deg]."""
    calibration_frames: int = 20
    """Number of evenly spaced frames for the calibration of a real sequence."""
    room_frames: int = 2
    """Number of evenly spaced frames of a sequence that are composited over each room."""
    room_consecutive: int = 8
    """Number of frames corrected together in each room."""
    room_share: int = 1
    """Stride over the rooms: every n-th room is measured."""
    family_frames: int = 6
    """Number of frames of each instrument absent from the training data; may be 0."""
    hand_eye_starts: int = 10
    """Number of starts per condition of the hand-eye calibration of another robot."""

    def steps(self, run: Run) -> int:
        """Number of steps in the paper's setting for a run."""
        return self.paper_iterations if run.error_deg is None else min(self.paper_iterations, PAPERS_STEPS)

    def with_frames(self, frames: int) -> "Scope":
        """Copy with another number of evaluated frames.

        Raises:
            SettingsError: the number is below 1 or exceeds the length of the synthetic sequence.
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
    """Compared method, which predicts a mask from images and measured kinematics."""

    label: str
    """Label in tables."""
    settings: Callable[[int], SolverSettings] | None
    """Optimizer settings as a function of the number of steps in the paper's setting; None evaluates the mask predicted
    by the network, without kinematics."""
    occluders_given: bool = False
    """Whether the pixels of occluders are given."""
    every_camera: bool = False
    """Whether all cameras are optimized jointly."""
    poses: bool = False
    """Whether the poses of all cameras except the first are also optimized."""
    calibrated: bool = False
    """Whether base frames come from one calibration of the whole recording."""
    as_sequence: bool = False
    """Whether frames are corrected together, as a sequence."""
    refined: bool = False
    """Whether masks of good results are refined, as in exports."""
    masks_given: bool = False
    """Whether given masks are fitted, without a network."""
    baseline: bool = False
    """Whether the method is a network from the literature, whose weights must be given."""
    image_alone: bool = False
    """Whether the image is the only input."""


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
    "ours_refined": Method("CaRTS, ours, refined masks", _ours, refined=True),
    "ours_given": Method("ours, occluder given", _ours, occluders_given=True),
    "ours_proposed": Method("ours, ignore mask proposed", lambda _: solver(SolverName.OCCLUDED)),
    "stereo": Method("ours, all cameras", _ours, every_camera=True),
    "stereo_posed": Method("ours, all cameras, free poses", _ours, every_camera=True, poses=True),
    "calibrated": Method("one calibration, joints as measured", _start, calibrated=True),
    "calibrated_ours": Method("one calibration, then ours", _ours, calibrated=True),
    "sequence": Method("ours, sequence mode", _ours, as_sequence=True),
    "temporal": Method("TC-CaRTS, its temporal pipeline", DescentSolver.paper, as_sequence=True),
    "masks": Method("ours, masks as target", _ours, masks_given=True),
}
_NETWORKS: dict[BaselineName, str] = {
    "unet": "U-Net",
    "hrnet": "HRNet",
    "swin": "Swin",
    "efficientnet": "EfficientNet",
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
        f"{label}, {what}", None, baseline=True, image_alone=not BaselineNetwork(network).uses_kinematics
    )
    for network, label in _NETWORKS.items()
    for change, what in _AUGMENTATIONS.items()
}
"""Networks from the literature, by network and augmentation; measured if weights are given."""
METHODS |= BASELINES
MAIN = ("unet", "start", "l1", "paper", "ours", "ours_refined")
"""Methods of the main table, which treat each frame separately in one camera."""
RENDERING = "surface"
"""Method whose mask is predicted by the surface network from the image and the rendering at the measured joint
positions, the inputs of Colleoni et al."""
