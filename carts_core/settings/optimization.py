"""What an optimization may change, and how it goes about it."""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, get_args

from ..errors import SettingsError

Loss = Literal["surface", "acs", "acs_paper", "acs_reference", "l1"]
"""`surface`: parts and normals that the network sees against those that are rendered; the only one for Gauss-Newton.
`acs`: mean dissimilarity inside the attention map, independent of how large that is.
`acs_paper`: the paper's equation, 1 - mean(similarity x attention); falls when the silhouette grows.
`acs_reference`: mean((1 - similarity) x attention); falls when the silhouette shrinks.
`l1`: smooth L1 between the network's predictions ("CaRTS L1")."""

SolverName = Literal["auto", "gauss_newton", "adam", "gradient_descent", "none"]
"""`auto` suits the loss; `none` evaluates the start and stops ("CaRTS without optimization")."""


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
    locked_cameras: tuple[str, ...] = ()
    """Cameras whose extrinsics stay where they are."""


@dataclass(frozen=True)
class OptimizerSettings:
    """How one frame is optimized. The defaults are a measured compromise; `paper()` gives the paper's."""

    solver: SolverName = "auto"
    """Which solver; `auto` is `gauss_newton` for the loss `surface`, which alone can have it, and `adam` for others."""
    loss: Loss = "surface"
    """Which loss; see `carts_core.settings.Loss`."""
    iterations: int = 60
    """Largest number of steps [1]; `gauss_newton` mostly stops earlier by itself."""
    blurs: tuple[float, ...] = (8.0, 3.0, 1.6, 0.8)
    """`surface`: deviation of the blur of each stage, from coarse to fine [px of the working image]."""
    looks: int = 3
    """`surface`: how often the network looks at the image; each time it knows better where the arms are."""
    glance: bool = True
    """`surface`: before the first look, the network takes one at an image of three quarters of `working_width` for the
    coarsest stages, so that a good estimate is there soon."""
    zoom: float = 1.5
    """`surface`: how many times larger than the working image the compared images are, up to the camera's image [1]."""
    stage_iterations: int = 6
    """`gauss_newton`: largest number of steps in a stage [1]."""
    candidates: int = 64
    """`gauss_newton`: random starts per arm that are tried, seen in the whole image, where the first look ended badly
    or lost an arm [1]; 0 never tries, and no arm is slid along its shaft after a later look that ended doubtfully."""
    bad_loss: float = 0.045
    """`gauss_newton`: loss from which a first look counts as ended badly [1]."""
    unveil: float = 0.8
    """`surface`: share of smoke and haze that is taken off images before the network looks, and before edges are sought
    [1]; 0 leaves images as they are."""
    noise: float = 1.33
    """`surface`: deviation of the surface map that the network sees, per pixel [1]; a small value trusts the image."""
    robust: float = 0.5
    """`surface`: difference of surface maps beyond which a pixel is not believed [1]."""
    coarse_robust: float = 2.0
    """`surface`: the same in stages before the last three of `blurs`, where the image is seen near the arms only; first
    steps are longer for it; never less than `robust` [1]."""
    propose_ignore: bool = False
    """`surface`: solve a frame again, from its start and in as many steps, without areas at the arms that contradicted
    the first solution. Only where each frame is alone. It does not always help: see docs/experiments."""
    parts_weight: float = 0.1
    """`surface`: weight of the coverage of single parts beside that of the whole arm [1]."""
    normals_weight: float = 0.05
    """`surface`: weight of normals beside that [1]."""
    edge_steps: int = 24
    """`gauss_newton`: largest number of steps that draw outlines to edges of the image, before the last look and, if
    `iterations` are not used up, as a last iterate; 0 for none."""
    edge_weight: float = 0.3
    """`gauss_newton`: weight of a squared distance from an edge, per pixel of the outline [1/px^2]."""
    keep_start: float = 5.0
    """`gauss_newton`: in the last iterate, where edges are drawn, the start stays if the image prefers the estimate by
    less than this difference of the objective, and by less than a quarter [1]; 0 always moves. Only where joints alone
    are free and each frame is alone."""
    prior_deg: float = 2.5
    """`surface`: expected error of a joint position at the start [deg]; `lever` turns it into metres."""
    frame_prior_deg: float = 0.5
    """`surface`: the same of base frames and camera extrinsics [deg]."""
    intrinsics_prior: float = 0.01
    """`surface`: the same of focal lengths and principal points, as a share of the focal length [1]."""
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
    tolerance: float = 1e-2
    """`gauss_newton`: the last stage ends when no more than this share of the objective is to be gained [1]. Other
    solvers stop when the best loss has improved by less than this in `patience` steps; 0 never stops early."""
    coarse_tolerance: float = 0.06
    """`gauss_newton`: the same for stages that others follow [1]."""
    patience: int = 10
    """See `tolerance` [1]."""

    def __post_init__(self) -> None:
        _require(
            self.solver in get_args(SolverName), "solver", self.solver, f"one of {', '.join(get_args(SolverName))}"
        )
        _require(self.loss in get_args(Loss), "loss", self.loss, f"one of {', '.join(get_args(Loss))}")
        _require(1 <= self.iterations <= 10_000, "iterations", self.iterations, "1 to 10000")
        _require(1 <= self.stage_iterations <= 1000, "stage_iterations", self.stage_iterations, "1 to 1000")
        _require(0 <= self.candidates <= 10_000, "candidates", self.candidates, "0 to 10000")
        _require(0 <= self.bad_loss <= 10, "bad_loss", self.bad_loss, "0 to 10")
        _require(1 <= self.looks <= 10, "looks", self.looks, "1 to 10")
        _require(1 <= self.zoom <= 4, "zoom", self.zoom, "1 to 4")
        blurs_fall = all(0 <= fine <= coarse <= 40 for coarse, fine in pairwise((40.0, *self.blurs)))
        _require(1 <= len(self.blurs) and blurs_fall, "blurs", self.blurs, "one or more, falling, 0 to 40 px")
        _require(0 <= self.unveil <= 1, "unveil", self.unveil, "0 to 1")
        _require(1e-3 <= self.noise <= 100, "noise", self.noise, "0.001 to 100")
        _require(1e-3 <= self.robust <= 100, "robust", self.robust, "0.001 to 100")
        _require(1e-3 <= self.coarse_robust <= 100, "coarse_robust", self.coarse_robust, "0.001 to 100")
        _require(0 <= self.parts_weight <= 100, "parts_weight", self.parts_weight, "0 to 100")
        _require(0 <= self.normals_weight <= 100, "normals_weight", self.normals_weight, "0 to 100")
        _require(0 <= self.edge_steps <= 1000, "edge_steps", self.edge_steps, "0 to 1000")
        _require(0 <= self.edge_weight <= 100, "edge_weight", self.edge_weight, "0 to 100")
        _require(0 <= self.keep_start <= 1e6, "keep_start", self.keep_start, "0 to 1e6")
        _require(1e-3 <= self.prior_deg <= 360, "prior_deg", self.prior_deg, "0.001 to 360 deg")
        _require(1e-3 <= self.frame_prior_deg <= 360, "frame_prior_deg", self.frame_prior_deg, "0.001 to 360 deg")
        _require(1e-6 <= self.intrinsics_prior <= 1, "intrinsics_prior", self.intrinsics_prior, "0.000001 to 1")
        proposes = not self.propose_ignore or self.loss == "surface"
        _require(proposes, "propose_ignore", self.propose_ignore, f"False for the loss {self.loss}")
        fits = self.solver != "gauss_newton" or self.loss == "surface"
        _require(fits, "solver", self.solver, f"auto, adam, gradient_descent or none for the loss {self.loss}")
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
        _require(0 <= self.coarse_tolerance < 1, "coarse_tolerance", self.coarse_tolerance, "0 to 1")
        _require(1 <= self.patience <= 10_000, "patience", self.patience, "1 to 10000")

    @property
    def chosen_solver(self) -> SolverName:
        """The solver, with `auto` replaced by what it means for the loss."""
        if self.solver != "auto":
            return self.solver
        return "gauss_newton" if self.loss == "surface" else "adam"

    def resolved(self) -> "OptimizerSettings":
        """These settings with the solver that `auto` stands for: what is kept of a run."""
        return replace(self, solver=self.chosen_solver)

    @property
    def needs_background(self) -> bool:
        """Whether the loss compares images, which takes the mean background."""
        return self.loss != "surface"

    @property
    def draws_to_edges(self) -> bool:
        """Whether outlines are drawn to edges."""
        return self.chosen_solver == "gauss_newton" and self.edge_steps > 0 and self.edge_weight > 0

    def with_loss(self, loss: Loss) -> "OptimizerSettings":
        """These settings for another loss, with a solver that can descend it.

        Gauss-Newton gives way for a loss without residuals, and takes over again for `surface`. Ignore masks are
        proposed for `surface` only.
        """
        solver = self.solver
        if solver == "gauss_newton" or (loss == "surface" and solver != "none"):
            solver = "auto"
        return replace(self, loss=loss, solver=solver, propose_ignore=self.propose_ignore and loss == "surface")

    @staticmethod
    def acs(iterations: int = 60) -> "OptimizerSettings":
        """The paper's loss, independent of the attention's size, with a schedule that suits it better."""
        return OptimizerSettings(solver="adam", loss="acs", iterations=iterations, tolerance=0.0)

    @staticmethod
    def paper(iterations: int = 50) -> "OptimizerSettings":
        """The paper's setting: Adam at 1e-3, times 0.9 every 5 steps, its own loss, no prior.

        Lengths of its released code are decimetres (`PSM.L_rcc` is 4.389), so a step of the insertion is 1e-3 dm.
        """
        return OptimizerSettings(
            solver="adam",
            tolerance=0.0,
            loss="acs_paper",
            iterations=iterations,
            learning_rate=1e-3,
            decay=0.9,
            prior_weight=0.0,
            lever=0.1,
            wide_attention_radius=10,
            blur=0.0,
            wide_blur=0.0,
        )


def _require(condition: bool, name: str, value: object, allowed: str) -> None:
    if not condition:
        raise SettingsError(f"{name} is {value!r}; allowed is {allowed}. Change it, or leave it at its default.")
