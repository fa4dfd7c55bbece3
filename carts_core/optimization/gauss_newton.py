"""Damped Gauss-Newton (Levenberg-Marquardt), coarse to fine."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..settings import OptimizerSettings
from .evaluation import Evaluation
from .parameters import ParameterVector

_FIRST_DAMPING, _LEAST_DAMPING = 1e-2, 1e-4
_SOFTER, _HARDER = 0.25, 8.0
_REJECTIONS = 3
_LONGEST_STEP = 0.15
"""Largest change of an unknown in one step [rad]; beyond it the linear model means nothing."""


class GaussNewton:
    """Solves for the step that the linear model says is best, and believes it as far as it has proved right.

    A stage ends when the model promises no more than `tolerance` of the objective (`coarse_tolerance` where another one
    follows and it never had to begin again), or after `stage_iterations`.
    """

    def __init__(self, settings: OptimizerSettings, parameters: ParameterVector, stages: int) -> None:
        self._settings, self._parameters, self._stages = settings, parameters, stages
        self.stage = 0
        self.finished: str | None = None
        self._damping, self._enough = _FIRST_DAMPING, settings.coarse_tolerance
        self._iterations = 0
        self._begin_stage()

    def restart(self, stage: int) -> None:
        """Begin again with a stage, with more care than before; iterations go on counting."""
        self.stage, self.finished, self._damping = stage, None, _FIRST_DAMPING
        self._enough = min(self._enough, self._settings.tolerance)
        self._begin_stage()

    def _begin_stage(self) -> None:
        self._accepted: tuple[Tensor, Evaluation] | None = None
        self._evaluations = self._rejections = 0

    def __call__(self, offsets: Float[Tensor, " n"], evaluation: Evaluation) -> Float[Tensor, " n"]:
        """The next offsets to try."""
        self._iterations += 1
        self._evaluations += 1
        if self._accepted is None or evaluation.value < self._accepted[1].value:
            if self._accepted is not None:
                self._damping = max(self._damping * _SOFTER, _LEAST_DAMPING)
            self._accepted, self._rejections = (offsets, evaluation), 0
        else:
            self._damping *= _HARDER
            self._rejections += 1
        offsets, evaluation = self._accepted
        step, promised = self._step(evaluation)
        settings, last = self._settings, self.stage == self._stages - 1
        enough = (settings.tolerance if last else self._enough) * evaluation.value
        converged = promised < enough or self._rejections >= _REJECTIONS
        if converged or self._evaluations >= settings.stage_iterations:
            if last:
                self.finished = "converged" if converged else "iterations"
            else:
                self.stage += 1
                self._begin_stage()
        if self._iterations >= self._settings.iterations:
            self.finished = self.finished or "iterations"
        if self._rejections >= _REJECTIONS:
            return offsets
        return self._parameters.clamp(offsets + step)

    def _step(self, evaluation: Evaluation) -> tuple[Tensor, float]:
        """The damped step and by how much it is expected to lower the objective."""
        assert evaluation.curvature is not None
        curvature, gradient = evaluation.curvature.double(), evaluation.gradient.double()
        damped = curvature + self._damping * torch.diag(curvature.diagonal().clamp(min=1e-9))
        step = torch.linalg.solve(damped, -gradient)
        step = step * min(1.0, _LONGEST_STEP / float(step.abs().max().clamp(min=1e-12)))
        promised = -float(gradient @ step + 0.5 * step @ (curvature @ step))
        return step.to(evaluation.gradient), promised
