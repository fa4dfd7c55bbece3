"""Settings of frame solvers, sequence mode and calibration: free parameters, priors, noise and devices."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Literal, get_args

from ..errors import SettingsError
from .ranges import Range, Ranged, Share, require
from .stages import (
    CALIBRATION_STAGES,
    COLD,
    FEATURES,
    FRAME,
    NONE,
    OCCLUDED,
    PAPER,
    WARM,
    WARM_WIDE,
    FirstOrder,
    Stage,
)

Inference = Literal["auto", "torch", "onnx"]
"""`torch`, `onnx` (ONNX Runtime, on a CPU), or whichever is faster here and gives the same."""
Engine = Literal["torch", "onnx"]
"""Selected inference engine."""


Direction = Literal["forward", "backward"]
"""In which direction corrections are handed on from frame to frame."""


@dataclass(frozen=True)
class SequenceSettings(Ranged):
    """Model of the measurement error, and how frames inform each other (docs: explanation/sequences)."""

    constant_deg: Annotated[float, Range(1e-3, 360, "deg")] = 2.0
    """Deviation of the constant part of the error [deg]; `length_scale` turns it into metres."""
    drift_deg: Annotated[float, Range(1e-3, 360, "deg")] = 0.2
    """Deviation of the slow drift about it [deg]."""
    drift_seconds: Annotated[float, Range(1e-3, 1e6, "s")] = 4.0
    """Time constant of the drift's autocorrelation [s]."""
    jitter_deg: Annotated[float, Range(1e-3, 360, "deg")] = 0.05
    """Deviation of the error that is independent in every frame [deg]."""
    measurement_noise: Annotated[float, Range(1e-3, 100)] = 4.0
    """As `SurfaceSolver.noise`, for a frame's measurement in the smoother; larger, since the errors of neighbouring
    pixels are correlated [1]."""
    correlation_seconds: Annotated[float, Range(1e-6, 1e6, "s")] = 0.5
    """Time constant of the autocorrelation of image errors; frames that follow each other faster count less for the
    others [s]."""
    shared_seconds: Annotated[float, Range(1e-6, 1e6, "s")] = 5.0
    """The same for the reported deviations: a network errs alike for as long as an instrument is seen from one side,
    and deviations are not to count on more than that [s]."""
    initial_frames: Annotated[int, Range(1, 20)] = 5
    """How many frames, evenly spread, are solved alone to find where the first one starts; 1 takes the first frame
    only [1]."""
    cold_factor: Annotated[float, Range(1, 100)] = 2.0
    """A loss of that many times the median has a frame start cold [1]."""
    direction: Direction = "forward"
    """Direction of the first pass: from the first frame, or from the last one."""
    frame_seconds: Annotated[float, Range(1e-6, 1e6, "s")] = 0.25
    """Time between frames, where the sequence has no times [s]."""
    cold: tuple[Stage, ...] = COLD
    """Stages from measured kinematics; `warm` follows."""
    warm: tuple[Stage, ...] = WARM
    """Stages from the correction that the other frames predict."""
    wide: tuple[Stage, ...] = WARM_WIDE
    """Stages where `warm` ends with an unusual loss, before a cold start."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.direction in get_args(Direction), "direction", self.direction, " or ".join(get_args(Direction)))


class Loss(StrEnum):
    """Losses of image features."""

    ACS = "acs"
    """Mean dissimilarity inside the attention map, independent of how large that is."""
    ACS_PAPER = "acs_paper"
    """The paper's equation, 1 - mean(similarity x attention); falls when the silhouette grows."""
    ACS_REFERENCE = "acs_reference"
    """mean((1 - similarity) x attention), as in the released code; falls when the silhouette shrinks."""
    L1 = "l1"
    """Smooth L1 between the network's predictions ("CaRTS L1")."""


Method = Literal["adam", "gradient_descent"]
"""First-order methods."""


@dataclass(frozen=True)
class FreeParameters:
    """Which values of the scene are unknown. Joints of all arms by default, as in the paper."""

    joints: bool = True
    """Joint positions of the free arms."""
    base_frames: bool = False
    """Base frames of the free arms (hand-eye error as seen from the arm)."""
    extrinsics: bool = False
    """Camera extrinsics."""
    intrinsics: bool = False
    """Focal lengths and principal points."""
    arms: tuple[str, ...] = ()
    """Names of the free arms; none named means all."""
    locked_joints: tuple[str, ...] = ()
    """Joints that are held, as `joint` for every arm or `arm/joint` for one."""
    locked_cameras: tuple[str, ...] = ()
    """Cameras whose extrinsics are held."""

    @property
    def joints_only(self) -> bool:
        """Whether no calibration is unknown, which frames share."""
        return not (self.base_frames or self.extrinsics or self.intrinsics)


@dataclass(frozen=True)
class SurfaceSolver(Ranged):
    """Compares predicted surface maps with rendered ones, by Levenberg-Marquardt: the default."""

    stages: tuple[Stage, ...] = FRAME
    """What runs, in this order."""
    iterations: Annotated[int, Range(1, 10_000)] = 60
    """Largest number of evaluations [1]; where stages run again from the start, they have as many again."""
    working_width: Annotated[int, Range(64, 4096, "px")] = 320
    """Width of the working image [px]; stages say how many times larger their images are."""
    noise: Annotated[float, Range(1e-3, 100)] = 1.33
    """Deviation of the predicted surface map, per pixel [1]; a small value relies on the image."""
    mask_noise: Annotated[float, Range(1e-3, 100)] = 0.5
    """The same of given masks [1]."""
    parts_weight: Annotated[float, Range(0, 100)] = 0.1
    """Weight of the coverage of single parts beside that of the whole arm [1]."""
    normals_weight: Annotated[float, Range(0, 100)] = 0.05
    """Weight of normals beside that [1]."""
    dehaze: Share = 0.8
    """Share of smoke and haze that is removed from images [1]."""
    outline_error: Annotated[float, Range(0, 100, "px")] = 0.3
    """Expected error that all outlines in an image have in common, outwards or inwards [px of the working image].
    It widens the reported deviations of what moves an arm along the line of sight."""
    start_share: Share = 0.1
    """Share of an error of the start that is left in what the network predicts, which is given a rendering of the start
    [1]. It widens the reported deviations and changes no estimate; given masks have no such share."""
    prior_deg: Annotated[float, Range(1e-3, 360, "deg")] = 2.5
    """Expected error of a joint position at the start [deg]; `length_scale` turns it into metres."""
    frame_prior_deg: Annotated[float, Range(1e-3, 360, "deg")] = 0.5
    """The same of base frames and camera extrinsics [deg]."""
    intrinsics_prior: Annotated[float, Range(1e-6, 1)] = 0.01
    """The same of focal lengths and principal points, as a share of the focal length [1]."""
    length_scale: Annotated[float, Range(1e-3, 10, "m")] = 0.15
    """Metres of translation that count as one radian [m]: about the distance from the remote centre to the tip."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(len(self.stages) > 0, "stages", self.stages, "one or more")
        of_kind = not any(isinstance(stage, FirstOrder) for stage in self.stages)
        require(of_kind, "stages", self.stages, "stages of the surface solver (no FirstOrder)")

    @property
    def needs_background(self) -> bool:
        """Whether the mean background is compared."""
        return False


@dataclass(frozen=True)
class DescentSolver(Ranged):
    """Compares features of the image with those of the hybrid image (rendered arms over the mean background)."""

    loss: Loss = Loss.ACS
    """Which loss."""
    method: Method = "adam"
    """Optimizer that descends it."""
    stages: tuple[Stage, ...] = FEATURES
    """What runs, in this order."""
    iterations: Annotated[int, Range(1, 10_000)] = 60
    """Planned number of steps [1]."""
    learning_rate: Annotated[float, Range(0, 1, "rad", above=True)] = 6e-3
    """First step size [rad]; a prismatic joint or a translation moves `length_scale` times as many metres."""
    decay: Annotated[float, Range(0, 1, above=True)] = 0.82
    """Factor on the step size every `decay_every` steps [1]."""
    decay_every: Annotated[int, Range(1, 10_000)] = 5
    """Steps between two decays [1]."""
    length_scale: Annotated[float, Range(1e-3, 10, "m")] = 0.15
    """Metres of translation that count as one radian [m]."""
    prior_weight: Annotated[float, Range(0, 1e6)] = 0.02
    """Weight of the prior that holds unknowns at their start [1/rad^2]."""
    working_width: Annotated[int, Range(64, 4096, "px")] = 320
    """Width of the images that are compared [px]."""
    tolerance: Annotated[float, Range(0, 1, below=True)] = 0.0
    """It stops when the best loss has improved by less than this in `patience` steps; 0 never stops early."""
    patience: Annotated[int, Range(1, 10_000)] = 10
    """See `tolerance` [1]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "loss", _loss(self.loss))
        methods = ("adam", "gradient_descent")
        require(self.method in methods, "method", self.method, " or ".join(methods))
        of_kind = len(self.stages) > 0 and all(isinstance(stage, FirstOrder) for stage in self.stages)
        require(of_kind, "stages", self.stages, "one or more FirstOrder stages")

    @property
    def needs_background(self) -> bool:
        """Whether the mean background is compared."""
        return True

    @staticmethod
    def paper(iterations: int = 50, loss: Loss = Loss.ACS_PAPER) -> "DescentSolver":
        """The paper's setting: Adam at 1e-3, times 0.9 every 5 steps, its own loss, no prior.

        Lengths of its released code are decimetres (`PSM.L_rcc` is 4.389), so a step of the insertion is 1e-3 dm.
        """
        return DescentSolver(
            loss=loss,
            stages=PAPER,
            iterations=iterations,
            learning_rate=1e-3,
            decay=0.9,
            prior_weight=0.0,
            length_scale=0.1,
        )


SolverSettings = SurfaceSolver | DescentSolver
"""Settings of a solver of single frames."""


def surface_solver(settings: SolverSettings | None, what: str) -> SurfaceSolver:
    """The settings, or the default ones; `SettingsError` if they are those of another solver."""
    if settings is None or isinstance(settings, SurfaceSolver):
        return settings or SurfaceSolver()
    raise SettingsError(
        f"{what} was given a solver for the loss {settings.loss.value!r}; it needs the solver `surface`. "
        "Leave it at its default, or optimize each frame alone."
    )


class SolverName(StrEnum):
    """The solvers that can be named."""

    SURFACE = "surface"
    """The default: `SurfaceSolver`."""
    OCCLUDED = "occluded"
    """The same, run again without pixels that probably show an occluder."""
    ACS = "acs"
    """Attentional cosine similarity, independent of the silhouette's size."""
    ACS_REFERENCE = "acs_reference"
    """The form of the released code."""
    PAPER = "paper"
    """The paper's loss and schedule."""
    L1 = "l1"
    """Smooth L1 between predictions."""
    NONE = "none"
    """Only compares the start."""


def solver(name: SolverName | str) -> SolverSettings:
    """The solver of a name, with its default settings; `SettingsError` for another name."""
    require(name in set(SolverName), "solver", str(name), ", ".join(SolverName))
    match SolverName(name):
        case SolverName.SURFACE:
            return SurfaceSolver()
        case SolverName.OCCLUDED:
            return SurfaceSolver(stages=OCCLUDED)
        case SolverName.NONE:
            return SurfaceSolver(stages=NONE)
        case SolverName.PAPER:
            return DescentSolver.paper()
        case other:
            return DescentSolver(loss=Loss(other.value))


def _loss(value: Loss | str) -> Loss:
    require(value in set(Loss), "loss", str(value), ", ".join(Loss))
    return Loss(value)


CALIBRATION = FreeParameters(joints=False, base_frames=True, extrinsics=True)
"""Free parameters of a calibration by default."""

CALIBRATION_SETTINGS = SurfaceSolver(
    stages=CALIBRATION_STAGES,
    noise=0.5,
    normals_weight=0.0,
    frame_prior_deg=3.0,
    intrinsics_prior=0.05,
)
"""How a calibration goes about it by default. Normals are left out: where they are wrong by the same angle
in every frame (an encoder's offset, a bias of the network) frames do not average it out, and base frames follow."""
