"""Outlines drawn to edges of the image, weighed against what is known otherwise."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..settings.stages import AlignEdges
from .factors import Linearization
from .factors.edges import EdgeFactor
from .solvers import bounded_step

_STILL = 0.03
"""Outlines that move by no more than this have arrived [px]."""


@torch.no_grad()
def align_edges(
    edges: EdgeFactor,
    stage: AlignEdges,
    offsets: Float[Tensor, " n"],
    known: Linearization,
    coverage: Float[Tensor, "cameras rows columns"],
) -> tuple[Float[Tensor, " n"], Linearization]:
    """Minimize the sum of the edge factor and of a fixed quadratic model.

    Args:
        edges: the edge factor.
        stage: number of steps, and weight of the edges.
        offsets: where to begin.
        known: the quadratic model there of all other factors.
        coverage: of the arms as observed, see `EdgeFactor.near`.

    Returns:
        The minimum, and the quadratic model of the edges alone around it.
    """
    factor, variables, origin = edges.near(offsets, coverage, stage.weight), edges.variables, offsets
    step = torch.zeros_like(offsets)
    found = Linearization(0.0, torch.zeros_like(offsets), torch.zeros_like(known.hessian))
    for _ in range(stage.steps):
        found, before = factor.linearize(offsets), offsets
        gradient = known.gradient + known.hessian @ (before - origin) + found.gradient
        hessian = known.hessian + found.hessian
        step = bounded_step(before, gradient, hessian, variables.lower, variables.upper).to(offsets)
        offsets = variables.clamp(before + step)
        step = offsets - before
        if factor.moved_by(step) < _STILL:
            break
    return offsets, Linearization(found.cost, found.gradient + found.hessian @ step, found.hessian)
