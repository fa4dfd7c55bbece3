"""Solvers that only need a gradient, with the paper's schedule."""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor

from ..settings import OptimizerSettings
from .evaluation import Evaluation, Solver, Stay
from .gauss_newton import GaussNewton
from .parameters import ParameterVector

_FINE_FROM = 0.5
"""Share of the iterations after which the objective's last stage begins."""


class _Descent(ABC):
    """Steps of a planned size, coarse stages first, for a planned number of iterations."""

    def __init__(self, settings: OptimizerSettings, parameters: ParameterVector, stages: int) -> None:
        self._settings, self._parameters, self._stages = settings, parameters, stages
        self._losses: list[float] = []
        self.stage = 0
        self.finished: str | None = None

    @abstractmethod
    def _direction(self, gradient: Float[Tensor, " n"], iteration: int) -> Float[Tensor, " n"]:
        """A step of about unit size."""

    def __call__(self, offsets: Float[Tensor, " n"], evaluation: Evaluation) -> Float[Tensor, " n"]:
        """One step down the gradient."""
        iteration = len(self._losses)
        self._losses.append(evaluation.loss)
        step = -step_size(self._settings, iteration) * self._direction(evaluation.gradient, iteration)
        planned = self._settings.iterations
        self.stage = min(int((iteration + 1) / (_FINE_FROM * planned) * (self._stages - 1)), self._stages - 1)
        self.finished = "iterations" if iteration >= planned else self._stalled()
        return self._parameters.clamp(offsets + step)

    def _stalled(self) -> str | None:
        losses, patience, tolerance = self._losses, self._settings.patience, self._settings.tolerance
        if tolerance > 0 and len(losses) > patience and min(losses[:-patience]) - min(losses) < tolerance:
            return "converged"
        return None


class GradientDescent(_Descent):
    """Steps down the gradient; its largest component moves by the present step size."""

    def _direction(self, gradient: Float[Tensor, " n"], iteration: int) -> Float[Tensor, " n"]:
        return gradient / gradient.abs().max().clamp(min=1e-12)


class Adam(_Descent):
    """Adam with the paper's schedule (step size times `decay` every `decay_every` steps)."""

    _mean: Tensor | None = None
    _square: Tensor | None = None

    def _direction(self, gradient: Float[Tensor, " n"], iteration: int) -> Float[Tensor, " n"]:
        beta_mean, beta_square = 0.9, 0.999
        if self._mean is None or self._square is None:
            self._mean, self._square = torch.zeros_like(gradient), torch.zeros_like(gradient)
        self._mean = beta_mean * self._mean + (1 - beta_mean) * gradient
        self._square = beta_square * self._square + (1 - beta_square) * gradient.square()
        mean = self._mean / (1 - beta_mean ** (iteration + 1))
        square = self._square / (1 - beta_square ** (iteration + 1))
        return mean / (square.sqrt() + 1e-10)


def step_size(settings: OptimizerSettings, iteration: int) -> float:
    """Step size of an iteration [rad]."""
    return settings.learning_rate * settings.decay ** (iteration // settings.decay_every)


def make_solver(settings: OptimizerSettings, parameters: ParameterVector, stages: int) -> Solver:
    """A fresh solver of the kind that the settings name."""
    name = settings.chosen_solver
    if name == "none":
        return Stay(stages)
    kinds = {"gauss_newton": GaussNewton, "adam": Adam, "gradient_descent": GradientDescent}
    return kinds[name](settings, parameters, stages)
