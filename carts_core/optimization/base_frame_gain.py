"""Whether base frames are probably wrong: what free ones would explain of the residual that joints leave."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..settings import FreeParameters
from ..settings.stages import Descend
from .factors.surface import SurfaceFactor
from .frame_problem import FrameProblem
from .solvers import bounded_step
from .variables import Variables

BASE_FRAME_GAIN = 0.12
"""Base frames are suspected if, free, they would explain at least this share of the remaining difference [1]."""

_BLUR = 3.0
"""Under which the linear model is made: it reaches about as far as the blur [px of the working image]."""


@torch.no_grad()
def base_frame_gain(problem: FrameProblem, offsets: Float[Tensor, " n"], free: FreeParameters) -> float:
    """Share of the surface residual at a point that free base frames would explain [1].

    What the present unknowns alone would still explain does not count, and a joint at its limit stays there.

    Args:
        problem: one frame.
        offsets: the point.
        free: the present unknowns.
    """
    settings, own = problem.settings, problem.variables
    wider = Variables(problem.scene, own.start, replace(free, base_frames=True), settings.length_scale)
    columns = [wider.names.index(name) for name in own.names]
    point = torch.zeros_like(wider.lower).index_copy(0, torch.tensor(columns, device=offsets.device), offsets)
    factor = SurfaceFactor(problem.scene, wider, problem.observation, settings, blur=_BLUR, robust=Descend.robust)
    surface = factor.linearize(point)
    total = wider.prior(settings).linearize(point) + surface
    gradient, hessian = surface.gradient.double(), surface.hessian.double()
    explained = []
    for unknowns in (list(range(len(wider))), columns):
        part = torch.tensor(unknowns, device=offsets.device)
        step = torch.zeros_like(gradient)
        step[part] = bounded_step(
            point[part],
            total.gradient.double()[part],
            total.hessian.double()[part][:, part],
            wider.lower[part],
            wider.upper[part],
        )
        explained.append(-float(gradient @ step + 0.5 * step @ hessian @ step))
    return (explained[0] - explained[1]) / max(surface.cost, 1e-12)
