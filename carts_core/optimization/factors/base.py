"""Interface of factors, the terms of an objective, and the Gaussian prior."""

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Linearization:
    """A quadratic model of a factor, or of a sum of factors, around a point."""

    cost: float
    """Cost at the point, in units of the noise [1]: a negative log likelihood up to a constant."""
    gradient: Float[Tensor, " n"]
    """Gradient of the cost [1/rad]."""
    hessian: Float[Tensor, "n n"]
    """Gauss-Newton approximation of the Hessian [1/rad^2]."""

    def __add__(self, other: "Linearization") -> "Linearization":
        return Linearization(self.cost + other.cost, self.gradient + other.gradient, self.hessian + other.hessian)


class Factor(Protocol):
    """A term of an objective. `FrameOptimizer(factors=...)` adds one to a frame's objective; `Prior` is a short
    example.
    """

    def costs(self, offsets: Float[Tensor, "batch n"]) -> Float[Tensor, " batch"]:
        """Costs of a batch of points [1]."""
        ...

    def linearize(self, offsets: Float[Tensor, " n"]) -> Linearization:
        """The quadratic model around a point."""
        ...


@dataclass(frozen=True)
class Prior:
    """Gaussian prior over the unknowns, which may be correlated. Implements `Factor`."""

    mean: Float[Tensor, " n"]
    """Mean [rad]."""
    precision: Float[Tensor, "n n"]
    """Inverse of the covariance [1/rad^2]."""

    @staticmethod
    def around_start(precision: Float[Tensor, " n"]) -> "Prior":
        """Prior of independent errors around 0 with the given inverse variances [1/rad^2]."""
        return Prior(torch.zeros_like(precision), torch.diag(precision))

    def costs(self, offsets: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
        """Half the squared distance from the mean, in standard deviations [1]."""
        away = offsets - self.mean
        return 0.5 * (away @ self.precision * away).sum(-1)

    def gradient(self, offsets: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Gradient of the cost [1/rad]."""
        return self.precision @ (offsets - self.mean)

    def linearize(self, offsets: Float[Tensor, " n"]) -> Linearization:
        """Quadratic model around a point; exact, since the cost is quadratic."""
        return Linearization(float(self.costs(offsets)), self.gradient(offsets), self.precision)

    @property
    def marginal_precision(self) -> Float[Tensor, " n"]:
        """Inverse variance of each unknown [1/rad^2]."""
        return 1.0 / torch.linalg.inv(self.precision.double()).diagonal().to(self.precision)
