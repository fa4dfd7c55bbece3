"""Execution of a solver's stages. The stages themselves are data: `carts_core.settings.stages`."""

import math
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import singledispatch
from typing import Any, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from ..settings.stages import (
    FINEST,
    AlignEdges,
    Descend,
    Evaluate,
    FirstOrder,
    Given,
    IgnoreOccluders,
    Observe,
    PreferStart,
    RandomRestart,
    RejectFailed,
    RetryOtherBackground,
    SilhouetteSearch,
    Stage,
    first_descend,
)
from ..threads import total
from .calibration_problem import CalibrationProblem
from .factors import REJECTIONS, FirstOrderDescent, LevenbergMarquardt, Linearization
from .feature_problem import FeatureProblem
from .frame_problem import FrameProblem
from .observability import Evaluation
from .observation import MIN_AREA_RATIO
from .results import StopReason
from .variables import Variables
from .verdict import MIN_ARM_AREA, Assessment, Verdict, assess


class Problem(Protocol):
    """Optimization problem of one frame, or of many frames with a shared calibration."""

    @property
    def variables(self) -> Variables:
        """The unknowns."""
        ...

    def observe(self, stage: Observe, offsets: Float[Tensor, " n"]) -> None:
        """Make a new observation, which replaces the last one."""
        ...

    def evaluate(self, offsets: Float[Tensor, " n"], stage: Any, *, gradient: bool = True) -> Evaluation:
        """Evaluate the objective at a point, with the blur and robust scale of a stage."""
        ...

    def objective_key(self, blur: float) -> tuple[int, float]:
        """Key of the objective evaluated by a stage with this blur; losses are comparable within one key."""
        ...


@dataclass(frozen=True)
class Point:
    """An evaluated point."""

    offsets: Float[Tensor, " n"]
    evaluation: Evaluation
    objective_key: tuple[Any, ...]
    """Key of the objective; losses are comparable within one key."""

    def improves_on(self, best: "Point | None") -> bool:
        """Whether the loss is lower than the loss of the best point so far, or the losses are not comparable."""
        return best is None or self.objective_key != best.objective_key or self.evaluation.loss < best.evaluation.loss


@dataclass
class Fit:
    """State of a run, updated by each stage.

    Args:
        problem: the optimization problem.
        offsets: current estimate, initially the start.
        budget: maximum number of evaluations.
    """

    problem: Problem
    offsets: Float[Tensor, " n"]
    budget: int
    stop_reason: StopReason = StopReason.NOT_OPTIMIZED
    best: Point | None = None
    """Best point so far."""
    best_of_descent: Point | None = None
    """Best point of the last descent."""
    edges: Linearization | None = None
    """Quadratic model of the edge factor around the estimate, after `AlignEdges`."""
    hypotheses: tuple[Float[Tensor, " n"], ...] = ()
    """Further candidates of `RandomRestart`."""
    seed: int = 0
    """Seed of the random states of `RandomRestart`."""
    restarts: int = 0
    """Number of jumps of the estimate; after the first one, descents use a smaller tolerance."""
    used: int = 0
    """Number of evaluations so far."""
    solver: LevenbergMarquardt = field(init=False)
    descent: FirstOrderDescent | None = None
    """First-order optimizer, shared by consecutive `FirstOrder` stages."""
    losses: list[float] = field(default_factory=list)
    """Losses of all points of `FirstOrder` stages."""
    assessment: Assessment | None = None
    """Verdict on the result, after `RejectFailed`."""

    def __post_init__(self) -> None:
        self.solver = LevenbergMarquardt(self.problem.variables.lower, self.problem.variables.upper)

    @property
    def exhausted(self) -> bool:
        """Whether the budget of evaluations is spent."""
        return self.used >= self.budget

    @property
    def loss(self) -> float:
        """Loss of the best point of the last descent [1]; infinite before the first descent."""
        return float("inf") if self.best_of_descent is None else self.best_of_descent.evaluation.stage_loss

    def evaluate(self, stage: Descend | FirstOrder, *, gradient: bool = True) -> Point:
        """Evaluate the current estimate."""
        self.used += 1
        evaluation = self.problem.evaluate(self.offsets, stage, gradient=gradient)
        return Point(self.offsets, evaluation, (self.restarts, *self.problem.objective_key(stage.blur)))

    def jump_to(self, offsets: Float[Tensor, " n"]) -> None:
        """Replace the estimate; later descents use a smaller tolerance."""
        self.offsets, self.restarts = offsets, self.restarts + 1
        self.solver.reset()

    def start_over(self, start: Float[Tensor, " n"]) -> None:
        """Discard the estimate and restore the budget."""
        self.offsets, self.restarts, self.used = start, 0, 0
        self.best_of_descent, self.edges = None, None
        self.solver.reset()


_SUPPORT = 0.5
"""Share of an arm's silhouette observed as arm below which the arm is lost [1]."""


def arm_is_lost(problem: FrameProblem, offsets: Float[Tensor, " n"]) -> bool:
    """Whether an arm visible at the start has left the image, or most of its silhouette was not observed as arm.

    Arms of less than `MIN_ARM_AREA` at the start, and ignored pixels, are not considered.
    """
    seen, images = problem.observation, problem.observation.images
    before, after = (problem.variables.state(point) for point in (problem.start, offsets))
    start, end = (images.renderer.segment(state) for state in (before, after))
    found = seen.window.of(torch.from_numpy(end)).to(seen.maps.device)
    weight = seen.weight[:, 0]
    coverage = seen.coverage * weight
    for arm in range(len(problem.scene.arms)):
        here = found == arm
        if (start == arm).sum() < MIN_ARM_AREA * start.size:
            continue
        left = images.still_in_view(arm, (start, before), (end, after)) < MIN_AREA_RATIO
        if left or total(coverage[here]) < _SUPPORT * total(weight[here]):
            return True
    return False


@torch.no_grad()
def best_random_start(
    problem: FrameProblem,
    offsets: Float[Tensor, " n"],
    stage: RandomRestart,
    hypotheses: Sequence[Float[Tensor, " n"]] = (),
    seed: int = 0,
) -> Float[Tensor, " n"]:
    """Best of random points, drawn arm by arm and compared with a new observation of the whole image.

    Args:
        problem: one frame; its observation is replaced by that of the whole image.
        offsets: current estimate, which is a candidate, as are the start and `hypotheses`.
    """
    generator = torch.Generator().manual_seed(seed)
    deviation = stage.deviation * problem.prior.marginal_precision.rsqrt().cpu()
    problem.observe(Observe(scale=stage.scale, given=stage.given, haze=False), offsets, whole=True)
    best = offsets
    for group in problem.variables.groups:
        columns = list(group)
        drawn = torch.stack([torch.randn(len(group), generator=generator) for _ in range(stage.candidates + 1)])
        trials = best.repeat(len(drawn) + len(hypotheses) + 1, 1)
        trials[1 : len(drawn) + 1, columns] = (drawn * deviation[columns]).to(best)
        trials[1, columns] = 0.0
        for row, hypothesis in enumerate(hypotheses, len(drawn) + 1):
            trials[row, columns] = hypothesis[columns]
        trials = problem.variables.clamp(trials)
        best = trials[problem.costs(trials, first_descend(stage.then)).argmin()]
    return best


@torch.no_grad()
def start_explains_as_well(problem: FrameProblem, offsets: Float[Tensor, " n"], stage: PreferStart) -> bool:
    """Whether the start fits the edges and an observation conditioned on it as well as the estimate does.

    If the two silhouettes differ strongly, the result is False without an observation. If True, the new observation
    replaces the observation of the problem. Always False if calibration parameters are free, since their
    start is expected to be wrong.
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


def run_stages(stages: Sequence[Stage], fit: Fit) -> Iterator[Point]:
    """Run stages in order, and yield each evaluated point."""
    for stage in stages:
        if fit.exhausted and not isinstance(stage, RejectFailed):
            continue
        for point in run_stage(stage, fit):
            if point.improves_on(fit.best):
                fit.best = point
            yield point


@singledispatch
def run_stage(stage: object, fit: Fit) -> Iterator[Point]:
    """Run one stage, and yield each evaluated point."""
    raise TypeError(f"{stage!r} is not a stage")


@run_stage.register
def run_observe(stage: Observe, fit: Fit) -> Iterator[Point]:
    """Predict surface maps, conditioned on the start or on the estimate."""
    fit.problem.observe(stage, fit.offsets)
    yield from ()


@run_stage.register
def run_descend(stage: Descend, fit: Fit) -> Iterator[Point]:
    """Levenberg-Marquardt on the objective under one blur, until the predicted reduction is small."""
    # After a jump of the estimate, the tolerance is at most the default.
    tolerance = min(stage.tolerance, Descend.tolerance) if fit.restarts else stage.tolerance
    best, rejections = None, 0
    for taken in range(1, stage.steps + 1):
        point = fit.evaluate(stage)
        if best is None or point.evaluation.value < best.evaluation.value:
            if best is not None:
                fit.solver.accepted()
            best, rejections = point, 0
        else:
            fit.solver.rejected()
            rejections += 1
        known = best.evaluation
        assert known.hessian is not None
        step = fit.solver.step(best.offsets, known.gradient, known.hessian)
        converged = rejections >= REJECTIONS or step.reduction < tolerance * known.value
        fit.best_of_descent = best
        # This also applies after rejected steps, since the step is short and the next stage uses another blur.
        fit.offsets = fit.problem.variables.clamp(best.offsets + step.change)
        fit.stop_reason = StopReason.CONVERGED if converged else StopReason.ITERATIONS
        yield point
        if converged or fit.exhausted or taken == stage.steps:
            return


@run_stage.register
def run_random_restart(stage: RandomRestart, fit: Fit) -> Iterator[Point]:
    """Continue from the best of random points if the loss is high or an arm is lost."""
    problem = _one_frame(fit)
    if fit.loss >= stage.if_loss or arm_is_lost(problem, fit.offsets):
        fit.jump_to(best_random_start(problem, fit.offsets, stage, fit.hypotheses, fit.seed))
        yield from run_stages(stage.then, fit)


@run_stage.register
def run_silhouette_search(stage: SilhouetteSearch, fit: Fit) -> Iterator[Point]:
    """If silhouettes and given masks overlap little, continue from the state whose silhouettes are nearest to the
    masks."""
    problem = fit.problem
    assert isinstance(problem, FrameProblem | CalibrationProblem), "a stage of the surface solver"
    if problem.masked and problem.silhouette_overlap(fit.offsets, stage.scale) < stage.if_overlap:
        fit.jump_to(problem.search_silhouettes(stage))
    yield from ()


@run_stage.register
def run_align_edges(stage: AlignEdges, fit: Fit) -> Iterator[Point]:
    """Align outlines with image edges, from the best point of the last descent."""
    assert fit.best_of_descent is not None, "AlignEdges must follow a Descend stage"
    if _one_frame(fit).predictor.masked:
        # The estimate is one step beyond the best point, and this step has not been evaluated.
        fit.offsets = fit.best_of_descent.offsets
        return
    fit.offsets, fit.edges = _one_frame(fit).aligned(stage, fit.best_of_descent.offsets, fit.best_of_descent.evaluation)
    yield from ()


@run_stage.register
def run_prefer_start(stage: PreferStart, fit: Fit) -> Iterator[Point]:
    """Return to the start if it explains the image equally well."""
    if start_explains_as_well(_one_frame(fit), fit.offsets, stage):
        fit.offsets, fit.stop_reason = torch.zeros_like(fit.offsets), StopReason.START_KEPT
    yield from ()


@run_stage.register
def run_evaluate(stage: Evaluate, fit: Fit) -> Iterator[Point]:
    """Evaluate the estimate, without changing it."""
    kept, known = fit.stop_reason is StopReason.START_KEPT, fit.best_of_descent
    point = fit.evaluate(FINEST, gradient=kept)
    if known is not None and not kept:
        # Edges have no uncertainty model, so the uncertainty is derived from the last descent.
        before = known.evaluation
        evaluation = replace(point.evaluation, gradient=before.gradient)
        if isinstance(fit.problem, FrameProblem):
            evaluation = replace(evaluation, uncertainty=fit.problem.uncertainty_after(fit.offsets, before))
        point = replace(point, evaluation=evaluation)
    # The last evaluation is the result regardless of its loss, which does not include edges.
    yield replace(point, objective_key=(*point.objective_key, "end"))


@run_stage.register
def run_retry_other_background(stage: RetryOtherBackground, fit: Fit) -> Iterator[Point]:
    """Repeat a failed fit with the other background mode, and keep the better fit."""
    problem = _one_frame(fit)
    before = problem.evidence_at(fit.offsets)
    known = assess(before)
    if before.overlap_with_change is None or known.verdict is not Verdict.FAILED or known.nothing_there:
        return
    first_run = copy(fit)
    observation = problem.observation
    problem.toggle_background_mode()
    fit.start_over(problem.start)
    yield from run_stages(stage.then, fit)
    after = problem.evidence_at(fit.offsets)
    overlap = after.overlap_with_change or 0.0
    better = overlap > before.overlap_with_change and assess(after).verdict is not Verdict.FAILED
    if not better:
        problem.toggle_background_mode()
        problem.observation = observation
        vars(fit).update(vars(first_run))


@run_stage.register
def run_reject_failed(stage: RejectFailed, fit: Fit) -> Iterator[Point]:
    """Assess the best point; return to the start if it failed and the start fits no worse, or if no arm is visible."""
    problem, found = _one_frame(fit), fit.best
    if found is None:
        return
    verdict = fit.assessment = assess(problem.evidence(found.offsets, found.evaluation.loss))
    if verdict.negligible_risk or fit.stop_reason is StopReason.NOT_OPTIMIZED:
        return
    if verdict.verdict is Verdict.FAILED and bool(found.offsets.any()):
        estimate, fit.offsets = fit.offsets, problem.start
        start = fit.evaluate(FINEST)
        at_start = assess(problem.evidence(start.offsets, start.evaluation.loss))
        if verdict.nothing_there or at_start.probability <= verdict.probability:
            fit.stop_reason = StopReason.FAILED
            yield _judged(replace(start, objective_key=(*found.objective_key, "start")), verdict)
            return
        fit.offsets = estimate
    yield _judged(replace(found, objective_key=(*found.objective_key, "judged")), verdict)


def _judged(point: Point, verdict: Assessment) -> Point:
    """Point with standard deviations that account for a wrong fit."""
    if (known := point.evaluation.uncertainty) is None:
        return point
    return replace(point, evaluation=replace(point.evaluation, uncertainty=verdict.of(known)))


@run_stage.register
def run_ignore_occluders(stage: IgnoreOccluders, fit: Fit) -> Iterator[Point]:
    """Ignore pixels that contradict the fit, and repeat the optimization."""
    problem = _one_frame(fit)
    if fit.best_of_descent is not None and problem.ignore_occluders(fit.best_of_descent.evaluation):
        fit.start_over(problem.start)
        yield from run_stages(stage.then, fit)


@run_stage.register
def run_first_order(stage: FirstOrder, fit: Fit) -> Iterator[Point]:
    """Run steps of a first-order method on a loss of image features."""
    problem = fit.problem
    assert isinstance(problem, FeatureProblem)
    settings, planned = problem.settings, problem.settings.iterations
    if fit.descent is None:
        variables = problem.variables
        fit.descent = FirstOrderDescent(settings, fit.offsets, variables.lower, variables.upper)
    end = min(fit.used + math.ceil(stage.share * planned), planned)
    # The point after the last step is also evaluated.
    while fit.used < end or fit.used == end == planned:
        point = fit.evaluate(stage)
        fit.losses.append(point.evaluation.loss)
        fit.offsets, fit.stop_reason = fit.descent.step(point.evaluation.gradient), StopReason.ITERATIONS
        earlier = fit.losses[: -settings.patience]
        if settings.tolerance > 0 and earlier and min(earlier) - min(fit.losses) < settings.tolerance:
            fit.budget, fit.stop_reason = fit.used, StopReason.CONVERGED
        yield point
        if fit.exhausted:
            return


def _one_frame(fit: Fit) -> FrameProblem:
    assert isinstance(fit.problem, FrameProblem), "a stage for one frame"
    return fit.problem
