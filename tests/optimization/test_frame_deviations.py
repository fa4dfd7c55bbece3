"""What the default solver says of its own result: deviations, what an image cannot determine, wrong base frames."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from perfect_predictor import PerfectPredictor
from torch.nn import functional

from carts_core.model.parts import COVERAGE
from carts_core.model.scene import Scene
from carts_core.optimization import BASE_FRAME_GAIN, FrameOptimizer, FreeParameters, SurfaceSolver
from carts_core.recording import Sequence
from carts_core.settings.stages import CALIBRATION_STAGES


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(tiny_sequence(frames=1, cameras=("left",), width=320, height=240))


@pytest.fixture
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


def test_outlines_that_are_all_too_far_out_are_allowed_for_in_the_deviations(
    sequence: Sequence,
) -> None:
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


def test_joints_that_explain_the_image_leave_base_frames_unsuspected(
    sequence: Sequence, predictor: PerfectPredictor
) -> None:
    frame = sequence.frame(0)
    start = {"PSM1": (frame.truth or {})["PSM1"] + np.deg2rad([1.5, -1.5, 0.0, 1.5, 1.5, -1.5, 0.0])}
    optimizer = FrameOptimizer(sequence.scene, frame, {}, predictor, start=start)
    list(optimizer)
    gain = optimizer.base_frame_gain()
    assert gain is not None and abs(gain) < BASE_FRAME_GAIN
