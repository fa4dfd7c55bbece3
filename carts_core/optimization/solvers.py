"""Solvers: from a gradient to the next step. All share one protocol, so that the optimizer does not know which runs."""

from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from .settings import OptimizerSettings


class StepRule(Protocol):
    """Turns the gradient at the present offsets into a step."""

    def __call__(self, gradient: Float[Tensor, " n"], iteration: int) -> Float[Tensor, " n"]:
        """The step to add to the offsets; `iteration` counts from 0."""
        ...


class GradientDescent:
    """Steps down the gradient; its largest component moves by the present step size."""

    def __init__(self, settings: OptimizerSettings) -> None:
        self._settings = settings

    def __call__(self, gradient: Float[Tensor, " n"], iteration: int) -> Float[Tensor, " n"]:
        """The step to add."""
        return -step_size(self._settings, iteration) * gradient / gradient.abs().max().clamp(min=1e-12)


class Adam:
    """Adam with the paper's schedule (step size times `decay` every `decay_every` steps)."""

    def __init__(self, settings: OptimizerSettings) -> None:
        self._settings = settings
        self._mean: Tensor | None = None
        self._square: Tensor | None = None

    def __call__(self, gradient: Float[Tensor, " n"], iteration: int) -> Float[Tensor, " n"]:
        """The step to add."""
        beta_mean, beta_square = 0.9, 0.999
        if self._mean is None or self._square is None:
            self._mean, self._square = torch.zeros_like(gradient), torch.zeros_like(gradient)
        self._mean = beta_mean * self._mean + (1 - beta_mean) * gradient
        self._square = beta_square * self._square + (1 - beta_square) * gradient.square()
        mean = self._mean / (1 - beta_mean ** (iteration + 1))
        square = self._square / (1 - beta_square ** (iteration + 1))
        return -step_size(self._settings, iteration) * mean / (square.sqrt() + 1e-10)


def step_size(settings: OptimizerSettings, iteration: int) -> float:
    """Step size of an iteration [rad]."""
    return settings.learning_rate * settings.decay ** (iteration // settings.decay_every)


def make_solver(settings: OptimizerSettings) -> StepRule:
    """A fresh solver of the kind that the settings name."""
    return GradientDescent(settings) if settings.solver == "gradient_descent" else Adam(settings)
