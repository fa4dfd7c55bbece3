"""The steps of Gauss-Newton, and when a stage is over."""

from collections.abc import Callable
from pathlib import Path

import torch

from carts_core.data import Sequence
from carts_core.optimization import FreeParameters, OptimizerSettings
from carts_core.optimization.evaluation import Evaluation
from carts_core.optimization.gauss_newton import GaussNewton
from carts_core.optimization.parameters import ParameterVector


def test_after_a_restart_coarse_stages_end_as_late_as_fine_ones(tiny_sequence: Callable[..., Path]) -> None:
    sequence = Sequence.open(tiny_sequence(frames=1))
    state = sequence.scene.state(sequence.frame(0).measured)
    parameters = ParameterVector(sequence.scene, state, FreeParameters(), 0.15)
    offsets = torch.zeros(len(parameters))
    slope = torch.zeros_like(offsets)
    slope[0] = 0.06**0.5  # of a value of 1 the model then promises a fortieth
    empty = torch.zeros(1, 1, 1)
    evaluation = Evaluation(1.0, 1.0, 0.0, slope, torch.eye(len(offsets)), None, *(empty,) * 4)
    solver = GaussNewton(OptimizerSettings(coarse_tolerance=0.06, tolerance=0.01), parameters, 3)
    solver(offsets, evaluation)
    assert solver.stage == 1
    solver.restart(1)
    solver(offsets, evaluation)
    assert solver.stage == 1
