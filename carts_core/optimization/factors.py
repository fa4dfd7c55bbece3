"""Factors (terms of an objective), the Gaussian prior, and descent methods with bounds."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.optim.adam import adam

from ..arrays import as_array
from ..reprs import short_repr
from ..settings import DescentSolver


@dataclass(frozen=True)
class Linearization:
    """A quadratic model of a factor, or of a sum of factors, around a point."""

    cost: float
    """Cost at the point, in units of the noise [1]: a negative log likelihood up to a constant."""
    gradient: Float[Tensor, " n"]
    """Gradient of the cost [1/rad]."""
    hessian: Float[Tensor, "n n"]
    """Gauss-Newton approximation of the Hessian [1/rad^2]."""

    __repr__ = short_repr

    def __add__(self, other: "Linearization") -> "Linearization":
        return Linearization(self.cost + other.cost, self.gradient + other.gradient, self.hessian + other.hessian)


class Factor(Protocol):
    """A term of an objective. `FrameOptimizer(factors=...)` adds factors to a frame's objective; `Prior` is a short
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


_FIRST_DAMPING, _MIN_DAMPING = 1e-2, 1e-4
_SOFTER, _HARDER = 0.25, 8.0
_MAX_STEP = 0.15
"""Maximum change of an unknown in one step [rad], the range of validity of the linear model."""

REJECTIONS = 3
"""Number of consecutive rejected steps after which a descent has converged [1]."""


@dataclass(frozen=True)
class Step:
    """A proposed step."""

    change: Float[Tensor, " n"]
    reduction: float
    """Reduction of the objective predicted by its quadratic model [1]."""


class LevenbergMarquardt:
    """Levenberg-Marquardt with bounds: accepted steps lower the damping, rejected steps raise it.

    Args:
        lower, upper: bounds of the unknowns; an unknown at a bound that would leave the interval stays there.
    """

    def __init__(self, lower: Float[Tensor, " n"], upper: Float[Tensor, " n"]) -> None:
        self._lower, self._upper = lower, upper
        self._damping = _FIRST_DAMPING

    def reset(self) -> None:
        """Restore the initial damping."""
        self._damping = _FIRST_DAMPING

    def accepted(self) -> None:
        """Lower the damping after a step that lowered the objective."""
        self._damping = max(self._damping * _SOFTER, _MIN_DAMPING)

    def rejected(self) -> None:
        """Raise the damping after a step that did not lower the objective."""
        self._damping *= _HARDER

    def step(self, offsets: Float[Tensor, " n"], gradient: Float[Tensor, " n"], hessian: Float[Tensor, "n n"]) -> Step:
        """Compute a step from a point with this quadratic model."""
        slope, curvature = gradient.double(), hessian.double()
        damped = curvature + self._damping * torch.diag(curvature.diagonal().clamp(min=1e-9))
        change = shortened(bounded_step(offsets, slope, damped, self._lower, self._upper), _MAX_STEP)
        reduction = -float(slope @ change + 0.5 * change @ (curvature @ change))
        return Step(change.to(gradient), reduction)


def bounded_step(
    offsets: Float[Tensor, " n"],
    gradient: Float[Tensor, " n"],
    hessian: Float[Tensor, "n n"],
    lower: Float[Tensor, " n"],
    upper: Float[Tensor, " n"],
) -> Float[Tensor, " n"]:
    """Step to the minimum of the quadratic model over the unknowns that are not fixed at a bound.

    Args:
        offsets: current point [rad].
        lower, upper: bounds; an unknown at a bound that would leave the interval stays there.
    """
    # NumPy is faster for such small matrices.
    at, slope, curvature, least, most = map(as_array, (offsets, gradient, hessian, lower, upper))
    free = ~(((at <= least) & (slope > 0)) | ((at >= most) & (slope < 0)))
    step = np.zeros(len(slope))
    step[free] = np.linalg.solve(curvature[np.ix_(free, free)].astype(np.float64), -slope[free].astype(np.float64))
    return torch.from_numpy(step).to(gradient.device)


def shortened(step: Float[Tensor, " n"], longest: float) -> Float[Tensor, " n"]:
    """Scale down a step so that no unknown changes by more than `longest`."""
    return step * min(1.0, longest / float(step.abs().max().clamp(min=1e-12)))


class FirstOrderDescent:
    """Adam, or gradient descent with steps scaled so that the largest component equals the current step size.

    Args:
        start: initial values [rad].
    """

    def __init__(self, settings: DescentSolver, start: Tensor, lower: Tensor, upper: Tensor) -> None:
        self._lower, self._upper = lower, upper
        self._normalized = settings.method == "gradient_descent"
        self._unknowns = start.detach().clone()
        self._mean, self._square = torch.zeros_like(self._unknowns), torch.zeros_like(self._unknowns)
        self._count = torch.tensor(0.0)
        self._settings, self._rate = settings, settings.learning_rate

    @torch.no_grad()
    def step(self, gradient: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Take one step; returns the new values."""
        if self._normalized:
            gradient = gradient / gradient.abs().max().clamp(min=1e-12)
            self._unknowns.add_(gradient, alpha=-self._rate)
            self._count += 1
        else:
            adam(
                [self._unknowns],
                [gradient],
                [self._mean],
                [self._square],
                [],
                [self._count],
                amsgrad=False,
                beta1=0.9,
                beta2=0.999,
                lr=self._rate,
                weight_decay=0.0,
                eps=1e-10,
                maximize=False,
            )
        if int(self._count) % self._settings.decay_every == 0:
            self._rate *= self._settings.decay
        self._unknowns.copy_(torch.minimum(torch.maximum(self._unknowns, self._lower), self._upper))
        return self._unknowns.clone()
