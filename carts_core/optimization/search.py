"""Searches that a descent cannot do: random starts, and back at the start."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..settings.stages import FINEST, Given, Observe, PreferStart, RandomRestart, first_descend
from ..threads import total
from .frame_images import HAS_LEFT
from .frame_problem import FrameProblem

_SUPPORT = 0.5
"""Share of an arm's silhouette that has to be observed as an arm, or the arm is lost [1]."""


def arm_is_lost(problem: FrameProblem, offsets: Float[Tensor, " n"]) -> bool:
    """Whether an arm that was in sight at the start has left the image, or stands where no arm was observed."""
    seen, images = problem.observation, problem.observation.images
    before, after = (problem.variables.state(point) for point in (problem.start, offsets))
    start, end = (images.renderer.segment(state) for state in (before, after))
    found = seen.window.of(torch.from_numpy(end)).to(seen.maps.device)
    coverage = seen.coverage
    for arm in range(len(problem.scene.arms)):
        here = found == arm
        if not (start == arm).any():
            continue
        left = images.still_in_view(arm, (start, before), (end, after)) < HAS_LEFT
        if left or total(coverage[here]) < _SUPPORT * int(here.sum()):
            return True
    return False


@torch.no_grad()
def best_random_start(
    problem: FrameProblem, offsets: Float[Tensor, " n"], stage: RandomRestart, seed: int = 0
) -> Float[Tensor, " n"]:
    """The best of random points, arm by arm, compared with the whole image; that is observed once more for it.

    Args:
        problem: one frame; its observation is replaced by that of the whole image.
        offsets: what has been found so far; it and the start are among the candidates.
        stage: how many points, and how far apart.
        seed: of the random numbers.
    """
    generator = torch.Generator().manual_seed(seed)
    deviation = stage.deviation * problem.prior.marginal_precision.rsqrt().cpu()
    problem.observe(Observe(scale=stage.scale, given=Given.START, haze=False), offsets, whole=True)
    best = offsets
    for group in problem.variables.groups:
        columns = list(group)
        drawn = torch.stack([torch.randn(len(group), generator=generator) for _ in range(stage.candidates + 1)])
        trials = best.repeat(len(drawn) + 1, 1)
        trials[1:, columns] = (drawn * deviation[columns]).to(best)
        trials[1, columns] = 0.0
        trials = problem.variables.clamp(trials)
        best = trials[problem.costs(trials, first_descend(stage.then)).argmin()]
    return best


@torch.no_grad()
def start_explains_as_well(problem: FrameProblem, offsets: Float[Tensor, " n"], stage: PreferStart) -> bool:
    """Whether the start explains an observation that is conditioned on it as well as the estimate does, and edges, too.

    Where silhouettes differ much it does not, and nothing is observed. Where it does, that observation becomes the
    problem's. A start is never preferred where a calibration is free: that is thought to be wrong.
    """
    if problem.variables.moves_calibration:
        return False
    start, before, state = problem.start, problem.observation, problem.variables.state
    one, other = (before.images.renderer.segment(state(point)) >= 0 for point in (start, offsets))
    if 2 * int((one & other).sum()) <= stage.overlap * (int(one.sum()) + int(other.sum())):
        return False
    problem.observe(Observe(given=Given.START), offsets)
    points = torch.stack([start, offsets])
    image_costs = problem.factor(FINEST).costs(points)
    at_start, at_estimate = image_costs.tolist()
    start_objective, estimate_objective = (image_costs + problem.other_costs(points)).tolist()
    gain = start_objective - estimate_objective
    as_well = gain < stage.improvement and at_start < stage.ratio * at_estimate
    if as_well and not problem.masked:
        as_well = problem.edge_distance(start) < stage.edges * problem.edge_distance(offsets)
    if not as_well:
        problem.observation = before
    return as_well
