"""What an optimization may change, and how it goes about it."""

from dataclasses import dataclass
from typing import Literal, get_args

from ..errors import SettingsError
from ..losses import Loss

Solver = Literal["adam", "gradient_descent", "none"]
"""`none` evaluates the start and stops ("CaRTS without optimization")."""


@dataclass(frozen=True)
class FreeParameters:
    """Which values of the scene are unknown. Joints of all arms by default, as in the paper."""

    joints: bool = True
    """Joint positions of the free arms."""
    base_frames: bool = False
    """Base frames of the free arms (hand-eye error seen from the arm)."""
    extrinsics: bool = False
    """Camera extrinsics."""
    intrinsics: bool = False
    """Focal lengths and principal points."""
    arms: tuple[str, ...] = ()
    """Names of the free arms; none named means all."""
    locked_joints: tuple[str, ...] = ()
    """Joints that stay where they are, as `joint` for every arm or `arm/joint` for one."""


@dataclass(frozen=True)
class OptimizerSettings:
    """How one frame is optimized. The defaults are a measured compromise; `paper()` gives the paper's."""

    solver: Solver = "adam"
    """Which solver."""
    loss: Loss = "acs"
    """Which loss; see `carts_core.losses.Loss`."""
    iterations: int = 60
    """Number of steps [1]."""
    learning_rate: float = 6e-3
    """First step size [rad]; a prismatic joint or a translation moves `lever` times as many metres."""
    decay: float = 0.82
    """Factor on the step size every `decay_every` steps [1]."""
    decay_every: int = 5
    """Steps between two decays [1]."""
    lever: float = 0.15
    """Metres of translation that count as one radian [m]: about the distance from the remote centre to the tip."""
    prior_weight: float = 0.02
    """Weight of the prior that holds unknowns at their start [1/rad^2]; what the image cannot see stays measured."""
    attention_radius: int = 10
    """Dilation of the silhouette [px of the working image]."""
    wide_attention_radius: int = 20
    """The same during the first half of the steps, for a wide basin of convergence [px of the working image]."""
    blur: float = 0.6
    """Deviation of the lens blur of the rendering before it is compared [px of the working image]. A hard edge would
    give the network a gradient that holds for the smallest of motions only."""
    wide_blur: float = 1.6
    """The same during the first half of the steps [px of the working image]."""
    working_width: int = 320
    """Width of the images that are compared [px]."""
    tolerance: float = 0.0
    """Stop when the best loss has improved by less than this in `patience` steps [1]; 0 never stops early."""
    patience: int = 10
    """See `tolerance` [1]."""

    def __post_init__(self) -> None:
        _require(self.solver in get_args(Solver), "solver", self.solver, f"one of {', '.join(get_args(Solver))}")
        _require(self.loss in get_args(Loss), "loss", self.loss, f"one of {', '.join(get_args(Loss))}")
        _require(1 <= self.iterations <= 10_000, "iterations", self.iterations, "1 to 10000")
        _require(0 < self.learning_rate <= 1, "learning_rate", self.learning_rate, "above 0, at most 1 rad")
        _require(0 < self.decay <= 1, "decay", self.decay, "above 0, at most 1")
        _require(1 <= self.decay_every <= 10_000, "decay_every", self.decay_every, "1 to 10000")
        _require(1e-3 <= self.lever <= 10, "lever", self.lever, "0.001 to 10 m")
        _require(0 <= self.prior_weight <= 1e6, "prior_weight", self.prior_weight, "0 to 1e6")
        _require(1 <= self.attention_radius <= 200, "attention_radius", self.attention_radius, "1 to 200 px")
        _require(
            self.attention_radius <= self.wide_attention_radius <= 400,
            "wide_attention_radius",
            self.wide_attention_radius,
            "attention_radius to 400 px",
        )
        _require(0 <= self.blur <= 10, "blur", self.blur, "0 to 10 px")
        _require(self.blur <= self.wide_blur <= 20, "wide_blur", self.wide_blur, "blur to 20 px")
        _require(64 <= self.working_width <= 4096, "working_width", self.working_width, "64 to 4096 px")
        _require(0 <= self.tolerance < 1, "tolerance", self.tolerance, "0 to 1")
        _require(1 <= self.patience <= 10_000, "patience", self.patience, "1 to 10000")

    @staticmethod
    def paper(iterations: int = 50) -> "OptimizerSettings":
        """The paper's setting: Adam at 1e-3, times 0.9 every 5 steps, its own loss, no prior."""
        return OptimizerSettings(
            loss="acs_paper",
            iterations=iterations,
            learning_rate=1e-3,
            decay=0.9,
            prior_weight=0.0,
            lever=1.0,
            wide_attention_radius=10,
            blur=0.0,
            wide_blur=0.0,
        )


def _require(condition: bool, name: str, value: object, allowed: str) -> None:
    if not condition:
        raise SettingsError(f"{name} is {value!r}; allowed is {allowed}. Change it, or leave it at its default.")
