"""Stages of a solver, on objectives that are known in closed form and on a predictor that is always right."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from perfect_predictor import PerfectPredictor

from carts_core.imaging.working_image import Window
from carts_core.optimization import FreeParameters
from carts_core.optimization.factors import FirstOrderDescent
from carts_core.optimization.frame_problem import FrameProblem
from carts_core.optimization.observability import Evaluation
from carts_core.optimization.stages import Fit, StopReason, best_random_start, run_stages, start_explains_as_well
from carts_core.optimization.variables import Variables
from carts_core.recording import Sequence
from carts_core.settings import DescentSolver, SurfaceSolver
from carts_core.settings import FreeParameters as Free
from carts_core.settings.stages import Descend, Evaluate, Given, Observe, PreferStart, RandomRestart, Stage


class Bowl:
    """Half the squared distance from a point, and a constant."""

    def __init__(self, variables: Variables, minimum: torch.Tensor, floor: float = 1.0) -> None:
        self.variables, self.minimum, self.floor = variables, minimum, floor
        self.observed: list[Observe] = []

    def observe(self, stage: Observe, offsets: torch.Tensor) -> None:
        self.observed.append(stage)

    def objective_key(self, blur: float) -> tuple[int, float]:
        return len(self.observed), blur

    def evaluate(self, offsets: torch.Tensor, stage: object, *, gradient: bool = True) -> Evaluation:
        slope = offsets - self.minimum
        value = self.floor + 0.5 * float(slope @ slope)
        empty = torch.zeros(1, 1, 1)
        return Evaluation(value, value, value, slope, torch.eye(len(offsets)), None, *(empty,) * 4)


@pytest.fixture(scope="module")
def variables(shared_sequence: Callable[..., Path]) -> Variables:
    sequence = Sequence.open(shared_sequence(frames=1))
    return Variables(sequence.scene, sequence.scene.state(sequence.frame(0).measured), FreeParameters(), 0.15)


def run(stages: Iterable[Stage], problem: Bowl, budget: int = 60) -> tuple[Fit, int]:
    fit = Fit(problem, torch.zeros_like(problem.variables.lower), budget)
    return fit, len(list(run_stages(tuple(stages), fit)))


def bowl(variables: Variables, promise: float) -> Bowl:
    """The first step there promises about this share of the value."""
    minimum = torch.zeros_like(variables.lower)
    minimum[0] = (2.0 * promise) ** 0.5
    return Bowl(variables, minimum)


def test_a_descent_ends_when_no_more_than_its_tolerance_is_to_be_gained(variables: Variables) -> None:
    assert run([Descend(1.0, tolerance=0.06)], bowl(variables, 0.03))[1] == 1
    fit, steps = run([Descend(1.0, tolerance=0.01)], bowl(variables, 0.03))
    assert steps > 1 and fit.stop_reason is StopReason.CONVERGED
    assert float(fit.offsets[0]) == pytest.approx(0.06**0.5, abs=0.1)


def test_no_stage_runs_when_all_evaluations_are_used_up(variables: Variables) -> None:
    problem = bowl(variables, 10.0)
    fit, steps = run([Descend(1.0, steps=3), Observe(), Descend(1.0), Observe()], problem, budget=3)
    assert steps == 3 and fit.exhausted and fit.stop_reason is StopReason.ITERATIONS
    assert problem.observed == []


def test_a_descent_never_passes_a_joint_limit(variables: Variables) -> None:
    problem = Bowl(variables, variables.upper + 1.0)
    fit, _ = run([Descend(1.0, steps=60, tolerance=0.0)], problem)
    assert (fit.offsets <= variables.upper).all()
    torch.testing.assert_close(fit.offsets, variables.upper)


def frame_fit(tiny_sequence: Callable[..., Path], free: Free, off: np.ndarray) -> Fit:
    sequence = Sequence.open(tiny_sequence(frames=1, cameras=("left",), width=320, height=240))
    frame, scene = sequence.frame(0), sequence.scene
    truth = (frame.truth or {})["PSM1"]
    predictor = PerfectPredictor(sequence, scene.state({"PSM1": truth}))
    settings = SurfaceSolver(dehaze=0.0)
    state = scene.state({"PSM1": truth + off})
    variables = Variables(scene, state, free, settings.length_scale)
    problem = FrameProblem(scene, frame.images, predictor, variables, settings, live=False)
    return Fit(problem, problem.start, settings.iterations)


def test_conditioning_on_start_or_estimate(tiny_sequence: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    predict = PerfectPredictor.predict

    def watched(own: PerfectPredictor, images: torch.Tensor, maps: torch.Tensor, window: Window) -> torch.Tensor:
        given.append(maps)
        return predict(own, images, maps, window)

    monkeypatch.setattr(PerfectPredictor, "predict", watched)
    fit = frame_fit(tiny_sequence, Free(), np.deg2rad([2.0, -2.0, 0, 0, 0, 0, 0]))
    list(run_stages((Observe(), Descend(8.0), Observe(given=Given.START), Observe()), fit))
    assert torch.equal(given[0], given[1])
    assert not torch.equal(given[0], given[2])


def test_a_prediction_from_the_image_alone(tiny_sequence: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    given, windows = [], []
    predict = PerfectPredictor.predict

    def watched(own: PerfectPredictor, images: torch.Tensor, maps: torch.Tensor, window: Window) -> torch.Tensor:
        given.append(maps)
        windows.append(window)
        return predict(own, images, maps, window)

    monkeypatch.setattr(PerfectPredictor, "predict", watched)
    fit = frame_fit(tiny_sequence, Free(), np.zeros(7))
    list(run_stages((Observe(), Observe(given=Given.NOTHING)), fit))
    assert given[0].any() and not given[1].any()
    assert windows[0] == windows[1], "the window is that of the estimate"


def test_a_random_restart_compares_given_hypotheses(tiny_sequence: Callable[..., Path]) -> None:
    off = np.deg2rad([4.0, -4.0, 0, 0, 0, 0, 0])
    restart = RandomRestart(then=(Descend(8.0),), candidates=1)
    fit = frame_fit(tiny_sequence, Free(), off)
    assert isinstance(fit.problem, FrameProblem)
    right = -torch.from_numpy(off).to(fit.offsets)
    wrong = torch.full_like(right, 0.2)
    assert torch.equal(best_random_start(fit.problem, fit.offsets, restart, (wrong, right)), right)


def test_a_random_restart_happens_only_where_the_fit_is_bad(tiny_sequence: Callable[..., Path]) -> None:
    restart = RandomRestart(then=(Descend(8.0),), candidates=4)
    fit = frame_fit(tiny_sequence, Free(), np.zeros(7))
    list(run_stages((Observe(), Descend(3.0), restart), fit))
    assert fit.restarts == 0
    again = frame_fit(tiny_sequence, Free(), np.zeros(7))
    list(run_stages((Observe(), Descend(3.0), replace(restart, if_loss=0.0)), again))
    assert again.restarts == 1


def test_a_start_that_edges_contradict_is_not_preferred(tiny_sequence: Callable[..., Path]) -> None:
    def kept(off: np.ndarray, edges: float) -> bool:
        fit = frame_fit(tiny_sequence, Free(), off)
        assert isinstance(fit.problem, FrameProblem)
        fit.problem.observe(Observe(), fit.offsets)
        right = -torch.from_numpy(off).to(fit.offsets)
        # Neither the gain nor the ratio of what the network says counts here.
        says_nothing = PreferStart(improvement=1e6, ratio=100.0, overlap=0.5, edges=edges)
        return start_explains_as_well(fit.problem, right, says_nothing)

    off = np.deg2rad([0.7, -0.7, 0, 0, 0, 0, 0])
    assert kept(off, edges=100.0) and not kept(off, edges=PreferStart.edges)
    assert kept(np.zeros(7), edges=PreferStart.edges), "it is where the estimate is"


def test_the_start_is_never_preferred_where_a_calibration_is_free(tiny_sequence: Callable[..., Path]) -> None:
    stages = (Observe(), Descend(0.8), PreferStart(), Evaluate())
    for free, reason in ((Free(), StopReason.START_KEPT), (Free(base_frames=True), StopReason.CONVERGED)):
        fit = frame_fit(tiny_sequence, free, np.zeros(7))
        list(run_stages(stages, fit))
        assert fit.stop_reason is reason


@pytest.mark.parametrize("method", ["adam", "gradient_descent"])
def test_first_order_descent_takes_the_steps_of_torch(method: Literal["adam", "gradient_descent"]) -> None:
    rate, chance = 0.01, torch.Generator().manual_seed(0)
    start = torch.randn(20, generator=chance)
    settings = DescentSolver(method=method, learning_rate=rate, decay=0.9, decay_every=7)
    descent = FirstOrderDescent(settings, start, start - 0.1, start + 0.1)
    at = start.clone()
    theirs = torch.optim.Adam([at], lr=rate, eps=1e-10) if method == "adam" else torch.optim.SGD([at], lr=rate)
    schedule = torch.optim.lr_scheduler.StepLR(theirs, 7, 0.9)
    for _ in range(30):
        gradient = torch.randn(20, generator=chance)
        at.grad = gradient if method == "adam" else gradient / gradient.abs().max()
        theirs.step()
        schedule.step()
        at.clamp_(start - 0.1, start + 0.1)
        assert torch.equal(descent.step(gradient), at)
