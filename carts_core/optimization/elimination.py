"""Unknowns of one frame, eliminated from a quadratic model that shares the others with further frames."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Eliminated:
    """A quadratic model of the shared unknowns, with a frame's own ones at their best (Schur complement). On the CPU,
    in double precision."""

    gradient: Float[Tensor, " shared"]
    curvature: Float[Tensor, "shared shared"]
    """The Schur complement of the own unknowns' block."""
    _step: Float[Tensor, " own"]
    _gain: Float[Tensor, "own shared"]

    def own_step(self, shared_step: Float[Tensor, " shared"]) -> Float[Tensor, " own"]:
        """How the own unknowns move, when the shared ones move by that much."""
        return -(self._step + self._gain @ shared_step.double().cpu())


def eliminate(gradient: Float[Tensor, " n"], curvature: Float[Tensor, "n n"], own: int) -> Eliminated:
    """Eliminate the first `own` unknowns of a model; 0 leaves it as it is.

    Args:
        gradient, curvature: of the model; the block of the own unknowns is positive definite.
        own: how many unknowns belong to the frame alone.
    """
    gradient, curvature = gradient.double().cpu(), curvature.double().cpu()
    across = curvature[:own, own:]
    right = torch.cat([gradient[:own, None], across], 1)
    solved = torch.linalg.solve(curvature[:own, :own], right) if own else right
    step, gain = solved[:, 0], solved[:, 1:]
    return Eliminated(gradient[own:] - across.T @ step, curvature[own:, own:] - across.T @ gain, step, gain)
