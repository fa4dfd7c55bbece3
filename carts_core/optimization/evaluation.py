"""What an objective says of one point, and what a solver makes of it."""

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from .observability import Uncertainty


@dataclass(frozen=True)
class Evaluation:
    """An objective at one point. Maps are at the resolution of comparison, and nothing carries autograd."""

    value: float
    """What is descended, in the stage that was asked for: the loss there, and the prior."""
    loss: float
    """Without the prior, and comparable through all stages of the same epoch."""
    prior: float
    gradient: Float[Tensor, " n"]
    """Of `value`; zero if it was not asked for."""
    curvature: Float[Tensor, "n n"] | None
    """Gauss-Newton's approximation of the second derivative of `value`; None where there is none."""
    uncertainty: Uncertainty | None
    """Standard deviations that follow from the curvature."""
    image: Float[Tensor, "cameras 3 h w"]
    """Rendered arms, RGB, black elsewhere."""
    silhouette: Float[Tensor, "cameras h w"]
    similarity: Float[Tensor, "cameras h w"]
    """At most 1; 1 where nothing was compared."""
    attention: Float[Tensor, "cameras h w"]
    """Weight of each pixel, in [0, 1]."""


class Objective(Protocol):
    """A function of the unknowns, in stages from coarse to fine."""

    stages: int

    def epoch(self, stage: int) -> int:
        """Losses compare among stages of the same epoch."""
        ...

    def __call__(self, offsets: Float[Tensor, " n"], stage: int, *, gradient: bool) -> Evaluation:
        """Evaluate at the given offsets, without a gradient if none is needed."""
        ...


class Solver(Protocol):
    """Decides where to evaluate next."""

    stage: int
    """Stage of the objective to evaluate in."""
    finished: str | None
    """Why it has stopped; None while it goes on."""

    def __call__(self, offsets: Float[Tensor, " n"], evaluation: Evaluation) -> Float[Tensor, " n"]:
        """The next offsets, from an evaluation at the present ones."""
        ...


class Stay:
    """The solver that evaluates the start and stops ("CaRTS without optimization")."""

    def __init__(self, stages: int) -> None:
        self.stage, self.finished = stages - 1, None

    def __call__(self, offsets: torch.Tensor, evaluation: Evaluation) -> torch.Tensor:
        """The same offsets."""
        self.finished = "not optimized"
        return offsets
