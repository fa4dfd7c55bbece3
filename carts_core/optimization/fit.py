"""A fit on its way: what the stages of a solver share, and pass on to each other."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol

from jaxtyping import Float
from torch import Tensor

from ..settings.stages import Descend, FirstOrder, Observe
from .evaluation import Evaluation
from .factors import Linearization
from .solvers import FirstOrderDescent, LevenbergMarquardt
from .variables import Variables
from .verdict import Assessment


class StopReason(StrEnum):
    """Why an optimization ended."""

    CONVERGED = "converged"
    ITERATIONS = "iterations"
    START_KEPT = "start kept"
    FAILED = "failed"
    """The image contradicts the estimate, so the start is kept."""
    NOT_OPTIMIZED = "not optimized"
    CANCELLED = "cancelled"


class Problem(Protocol):
    """What stages work on: one frame, or many that share a calibration."""

    @property
    def variables(self) -> Variables:
        """The unknowns."""
        ...

    def observe(self, stage: Observe, offsets: Float[Tensor, " n"]) -> None:
        """Replace the observation."""
        ...

    def evaluate(self, offsets: Float[Tensor, " n"], stage: Any, *, gradient: bool = True) -> Evaluation:
        """The objective at a point, as a stage compares it."""
        ...

    def objective_key(self, blur: float) -> tuple[int, float]:
        """Which objective a stage with this blur evaluates. Losses compare among points of the same one."""
        ...


@dataclass(frozen=True)
class Point:
    """An evaluated point."""

    offsets: Float[Tensor, " n"]
    evaluation: Evaluation
    objective_key: tuple[Any, ...]
    """Which objective was evaluated. Losses compare among points of the same one."""

    def improves_on(self, best: "Point | None") -> bool:
        """Whether it replaces the best point so far: its loss is lower, or both do not compare and it came later."""
        return best is None or self.objective_key != best.objective_key or self.evaluation.loss < best.evaluation.loss


@dataclass
class Fit:
    """The state of a run, which every stage takes up and leaves behind.

    Args:
        problem: what is solved.
        offsets: the present estimate, at first the start.
        budget: largest number of evaluations.
    """

    problem: Problem
    offsets: Float[Tensor, " n"]
    budget: int
    stop_reason: StopReason = StopReason.NOT_OPTIMIZED
    best: Point | None = None
    """The best point so far."""
    reached: Point | None = None
    """The best point of the last descent."""
    edges: Linearization | None = None
    """What edges say around the estimate, after `AlignEdges`."""
    restarts: int = 0
    """How often the estimate has jumped elsewhere; after the first time, descents stop at a smaller tolerance."""
    used: int = 0
    """Evaluations so far."""
    solver: LevenbergMarquardt = field(init=False)
    descent: FirstOrderDescent | None = None
    """Its state goes on from one `FirstOrder` to the next."""
    losses: list[float] = field(default_factory=list)
    """Of all points of `FirstOrder` stages."""
    assessment: Assessment | None = None
    """How far the result can be relied on, after `RejectFailed`."""

    def __post_init__(self) -> None:
        self.solver = LevenbergMarquardt(self.problem.variables.lower, self.problem.variables.upper)

    @property
    def exhausted(self) -> bool:
        """Whether all evaluations are used up."""
        return self.used >= self.budget

    @property
    def loss(self) -> float:
        """Of the best point of the last descent [1]; infinite before any."""
        return float("inf") if self.reached is None else self.reached.evaluation.stage_loss

    def evaluate(self, stage: Descend | FirstOrder, *, gradient: bool = True) -> Point:
        """Evaluate the present estimate."""
        self.used += 1
        evaluation = self.problem.evaluate(self.offsets, stage, gradient=gradient)
        return Point(self.offsets, evaluation, (self.restarts, *self.problem.objective_key(stage.blur)))

    def jump_to(self, offsets: Float[Tensor, " n"]) -> None:
        """Go on from elsewhere; later descents then stop at the smaller tolerance."""
        self.offsets, self.restarts = offsets, self.restarts + 1
        self.solver.reset()

    def start_over(self, start: Float[Tensor, " n"]) -> None:
        """Forget the estimate; the budget is whole again."""
        self.offsets, self.restarts, self.used = start, 0, 0
        self.reached, self.edges = None, None
        self.solver.reset()

    def snapshot(self) -> "Snapshot":
        """The estimate as it is now."""
        return Snapshot(self.offsets, self.reached, self.edges, self.stop_reason)

    def restore(self, snapshot: "Snapshot") -> None:
        """Go back to an estimate."""
        self.offsets, self.reached, self.edges = snapshot.offsets, snapshot.reached, snapshot.edges
        self.stop_reason = snapshot.stop_reason


@dataclass(frozen=True)
class Snapshot:
    """The estimate at some moment of a run."""

    offsets: Float[Tensor, " n"]
    reached: Point | None
    edges: Linearization | None
    stop_reason: StopReason
