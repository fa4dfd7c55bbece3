"""Reported standard deviations of frames, and observability."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from perfect_predictor import PerfectPredictor
from tiny import tiny_scene
from torch.nn import functional

from carts_core.model.parts import COVERAGE
from carts_core.model.robot import Robot
from carts_core.model.scene import Scene
from carts_core.optimization import BASE_FRAME_GAIN, FrameOptimizer, FreeParameters, SurfaceSolver
from carts_core.optimization.factors import Prior
from carts_core.optimization.observability import expected_scale, uncertainty_after
from carts_core.optimization.results import Uncertainty
from carts_core.optimization.variables import Variables
from carts_core.recording import Sequence
from carts_core.settings.stages import CALIBRATION_STAGES


@pytest.fixture(scope="module")
def variables(shipped_psm: Robot) -> Variables:
    """Those of two arms' joints."""
    scene = tiny_scene(shipped_psm, 2, ("left",), 96, 72).scene
    q = np.array([0.1, 0.2, 0.15, 0.0, 0.1, -0.1, 0.3])
    return Variables(scene, scene.state({arm.name: q for arm in scene.arms}), FreeParameters(), 0.15)


def test_errors_turn_out_as_large_as_what_the_image_has_corrected() -> None:
    generator = np.random.default_rng(3)
    expected, count = 0.04, 400
    prior = torch.eye(count) / expected**2
    # The image determines two of three unknowns, each as well as it likes, and says nothing of the others.
    information = torch.diag(torch.tensor(([1e6, 2e4, 0.0] * count)[:count]))
    for size in (0.3, 1.0, 2.0):
        truth = size * expected * generator.standard_normal(count)
        noise = generator.standard_normal(count) * information.diagonal().clamp(min=1.0).rsqrt().numpy()
        pull = information @ torch.from_numpy(truth + noise * (information.diagonal() > 0).numpy()).float()
        moved = torch.linalg.solve(information + prior, pull)
        assert abs(expected_scale(moved, information, prior) - size) < 0.2 * size


def test_errors_lie_within_the_deviations_however_far_off_the_start_was(variables: Variables) -> None:
    generator = torch.Generator().manual_seed(7)
    joints, expected, start_share = len(variables.names), 0.04, 0.1
    precision = torch.eye(joints, dtype=torch.float64) / expected**2
    prior = Prior(torch.zeros(joints), precision.float())

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    sizes, errors, deviations = [], [], []
    for _ in range(1500):
        # Some directions are shown well, some no better than they are expected.
        J = torch.logspace(0, 2, joints, dtype=torch.float64)[:, None] * random(joints, joints) / expected
        information = J.T @ J
        size = float((0.5 * (random() - 0.5)).exp())
        away, noise = size * expected * random(joints), J.T @ random(joints)
        moved = torch.linalg.solve(information + precision, (1 - start_share) * information @ -away + noise)
        curvature = (information + precision).float()
        known = uncertainty_after(variables, prior, curvature, torch.zeros(joints), moved.float(), start_share)
        sizes.append(size)
        errors.append((moved + away).abs() * variables.scales)
        deviations.append(torch.tensor(known.std))
    reported, size = torch.stack(deviations), torch.tensor(sizes)
    share, wide = torch.stack(errors) / reported, reported[:, 0] > reported[:, 0].median()
    assert size[wide].mean() > 1.2 * size[~wide].mean(), "starts that are further off have wider deviations"
    for frames in (wide, ~wide):
        assert 0.64 < (share[frames] < 1).double().mean() < 0.73
        assert 0.93 < (share[frames] < 2).double().mean() < 0.97


def test_a_joint_that_the_image_determines_stays_determined_where_all_errors_turn_out_small() -> None:
    before = Uncertainty(("PSM1/yaw", "PSM1/jaw"), (0.01, 0.039), (0.04, 0.04))
    after = before.rescaled(Uncertainty(before.names, (0.008, 0.0149), (0.015, 0.015)))
    assert after.std == (0.008, 0.0149)
    assert [after.observability(name) for name in after.names] == ["determined", "not visible"]
    assert [after.doubted(0.5).observability(name) for name in after.names] == ["weak", "not visible"]


@pytest.fixture(scope="module")
def sequence(shared_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(shared_sequence(frames=1, cameras=("left",), width=320, height=240))


@pytest.fixture(scope="module")
def predictor(sequence: Sequence) -> PerfectPredictor:
    return PerfectPredictor(sequence, sequence.scene.state(sequence.frame(0).truth or {}))


def test_what_is_not_in_the_image_stays_and_is_unknown(sequence: Sequence, predictor: PerfectPredictor) -> None:
    frame = sequence.frame(0)
    truth = (frame.truth or {})["PSM1"]
    optimizer = FrameOptimizer(sequence.scene, frame, {}, predictor, settings=SurfaceSolver(prior_deg=3.0))
    list(optimizer)
    best = optimizer.best
    assert best is not None and best.uncertainty is not None
    assert best.uncertainty.observability("PSM1/yaw") == "determined"
    std = best.joint_std()["PSM1"]
    assert std.shape == truth.shape and (std > 0).all()
    assert std[2] < 0.15 * np.deg2rad(3.0), "an insertion is in metres"

    away = {"PSM1": truth + np.deg2rad([60.0, 0, 0, 0, 0, 0, 0])}
    blind = FrameOptimizer(sequence.scene, frame, {}, predictor, start=away, settings=SurfaceSolver())
    list(blind)
    assert blind.best is not None and blind.best.uncertainty is not None
    assert blind.best.uncertainty.observability("PSM1/wrist_yaw") == "not visible"
    assert np.allclose(blind.best.joint_positions()["PSM1"], away["PSM1"], atol=1e-4)


def test_outlines_that_are_all_too_far_out_are_allowed_for_in_the_deviations(sequence: Sequence) -> None:
    frame = sequence.frame(0)
    assert frame.truth is not None
    predictor = PerfectPredictor(sequence, sequence.scene.state(frame.truth))
    # A pixel at twice the working width: half a pixel, as `outline_error` says.
    predictor.maps[:, COVERAGE] = functional.max_pool2d(predictor.maps[:, COVERAGE], 3, stride=1, padding=1)
    truth = frame.truth["PSM1"]

    def errors(outline_error: float) -> np.ndarray:
        # The edges of the image itself are where they belong, and its plain grey is no smoke.
        settings = SurfaceSolver(stages=CALIBRATION_STAGES, prior_deg=3.0, dehaze=0.0, outline_error=outline_error)
        optimizer = FrameOptimizer(sequence.scene, frame, {}, predictor, start=frame.truth, settings=settings)
        list(optimizer)
        assert optimizer.best is not None
        found = optimizer.best
        return np.abs(found.joint_positions()["PSM1"] - truth) / found.joint_std()["PSM1"]

    assert errors(0.5).max() < 2
    assert errors(0.0).max() > 4, "pixels that are taken to err one by one promise too much"


def test_a_base_frame_that_no_joint_can_replace_is_suspected(sequence: Sequence, predictor: PerfectPredictor) -> None:
    frame, scene = sequence.frame(0), sequence.scene
    arm = scene.arms[0]
    T_world_base = arm.T_world_base.copy()
    T_world_base[:3, 3] += 0.0005
    wrong = replace(scene, arms=(replace(arm, T_world_base=T_world_base),))
    held = FreeParameters(locked_joints=arm.robot.joint_names[:-1])

    def run(scene: Scene, free: FreeParameters) -> FrameOptimizer:
        optimizer = FrameOptimizer(scene, frame, {}, predictor, start=frame.truth, free=free)
        assert optimizer.base_frame_gain() is None, "nothing is known before the end"
        list(optimizer)
        return optimizer

    suspected = run(wrong, held)
    gain = suspected.base_frame_gain()
    assert gain is not None and gain > 0.5
    freed = run(wrong, replace(held, base_frames=True))
    assert freed.base_frame_gain() is None, "they are free already"
    assert suspected.best is not None and freed.best is not None
    assert freed.best.loss < 0.5 * suspected.best.loss, "freeing them more than halves it indeed"


def test_base_frames_that_are_right_are_unsuspected(sequence: Sequence, predictor: PerfectPredictor) -> None:
    frame = sequence.frame(0)
    start = {"PSM1": (frame.truth or {})["PSM1"] + np.deg2rad([1.5, -1.5, 0.0, 1.5, 1.5, -1.5, 0.0])}
    optimizer = FrameOptimizer(sequence.scene, frame, {}, predictor, start=start)
    list(optimizer)
    gain = optimizer.base_frame_gain()
    assert gain is not None and abs(gain) < BASE_FRAME_GAIN
