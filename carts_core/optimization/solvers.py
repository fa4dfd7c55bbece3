"""Descent methods: Levenberg-Marquardt with bounds, and first-order descent with the paper's schedule."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.optim.adam import adam

from ..settings import DescentSolver

_FIRST_DAMPING, _LEAST_DAMPING = 1e-2, 1e-4
_SOFTER, _HARDER = 0.25, 8.0
_LONGEST_STEP = 0.15
"""Largest change of an unknown in one step [rad], the range of validity of the linear model."""

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
        self._damping = max(self._damping * _SOFTER, _LEAST_DAMPING)

    def rejected(self) -> None:
        """Raise the damping after a step that did not lower the objective."""
        self._damping *= _HARDER

    def step(self, offsets: Float[Tensor, " n"], gradient: Float[Tensor, " n"], hessian: Float[Tensor, "n n"]) -> Step:
        """Compute a step from a point with this quadratic model."""
        slope, curvature = gradient.double(), hessian.double()
        damped = curvature + self._damping * torch.diag(curvature.diagonal().clamp(min=1e-9))
        change = shortened(bounded_step(offsets, slope, damped, self._lower, self._upper), _LONGEST_STEP)
        reduction = -float(slope @ change + 0.5 * change @ (curvature @ change))
        return Step(change.to(gradient), reduction)


def bounded_step(
    offsets: Float[Tensor, " n"],
    gradient: Float[Tensor, " n"],
    hessian: Float[Tensor, "n n"],
    lower: Float[Tensor, " n"],
    upper: Float[Tensor, " n"],
) -> Float[Tensor, " n"]:
    """Step to the minimum of the quadratic model over the unknowns not held at a bound.

    Args:
        offsets: current point [rad].
        lower, upper: bounds; an unknown at a bound that would leave the interval stays there.
    """
    free = ~(((offsets <= lower) & (gradient > 0)) | ((offsets >= upper) & (gradient < 0)))
    step = torch.zeros_like(gradient, dtype=torch.float64)
    step[free] = torch.linalg.solve(hessian.double()[free][:, free], -gradient.double()[free])
    return step


def shortened(step: Float[Tensor, " n"], longest: float) -> Float[Tensor, " n"]:
    """The step, scaled down so that no unknown changes by more than `longest`."""
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
