"""Frames that fail among others are solved alone."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from short_sequence import ARM, FRAMES, Truths, optimizer

from carts_core.optimization import (
    FrameOptimizer,
    FreeParameters,
    SequenceOptimizer,
    SequenceSettings,
    SurfaceSolver,
    Verdict,
)
from carts_core.optimization.sequence_frame import Origin, SequenceFrameSolver, SingleFrameFit
from carts_core.optimization.variables import Variables
from carts_core.recording import Frame, Sequence
from carts_core.settings.stages import NONE

HELD = SequenceSettings(initial_frames=1, constant_deg=1e-3, drift_deg=1e-3, jitter_deg=1e-3)
"""Takes the measured kinematics for exact."""
OFF = np.deg2rad([2.0, -2.0, 0.0, 2.0, 2.0, -2.0, 0.0])


class Off(Truths):
    """Measures joints that are off."""

    def load(self, index: int) -> Frame:
        frame = super().load(index)
        return replace(frame, measured={ARM: (frame.truth or {})[ARM] + OFF})


@pytest.fixture(scope="module")
def made_truths(shared_sequence: Callable[..., Path]) -> Off:
    return Off(Sequence.open(shared_sequence(frames=FRAMES, width=320, height=240)))


def finished(truths: Truths, **arguments) -> SequenceOptimizer:
    sequence = optimizer(truths, model=HELD, **arguments)
    list(sequence)
    return sequence


def test_a_frame_that_fails_among_others_is_solved_alone(truths: Off) -> None:
    sequence = finished(truths)
    assert sequence.assessment is not None and sequence.assessment.verdict is Verdict.GOOD
    for index, estimate in sequence.estimates.items():
        frame = truths.load(index)
        alone = FrameOptimizer(truths.sequence.scene, frame, {}, truths, live=False)
        list(alone)
        assert alone.best is not None and estimate.assessment == alone.assessment
        np.testing.assert_array_equal(estimate.joint_positions[ARM], alone.best.joint_positions()[ARM])
        np.testing.assert_array_equal(estimate.joint_std[ARM], alone.best.joint_std()[ARM])
        assert estimate.start is Origin.COLD


def test_frames_that_fail_alone_too_keep_the_measured_joints(truths: Off, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = watched(monkeypatch)
    sequence = finished(truths, settings=SurfaceSolver(stages=NONE))
    assert tried == [0, 1, 2, 3, 4] and FRAMES > len(tried)
    assert sequence.assessment is not None and sequence.assessment.verdict is Verdict.FAILED
    for index, estimate in sequence.estimates.items():
        assert estimate.start is Origin.MEASURED
        np.testing.assert_allclose(estimate.joint_positions[ARM], truths.load(index).measured[ARM], rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", ["keyframe", "base frames"])
def test_frames_with_dependents_are_not_solved_alone(truths: Off, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    tried = watched(monkeypatch)
    if kind == "keyframe":
        sequence = finished(truths, keyframes={0: dict(truths.load(0).measured)})
    else:
        held = SurfaceSolver(frame_prior_deg=1e-3)
        sequence = finished(truths, free=FreeParameters(base_frames=True), settings=held)
    verdicts = [estimate.assessment for estimate in sequence.estimates.values()]
    assert any(verdict is not None and verdict.verdict is Verdict.FAILED for verdict in verdicts)
    assert tried == []


def watched(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Positions of the frames that are solved alone from now on."""
    tried, alone = [], SequenceFrameSolver.run_frame_stages

    def counted(solver: SequenceFrameSolver, frame: Frame, variables: Variables) -> SingleFrameFit | None:
        tried.append(frame.index)
        return alone(solver, frame, variables)

    monkeypatch.setattr(SequenceFrameSolver, "run_frame_stages", counted)
    return tried
