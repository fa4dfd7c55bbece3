"""Settings of frame solvers, sequence mode and calibration: free parameters, priors, noise and devices."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Literal, get_args

from ..errors import SettingsError
from .ranges import Range, Ranged, Share, require
from .stages import (
    BETWEEN,
    CALIBRATION_STAGES,
    COLD,
    FEATURES,
    FRAME,
    NONE,
    OCCLUDED,
    PAPER,
    WARM,
    WARM_WIDE,
    AlignRegions,
    FirstOrder,
    Stage,
)

Inference = Literal["auto", "torch", "onnx", "int8"]
"""Inference engine: `torch`, `onnx` (ONNX Runtime on the CPU), `int8` (the shipped network quantized to 8-bit integers,
in ONNX Runtime), or `auto` for the fastest one if results agree."""
Engine = Literal["torch", "onnx", "int8"]
"""Selected inference engine."""


Direction = Literal["forward", "backward"]
"""Direction in which corrections are propagated between frames."""


@dataclass(frozen=True)
class SequenceSettings(Ranged):
    """Sequence mode: temporal model of the measurement error (docs: explanation/sequences)."""

    constant_deg: Annotated[float, Range(1e-3, 360, "deg")] = 2.0
    """Standard deviation of the constant part of the error [deg]; `length_scale` converts it to metres."""
    drift_deg: Annotated[float, Range(1e-3, 360, "deg")] = 0.2
    """Standard deviation of the slow drift about the constant part [deg]."""
    drift_seconds: Annotated[float, Range(1e-3, 1e6, "s")] = 4.0
    """Time constant of the drift's autocorrelation [s]."""
    jitter_deg: Annotated[float, Range(1e-3, 360, "deg")] = 0.05
    """Standard deviation of the independent error of each frame [deg]."""
    measurement_noise: Annotated[float, Range(1e-3, 100)] = 4.0
    """Like `SurfaceSolver.noise`, for a frame's measurement in the smoother [1]; larger, since errors of neighbouring
    pixels are correlated."""
    correlation_seconds: Annotated[float, Range(1e-6, 1e6, "s")] = 0.5
    """Time constant of the autocorrelation of image errors [s]; frames that are closer in time have less weight for
    each other."""
    shared_seconds: Annotated[float, Range(1e-6, 1e6, "s")] = 5.0
    """Like `correlation_seconds`, for the reported standard deviations [s]; longer, since errors of the network persist
    while an instrument is seen from the same side."""
    initial_frames: Annotated[int, Range(1, 20)] = 5
    """Number of evenly spaced frames that are solved individually to initialize the first frame [1]; 1 uses only the
    first frame."""
    cold_factor: Annotated[float, Range(1, 100)] = 2.0
    """Multiple of the median loss above which a frame gets a cold start [1]."""
    direction: Direction = "forward"
    """Direction of the first pass: from the first frame, or from the last frame."""
    frame_seconds: Annotated[float, Range(1e-6, 1e6, "s")] = 0.25
    """Time between frames if the sequence has no times [s]."""
    cold: tuple[Stage, ...] = COLD
    """Stages from measured kinematics; `warm` follows."""
    warm: tuple[Stage, ...] = WARM
    """Stages from the correction predicted by the other frames."""
    wide: tuple[Stage, ...] = WARM_WIDE
    """Stages after `warm` ends with an unusual loss, before a cold start."""
    between: tuple[Stage, ...] = BETWEEN
    """`AlignRegions`, for frames without the network; empty to evaluate the network in every frame."""
    look_every: Annotated[int, Range(1, 1000)] = 3
    """Number of frames from one evaluation of the network to the next while `between` fits well [1]."""
    assess_every: Annotated[int, Range(1, 1000)] = 8
    """Number of frames from one assessment to the next while `between` fits well; verdicts of the frames in between are
    those of their neighbours [1]."""
    min_likelihood: Annotated[float, Range(-2, 2)] = 0.4
    """Mean log odds of the colours at the outlines of an arm below which the network is needed [1]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.direction in get_args(Direction), "direction", self.direction, " or ".join(get_args(Direction)))
        regions = len(self.between) <= 1 and all(isinstance(stage, AlignRegions) for stage in self.between)
        require(regions, "between", self.between, "one AlignRegions, or nothing")


class Loss(StrEnum):
    """Losses of image features."""

    ACS = "acs"
    """Mean dissimilarity inside the attention map, independent of its size."""
    ACS_PAPER = "acs_paper"
    """The paper's equation, 1 - mean(similarity x attention); it decreases when the silhouette grows."""
    ACS_REFERENCE = "acs_reference"
    """mean((1 - similarity) x attention), as in the released code; it decreases when the silhouette shrinks."""
    L1 = "l1"
    """Smooth L1 between the network's predictions ("CaRTS L1")."""


Method = Literal["adam", "gradient_descent"]
"""First-order methods."""


@dataclass(frozen=True)
class FreeParameters:
    """Free parameters of the scene; by default the joints of all arms, as in the paper."""

    joints: bool = True
    """Joint positions of the free arms."""
    base_frames: bool = False
    """Base frames of the free arms (one hand-eye error per arm)."""
    extrinsics: bool = False
    """Camera extrinsics."""
    intrinsics: bool = False
    """Focal lengths and principal points."""
    arms: tuple[str, ...] = ()
    """Names of the free arms; empty for all arms."""
    locked_joints: tuple[str, ...] = ()
    """Fixed joints, as `joint` for every arm or `arm/joint` for one arm."""
    locked_cameras: tuple[str, ...] = ()
    """Cameras with fixed extrinsics."""

    def frees(self, arm: str, joint: str) -> bool:
        """Whether a joint of an arm is free."""
        chosen = self.joints and (not self.arms or arm in self.arms)
        return chosen and joint not in self.locked_joints and f"{arm}/{joint}" not in self.locked_joints

    @property
    def joints_only(self) -> bool:
        """Whether only joints are free, without calibration parameters."""
        return not (self.base_frames or self.extrinsics or self.intrinsics)


@dataclass(frozen=True)
class SurfaceSolver(Ranged):
    """Minimizes the difference between predicted and rendered surface maps with Levenberg-Marquardt (default)."""

    stages: tuple[Stage, ...] = FRAME
    """Stages, in order of execution."""
    iterations: Annotated[int, Range(1, 10_000)] = 60
    """Maximum number of evaluations [1]; stages that are repeated from the start may use the same number again."""
    working_width: Annotated[int, Range(64, 4096, "px")] = 320
    """Width of the working image [px], to which the scales of stages refer."""
    noise: Annotated[float, Range(1e-3, 100)] = 1.33
    """Standard deviation of the predicted surface map, per pixel [1]; smaller values give the image more weight."""
    mask_noise: Annotated[float, Range(1e-3, 100)] = 0.5
    """Standard deviation of given masks, per pixel [1]."""
    parts_weight: Annotated[float, Range(0, 100)] = 0.1
    """Weight of the coverage of single parts, relative to that of the whole arm [1]."""
    normals_weight: Annotated[float, Range(0, 100)] = 0.05
    """Weight of normals, relative to the coverage of the whole arm [1]."""
    dehaze: Share = 0.8
    """Share of smoke and haze that is removed from images [1]."""
    outline_error: Annotated[float, Range(0, 100, "px")] = 0.3
    """Expected outward or inward error common to all outlines in an image [px of the working image]. It increases the
    reported standard deviations of motions along the line of sight."""
    start_share: Share = 0.1
    """Share of an error of the start that remains in the prediction of the network, which is conditioned on a rendering
    of the start [1]. It increases the reported standard deviations, but does not change estimates; it is not used with
    given masks."""
    prior_deg: Annotated[float, Range(1e-3, 360, "deg")] = 2.5
    """Expected error of a joint position at the start [deg]; `length_scale` converts it to metres."""
    frame_prior_deg: Annotated[float, Range(1e-3, 360, "deg")] = 0.5
    """Expected error of base frames and camera extrinsics [deg]; `length_scale` converts it to metres."""
    intrinsics_prior: Annotated[float, Range(1e-6, 1)] = 0.01
    """Expected error of focal lengths and principal points, as a share of the focal length [1]."""
    length_scale: Annotated[float, Range(1e-3, 10, "m")] = 0.15
    """Translation equivalent to one radian [m]: approximately the distance from the remote centre to the tip."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(len(self.stages) > 0, "stages", self.stages, "one or more")
        of_kind = not any(isinstance(stage, FirstOrder | AlignRegions) for stage in self.stages)
        require(of_kind, "stages", self.stages, "stages of the surface solver (no FirstOrder or AlignRegions)")

    @property
    def needs_background(self) -> bool:
        """Whether the solver requires a mean background."""
        return False


@dataclass(frozen=True)
class DescentSolver(Ranged):
    """Minimizes a loss between features of the image and the hybrid image (rendered arms over the mean background)."""

    loss: Loss = Loss.ACS
    """Loss to minimize."""
    method: Method = "adam"
    """First-order optimizer."""
    stages: tuple[Stage, ...] = FEATURES
    """Stages, in order of execution."""
    iterations: Annotated[int, Range(1, 10_000)] = 60
    """Planned number of steps [1]."""
    learning_rate: Annotated[float, Range(0, 1, "rad", above=True)] = 6e-3
    """Initial step size [rad]; `length_scale` converts it to metres."""
    decay: Annotated[float, Range(0, 1, above=True)] = 0.82
    """Factor applied to the step size every `decay_every` steps [1]."""
    decay_every: Annotated[int, Range(1, 10_000)] = 5
    """Steps between two decays [1]."""
    length_scale: Annotated[float, Range(1e-3, 10, "m")] = 0.15
    """Translation equivalent to one radian [m]."""
    prior_weight: Annotated[float, Range(0, 1e6)] = 0.02
    """Weight of the prior around the start [1/rad^2]."""
    working_width: Annotated[int, Range(64, 4096, "px")] = 320
    """Width of the compared images [px]."""
    tolerance: Annotated[float, Range(0, 1, below=True)] = 0.0
    """Early stopping: minimum improvement of the best loss in `patience` steps; 0 disables it."""
    patience: Annotated[int, Range(1, 10_000)] = 10
    """Number of steps for `tolerance` [1]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "loss", _loss(self.loss))
        require(self.method in get_args(Method), "method", self.method, " or ".join(get_args(Method)))
        of_kind = len(self.stages) > 0 and all(isinstance(stage, FirstOrder) for stage in self.stages)
        require(of_kind, "stages", self.stages, "one or more FirstOrder stages")

    @property
    def needs_background(self) -> bool:
        """Whether the solver requires a mean background."""
        return True

    @staticmethod
    def paper(iterations: int = 50, loss: Loss = Loss.ACS_PAPER) -> "DescentSolver":
        """The paper's settings: Adam with step size 1e-3, multiplied by 0.9 every 5 steps, the paper's loss, and no
        prior.

        Lengths in the released code are in decimetres (`PSM.L_rcc` is 4.389), so the step size of the insertion is 1e-3
        dm.
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
"""Settings of a single-frame solver."""


def surface_solver(settings: SolverSettings | None, what: str) -> SurfaceSolver:
    """Return the settings, or the defaults; `SettingsError` if they belong to another solver."""
    if settings is None or isinstance(settings, SurfaceSolver):
        return settings or SurfaceSolver()
    raise SettingsError(
        f"{what} requires the solver `surface`; given: a solver for the loss {settings.loss.value!r}. "
        "Use the default solver, or optimize each frame individually."
    )


class SolverName(StrEnum):
    """Names of the solvers."""

    SURFACE = "surface"
    """`SurfaceSolver` (default)."""
    OCCLUDED = "occluded"
    """`SurfaceSolver`, repeated without pixels of probable occluders."""
    ACS = "acs"
    """Attentional cosine similarity, normalized by the silhouette's size."""
    ACS_REFERENCE = "acs_reference"
    """ACS as in the released code."""
    PAPER = "paper"
    """The paper's loss and schedule."""
    L1 = "l1"
    """Smooth L1 difference of predictions."""
    NONE = "none"
    """Evaluation of the start only."""


def solver(name: SolverName | str) -> SolverSettings:
    """Default settings of a solver by name; `SettingsError` for an unknown name."""
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
"""Default free parameters of a calibration."""

CALIBRATION_SETTINGS = SurfaceSolver(
    stages=CALIBRATION_STAGES,
    noise=0.5,
    normals_weight=0.0,
    frame_prior_deg=3.0,
    intrinsics_prior=0.05,
)
"""Default settings of a calibration. Normals are not used, since an error common to all frames (encoder offset, network
bias) does not average out and would be absorbed by the base frames."""
