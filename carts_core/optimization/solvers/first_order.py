"""First-order descent with the paper's schedule.

The optimizers of `torch.optim` as functions: its classes import a compiler, 820 modules that take 67 MB and 1.5 s.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.optim.adam import adam

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
        self._mean, self._square = torch.zeros_like(self._unknowns), torch.zeros_like(self._unknowns)
        self._count = torch.tensor(0.0)
        self._settings, self._rate = settings, settings.learning_rate

    @torch.no_grad()
    def step(self, gradient: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """One step; returns where it leads."""
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
