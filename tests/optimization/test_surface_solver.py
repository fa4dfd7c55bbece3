"""The surface factor and the default solver, with a predictor of the true surface maps."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from perfect_predictor import PerfectPredictor, with_stage, without

from carts_core.imaging.working_image import Window
from carts_core.networks import FeatureExtractor
from carts_core.optimization import FrameOptimizer, FreeParameters, SurfaceSolver
from carts_core.optimization.factors import Prior
from carts_core.optimization.frame_problem import FrameProblem
from carts_core.optimization.image_factors import SurfaceFactor
from carts_core.optimization.observation import FrameImages, Observation
from carts_core.optimization.variables import Variables
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence
from carts_core.settings.stages import Descend, Observe, PreferStart, RandomRestart


@pytest.fixture(scope="module")
def sequence(shared_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(shared_sequence(frames=1, cameras=("left",), width=320, height=240))


@pytest.fixture(scope="module")
def predictor(sequence: Sequence) -> PerfectPredictor:
    return PerfectPredictor(sequence, sequence.scene.state(sequence.frame(0).truth or {}))


def test_the_truth_that_the_predictor_sees_is_found(sequence: Sequence, predictor: PerfectPredictor) -> None:
    frame = sequence.frame(0)
    truth = (frame.truth or {})["PSM1"]
    start = {"PSM1": truth + np.deg2rad([1.5, -1.5, 0.0, 1.5, 1.5, -1.5, 0.0]) + [0, 0, 0.0015, 0, 0, 0, 0]}
    settings = SurfaceSolver(prior_deg=10.0)
    optimizer = FrameOptimizer(sequence.scene, frame, {}, predictor, start=start, settings=settings)
    list(optimizer)
    assert optimizer.best is not None
    found = optimizer.best.joint_positions()["PSM1"]
    # Yaw, pitch and insertion move the whole arm in the image.
    assert np.abs(found - truth)[:2].max() < np.deg2rad(0.2)
    assert abs(found - truth)[2] < 0.0006


@pytest.mark.parametrize(("degrees", "keep_start", "kept"), [(0.0, 5.0, True), (0.0, 0.0, False), (0.5, 5.0, False)])
def test_a_start_that_explains_the_image_as_well_is_kept(
    sequence: Sequence, predictor: PerfectPredictor, degrees: float, keep_start: float, kept: bool
) -> None:
    frame = sequence.frame(0)
    truth = (frame.truth or {})["PSM1"]
    start = truth + np.deg2rad(degrees) * np.array([1.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    settings = with_stage(PreferStart, improvement=keep_start) if keep_start else without(PreferStart)
    optimizer = FrameOptimizer(sequence.scene, frame, {}, predictor, start={"PSM1": start}, settings=settings)
    *_, last = list(optimizer)
    assert optimizer.best is last
    assert (optimizer.stop_reason == "start kept") == kept
    assert np.allclose(last.joint_positions()["PSM1"], start, atol=1e-6) == kept
    assert last.uncertainty is not None
    assert optimizer.base_frame_gain() is not None, "the last observation is still known"


def test_keeping_the_start_or_not_with_the_shipped_network() -> None:
    """Predictions depend on the condition, which must not affect an estimate that is kept."""
    sequence, extractor = Sequence.open(sample_sequence()), FeatureExtractor.load()
    scene = sequence.scene.with_cameras(["left"])
    frame = sequence.frame(4, cameras=["left"])
    truth = frame.truth or {}

    def run(start: dict[str, np.ndarray], chosen: SurfaceSolver | None = None) -> FrameOptimizer:
        optimizer = FrameOptimizer(scene, frame, {}, extractor, start=start, settings=chosen, live=False)
        list(optimizer)
        return optimizer

    kept = run(truth)
    assert kept.stop_reason == "start kept" and kept.best is not None
    assert all(np.allclose(kept.best.joint_positions()[arm], truth[arm], atol=1e-6) for arm in truth)
    moved, first = {**truth}, next(iter(truth))
    moved[first] = truth[first] + np.deg2rad([1.0, 1.0, 0, 0, 0, 0, 0])
    compared, never = run(moved), run(moved, without(PreferStart))
    assert compared.stop_reason == never.stop_reason != "start kept", "one arm off is reason enough"
    assert compared.best is not None and never.best is not None
    assert compared.best.loss == never.best.loss
    assert compared.base_frame_gain() == never.base_frame_gain()
    history = [progress.loss for progress in compared.history]
    compared.reset()
    assert [iterate.loss for iterate in compared] == history, "and a reset observes again"


def test_nobody_watching_changes_no_step(sequence: Sequence, predictor: PerfectPredictor) -> None:
    frame = sequence.frame(0)
    start = {"PSM1": (frame.truth or {})["PSM1"] + np.deg2rad([1.5, -1.5, 0.0, 1.5, 1.5, -1.5, 0.0])}
    runs = [FrameOptimizer(sequence.scene, frame, {}, predictor, start=start, live=live) for live in (True, False)]
    seen, unseen = map(list, runs)
    for a, b in zip(seen, unseen, strict=True):
        assert torch.equal(a.state.joint_positions[0], b.state.joint_positions[0])
        assert a.silhouette.shape[-1] >= b.silhouette.shape[-1]
    assert seen[0].silhouette.shape[-1] > unseen[0].silhouette.shape[-1], "a coarse stage is compared coarsely"
    ends = [run.best for run in runs if run.best is not None]
    assert len(ends) == 2
    assert ends[0].index == ends[1].index and ends[0].loss == ends[1].loss
    assert np.array_equal(ends[0].silhouette, ends[1].silhouette)


def test_a_missed_arm_is_searched_in_the_whole_image(sequence: Sequence, predictor: PerfectPredictor) -> None:
    frame = sequence.frame(0)
    truth = (frame.truth or {})["PSM1"]
    start = {"PSM1": truth + np.deg2rad([7.0, -7.0, 0.0, 0.0, 0.0, 0.0, 0.0])}
    ends = {}
    for candidates in (0, 64):
        settings = with_stage(RandomRestart, candidates=candidates) if candidates else without(RandomRestart)
        optimizer = FrameOptimizer(sequence.scene, frame, {}, predictor, start=start, settings=settings)
        list(optimizer)
        assert optimizer.best is not None
        ends[candidates] = np.abs(optimizer.best.joint_positions()["PSM1"] - truth)[:2].max()
    assert ends[0] > np.deg2rad(5.0), "near the start alone there is no arm"
    assert ends[64] < np.deg2rad(0.5)


def test_batched_costs_equal_single_ones(tiny_sequence: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = Sequence.open(tiny_sequence(frames=1, cameras=("left", "right"), width=320, height=240))
    frame, scene = sequence.frame(0), sequence.scene
    settings = SurfaceSolver(dehaze=0.0)
    variables = Variables(scene, scene.state(frame.measured), FreeParameters(), 0.15)
    predictor = PerfectPredictor(sequence, scene.state(frame.truth or {}))
    images = FrameImages.of(scene, frame.images, {}, settings, predictor)
    maps = Renderer(scene).surface_maps(scene.state(frame.truth or {}))
    ones = torch.ones_like(maps[:, :1])
    observation = Observation(images, Window(0, 0, 320, 240), maps, ones, ones)
    factor = SurfaceFactor(scene, variables, observation, settings, Descend(4.0))
    offsets = torch.linspace(-0.1, 0.1, 5)[:, None] * torch.ones(len(variables))
    costs = factor.costs(offsets)
    alone = [factor.compare(each).pixels / settings.noise**2 for each in offsets]
    assert costs.tolist() == pytest.approx(alone, rel=1e-4)
    assert factor.linearize(offsets[1]).cost == pytest.approx(alone[1], rel=1e-4)
    assert len({round(cost, 1) for cost in alone}) == len(alone)
    monkeypatch.setattr("carts_core.optimization.image_factors._PIXELS_AT_ONCE", 2 * factor.window.area)
    assert torch.equal(factor.costs(offsets), costs), "in parts where they are too many"


def problem_of(sequence: Sequence, predictor: PerfectPredictor, settings: SurfaceSolver | None = None) -> FrameProblem:
    frame, scene = sequence.frame(0), sequence.scene
    settings = settings or SurfaceSolver()
    variables = Variables(scene, scene.state(frame.measured), FreeParameters(), settings.length_scale)
    return FrameProblem(scene, frame.images, predictor, variables, settings, live=False)


def test_haze_lowers_weights(sequence: Sequence, predictor: PerfectPredictor, monkeypatch: pytest.MonkeyPatch) -> None:
    # This predictor sees the same through any haze, so all that changes is how much it counts.
    found = {}
    for through in (1.0, 0.5):
        monkeypatch.setattr(
            "carts_core.optimization.observation.transmission",
            lambda images, _, t=through: torch.full_like(images[:, :1], t),
        )
        problem = problem_of(sequence, predictor)
        found[through] = []
        for haze in (False, True):
            problem.observe(Observe(haze=haze), problem.start)
            found[through].append(problem.evaluate(problem.start, Descend(0.8)))
    precision = problem.prior.precision
    for clear, hazy, share in zip(found[1.0], found[0.5], (1.0, 0.5**4), strict=True):
        assert clear.hessian is not None and hazy.hessian is not None
        torch.testing.assert_close(hazy.hessian - precision, share * (clear.hessian - precision), rtol=1e-3, atol=1.0)
        torch.testing.assert_close(hazy.gradient, share * clear.gradient, rtol=1e-3, atol=1e-2)
        assert hazy.loss == pytest.approx(clear.loss, rel=1e-3), "losses compare"


def test_the_gradient_agrees_with_finite_differences(sequence: Sequence, predictor: PerfectPredictor) -> None:
    # A far robust scale makes the objective a plain sum of squares, which Gauss-Newton's gradient is exact for.
    problem, stage = problem_of(sequence, predictor), Descend(2.0, robust=100.0)
    problem.observe(Observe(margin=27, attention=27), problem.start)
    at = problem.start
    gradient = problem.evaluate(at, stage).gradient
    step = 0.005
    for index in (0, 1, 2):
        ahead, behind = at.clone(), at.clone()
        ahead[index] += step
        behind[index] -= step
        values = [problem.evaluate(offsets, stage, gradient=False).value for offsets in (ahead, behind)]
        assert float(gradient[index]) == pytest.approx((values[0] - values[1]) / (2 * step), rel=0.35)


def test_further_factors_are_added_to_the_objective(sequence: Sequence, predictor: PerfectPredictor) -> None:
    known, frame = 0.05, sequence.frame(0)

    def roll_is_known(variables: Variables) -> list[Prior]:
        precision = torch.zeros(len(variables))
        precision[variables.names.index("PSM1/roll")] = 1e7
        return [Prior(torch.full((len(variables),), known), torch.diag(precision))]

    roll = sequence.scene.arms[0].robot.joint_names.index("roll")
    start = {"PSM1": (frame.truth or {})["PSM1"]}
    found = []
    for factors in (lambda variables: (), roll_is_known):
        optimizer = FrameOptimizer(
            sequence.scene,
            frame,
            {},
            predictor,
            start=start,
            settings=without(PreferStart),
            factors=factors,
            live=False,
        )
        list(optimizer)
        assert optimizer.best is not None
        found.append(optimizer.best.joint_positions()["PSM1"][roll] - start["PSM1"][roll])
    assert abs(found[0]) < 0.02 and found[1] == pytest.approx(known, abs=2e-3)


def test_enlarged_working_images_weigh_the_same(sequence: Sequence, predictor: PerfectPredictor) -> None:
    problem = problem_of(sequence, predictor, SurfaceSolver(working_width=160))
    off = problem.start
    off[0] = 0.03
    found = {}
    for scale in (1.0, 1.5, 2.0, 4.0):
        problem.observe(Observe(scale=scale, margin=27, attention=27), off)
        found[scale] = problem.evaluate(off, Descend(0.8))
    assert [evaluation.silhouette.shape[-1] for evaluation in found.values()] == [160, 240, 320, 320]
    for scale in (1.5, 2.0, 4.0):
        assert found[scale].value == pytest.approx(found[1.0].value, rel=0.15)
        assert found[scale].loss == pytest.approx(found[1.0].loss, rel=0.15)
        assert float(found[scale].gradient[0]) == pytest.approx(float(found[1.0].gradient[0]), rel=0.15)
