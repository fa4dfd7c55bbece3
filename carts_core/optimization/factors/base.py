"""The protocol of factors. An objective is the sum of some of them over the same variables."""

from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Linearization:
    """A quadratic model of a factor, or of a sum of factors, around a point."""

    cost: float
    """At the point, in units of the noise [1]: a negative log likelihood up to a constant."""
    gradient: Float[Tensor, " n"]
    """Of the cost [1/rad]."""
    hessian: Float[Tensor, "n n"]
    """Gauss-Newton's approximation of the second derivative [1/rad^2]."""

    def __add__(self, other: "Linearization") -> "Linearization":
        return Linearization(self.cost + other.cost, self.gradient + other.gradient, self.hessian + other.hessian)


class Factor(Protocol):
    """A summand of an objective. `FrameOptimizer(factors=...)` adds one to a frame's; `Prior` is a short example."""

    def costs(self, offsets: Float[Tensor, "batch n"]) -> Float[Tensor, " batch"]:
        """Cost of each of a batch of points [1]."""
        ...

    def linearize(self, offsets: Float[Tensor, " n"]) -> Linearization:
        """The quadratic model around a point."""
        ...
