"""First-order descent with the paper's schedule, by `torch.optim`."""

import torch
from jaxtyping import Float
from torch import Tensor

from ...settings import DescentSolver


class FirstOrderDescent:
    """Adam, or gradient descent whose largest component moves by the present step size.

    Args:
        settings: method and schedule.
        start: where it begins [rad].
        lower, upper: bounds.
    """

    def __init__(self, settings: DescentSolver, start: Tensor, lower: Tensor, upper: Tensor) -> None:
        self._lower, self._upper = lower, upper
        self._normalized = settings.method == "gradient_descent"
        self._unknowns = start.detach().clone()
        rate = settings.learning_rate
        if self._normalized:
            self._optimizer: torch.optim.Optimizer = torch.optim.SGD([self._unknowns], lr=rate)
        else:
            self._optimizer = torch.optim.Adam([self._unknowns], lr=rate, eps=1e-10)
        self._schedule = torch.optim.lr_scheduler.StepLR(self._optimizer, settings.decay_every, settings.decay)

    def step(self, gradient: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """One step; returns where it leads."""
        if self._normalized:
            gradient = gradient / gradient.abs().max().clamp(min=1e-12)
        self._unknowns.grad = gradient.clone()
        self._optimizer.step()
        self._schedule.step()
        self._unknowns.copy_(torch.minimum(torch.maximum(self._unknowns, self._lower), self._upper))
        return self._unknowns.clone()
