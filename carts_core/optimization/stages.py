"""What each stage of a solver does. The stages themselves are data: `carts_core.settings.stages`."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import singledispatch

import torch

from ..settings.stages import (
    FINEST,
    AlignEdges,
    Descend,
    Evaluate,
    FirstOrder,
    IgnoreOccluders,
    Observe,
    OtherBackground,
    PreferStart,
    RandomRestart,
    RejectFailed,
    SilhouetteSearch,
    Stage,
)
from .calibration_problem import CalibrationProblem
from .feature_problem import FeatureProblem
from .fit import Fit, Point, StopReason
from .frame_problem import FrameProblem
from .search import arm_is_lost, best_random_start, start_explains_as_well
from .solvers import FirstOrderDescent
from .solvers.levenberg_marquardt import REJECTIONS
from .verdict import Assessment, Verdict, assess


def run_stages(stages: Sequence[Stage], fit: Fit) -> Iterator[Point]:
    """Run stages one after another; yields every point that is evaluated on the way."""
    for stage in stages:
        if fit.exhausted and not isinstance(stage, RejectFailed):
            continue
        for point in run_stage(stage, fit):
            if point.improves_on(fit.best):
                fit.best = point
            yield point


@singledispatch
def run_stage(stage: object, fit: Fit) -> Iterator[Point]:
    """Run one stage; yields every point that is evaluated on the way."""
    raise TypeError(f"{stage!r} is no stage")


@run_stage.register
def run_observe(stage: Observe, fit: Fit) -> Iterator[Point]:
    """Have the surface maps predicted, conditioned on the start or on the estimate."""
    fit.problem.observe(stage, fit.offsets)
    yield from ()


@run_stage.register
def run_descend(stage: Descend, fit: Fit) -> Iterator[Point]:
    """Levenberg-Marquardt on the objective under one blur, until the predicted reduction is small."""
    # After a restart nothing is left to later stages.
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
        fit.reached = best
        # After rejections, too: the step is short then, and a next stage compares under another blur.
        fit.offsets = fit.problem.variables.clamp(best.offsets + step.change)
        fit.stop_reason = StopReason.CONVERGED if converged else StopReason.ITERATIONS
        yield point
        if converged or fit.exhausted or taken == stage.steps:
            return


@run_stage.register
def run_random_restart(stage: RandomRestart, fit: Fit) -> Iterator[Point]:
    """Where the loss is high or an arm is lost: go on from the best of random points."""
    problem = _one_frame(fit)
    if fit.loss >= stage.if_loss or arm_is_lost(problem, fit.offsets):
        fit.jump_to(best_random_start(problem, fit.offsets, stage))
        yield from run_stages(stage.then, fit)


@run_stage.register
def run_silhouette_search(stage: SilhouetteSearch, fit: Fit) -> Iterator[Point]:
    """Where given masks are far off: go on from where silhouettes are nearest to them."""
    problem = fit.problem
    assert isinstance(problem, FrameProblem | CalibrationProblem), "a stage of the surface solver"
    if problem.masked and problem.silhouette_overlap(fit.offsets, stage.scale) < stage.if_overlap:
        fit.jump_to(problem.search_silhouettes(stage))
    yield from ()


@run_stage.register
def run_align_edges(stage: AlignEdges, fit: Fit) -> Iterator[Point]:
    """Draw outlines to the image's edges, from the best point of the descent before."""
    assert fit.reached is not None, "AlignEdges follows a Descend"
    if _one_frame(fit).predictor.masked:
        # The descent has led one step beyond the best point, which nothing would evaluate before the end.
        fit.offsets = fit.reached.offsets
        return
    fit.offsets, fit.edges = _one_frame(fit).aligned(stage, fit.reached.offsets, fit.reached.evaluation)
    yield from ()


@run_stage.register
def run_prefer_start(stage: PreferStart, fit: Fit) -> Iterator[Point]:
    """Go back to the start where it explains the image as well."""
    if start_explains_as_well(_one_frame(fit), fit.offsets, stage):
        fit.offsets, fit.stop_reason = torch.zeros_like(fit.offsets), StopReason.START_KEPT
    yield from ()


@run_stage.register
def run_evaluate(stage: Evaluate, fit: Fit) -> Iterator[Point]:
    """Evaluate the estimate for the record."""
    kept, known = fit.stop_reason is StopReason.START_KEPT, fit.reached
    point = fit.evaluate(FINEST, gradient=kept)
    if known is not None and not kept:
        # Edges have no deviation of their own: that of the descent before stands.
        before = known.evaluation
        evaluation = replace(point.evaluation, gradient=before.gradient)
        if isinstance(fit.problem, FrameProblem):
            evaluation = replace(evaluation, uncertainty=fit.problem.uncertainty_after(fit.offsets, before))
        point = replace(point, evaluation=evaluation)
    # It is what counts in the end, whatever its loss, in which edges have no part.
    yield replace(point, objective_key=(*point.objective_key, "end"))


@run_stage.register
def run_other_background(stage: OtherBackground, fit: Fit) -> Iterator[Point]:
    """Where the fit failed: run again with the background treated the other way, and keep the better one."""
    problem = _one_frame(fit)
    before = problem.evidence_at(fit.offsets)
    known = assess(before)
    if before.overlap_with_change is None or known.verdict is not Verdict.FAILED or known.nothing_there:
        return
    first_run, observation = fit.snapshot(), problem.observation
    problem.treat_background_otherwise()
    fit.start_over(problem.start)
    yield from run_stages(stage.then, fit)
    after = problem.evidence_at(fit.offsets)
    overlap = after.overlap_with_change or 0.0
    better = overlap > before.overlap_with_change and assess(after).verdict is not Verdict.FAILED
    if not better:
        problem.treat_background_otherwise()
        problem.observation = observation
        fit.restore(first_run)


@run_stage.register
def run_reject_failed(stage: RejectFailed, fit: Fit) -> Iterator[Point]:
    """Judge the best point; where it failed, go back to the start if that fits better, or nothing is there."""
    problem, found = _one_frame(fit), fit.best
    if found is None:
        return
    verdict = fit.assessment = assess(problem.evidence(found.offsets, found.evaluation.loss))
    if verdict.certain or fit.stop_reason is StopReason.NOT_OPTIMIZED:
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
    """A point with deviations that allow for a wrong fit."""
    if (known := point.evaluation.uncertainty) is None:
        return point
    return replace(point, evaluation=replace(point.evaluation, uncertainty=verdict.of(known)))


@run_stage.register
def run_ignore_occluders(stage: IgnoreOccluders, fit: Fit) -> Iterator[Point]:
    """Leave out pixels that contradict the fit, and run again."""
    problem = _one_frame(fit)
    if fit.reached is not None and problem.ignore_occluders(fit.reached.evaluation):
        fit.start_over(problem.start)
        yield from run_stages(stage.then, fit)


@run_stage.register
def run_first_order(stage: FirstOrder, fit: Fit) -> Iterator[Point]:
    """Steps of a first-order method on a loss of image features."""
    problem = fit.problem
    assert isinstance(problem, FeatureProblem)
    settings, planned = problem.settings, problem.settings.iterations
    if fit.descent is None:
        variables = problem.variables
        fit.descent = FirstOrderDescent(settings, fit.offsets, variables.lower, variables.upper)
    end = min(fit.used + math.ceil(stage.share * planned), planned)
    # The point that the last step leads to is evaluated, too.
    while fit.used < end or fit.used == end == planned:
        point = fit.evaluate(stage)
        fit.losses.append(point.evaluation.loss)
        fit.offsets, fit.stop_reason = fit.descent.step(point.evaluation.gradient), StopReason.ITERATIONS
        if _stalled(fit.losses, settings.tolerance, settings.patience):
            fit.budget, fit.stop_reason = fit.used, StopReason.CONVERGED
        yield point
        if fit.exhausted:
            return


def _stalled(losses: list[float], tolerance: float, patience: int) -> bool:
    """Whether the best loss has improved by less than the tolerance over so many steps."""
    return tolerance > 0 and len(losses) > patience and min(losses[:-patience]) - min(losses) < tolerance


def _one_frame(fit: Fit) -> FrameProblem:
    assert isinstance(fit.problem, FrameProblem), "a stage for one frame"
    return fit.problem
