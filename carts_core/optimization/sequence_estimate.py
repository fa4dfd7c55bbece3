"""Estimates of the frames of a sequence, and their verdicts."""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import torch
from jaxtyping import Float

from ..model.scene import Scene, SceneState
from ..recording import Frame
from ..recording.background import spread
from ..settings import FreeParameters
from .error_model import Gaussian
from .measurement import FrameSolver, Measurement, SolvedAlone
from .observability import Uncertainty
from .variables import Variables
from .verdict import Assessment, SequenceAssessment, Verdict, assess, assess_sequence


class Origin(StrEnum):
    """Source of a frame's values."""

    WARM = "warm"
    """An optimization from the neighbour's correction."""
    COLD = "cold"
    """An optimization from the measured values."""
    KEYFRAME = "keyframe"
    """Set by hand."""
    CARRIED = "carried"
    """Predicted from the other frames; the image contradicts them and is left out."""
    MEASURED = "measured"
    """Measured values, kept because the sequence and this frame failed."""


@dataclass(frozen=True)
class FrameEstimate:
    """Estimate of one frame, given the measurements of the others."""

    index: int
    frame_id: str
    state: SceneState
    joint_positions: dict[str, Float[np.ndarray, " dofs"]]
    """Arm name -> [rad, m]."""
    joint_std: dict[str, Float[np.ndarray, " dofs"]]
    """Arm name -> standard deviation [rad, m]; 0 at a keyframe, NaN where a joint is not free."""
    uncertainty: Uncertainty
    """Standard deviations of all unknowns, with those of the prior."""
    loss: float
    """Loss of the surface factor when the frame was last solved."""
    start: Origin
    iterations: int
    """Number of optimization steps over all visits."""
    seconds: float
    """Time spent on the frame over all visits, reading included [s]."""
    assessment: Assessment | None = None
    """Verdict; None before all frames are visited."""

    def judged(self, assessment: Assessment, scene: Scene) -> "FrameEstimate":
        """The estimate with a verdict, and deviations that allow for a wrong fit.

        Deviations of keyframes stay, and those that come from other frames.
        """
        if assessment.nothing_there or self.start in (Origin.KEYFRAME, Origin.CARRIED):
            return replace(self, assessment=assessment)
        known = assessment.of(self.uncertainty)
        return replace(self, assessment=assessment, uncertainty=known, joint_std=_joint_std(known, scene))

    def solved_alone(self, scene: Scene, variables: Variables, found: SolvedAlone, seconds: float) -> "FrameEstimate":
        """The estimate replaced by the result of the single-frame solver.

        Args:
            scene: of the sequence.
            variables: the frame's unknowns.
            found: the result; its uncertainty must be known.
            seconds: additional time [s].
        """
        assert found.uncertainty is not None
        state, joints = _positions(scene, variables, found.correction)
        return replace(
            self,
            state=state,
            joint_positions=joints,
            joint_std=_joint_std(found.uncertainty, scene),
            uncertainty=found.uncertainty,
            loss=found.loss,
            start=Origin.COLD,
            iterations=self.iterations + found.iterations,
            seconds=self.seconds + seconds,
            assessment=found.assessment,
        )


@dataclass(frozen=True)
class Visit:
    """Record of a solved frame."""

    frame_id: str
    variables: Variables
    measurement: Measurement
    start: Origin
    seconds: float

    def estimate(self, scene: Scene, index: int, correction: Gaussian, prior: Gaussian) -> FrameEstimate:
        """Estimate of the frame for a correction.

        Args:
            scene: of the sequence.
            index: of the frame in its sequence.
            correction: of the measured values, with its covariance [rad].
            prior: of the correction, before any image [rad].
        """
        variables = self.variables
        state, joint_positions = _positions(scene, variables, correction.mean)
        scales = variables.scales.cpu().double().numpy()
        std, expected = (np.sqrt(known.covariance.diagonal().clip(min=0.0)) * scales for known in (correction, prior))
        uncertainty = Uncertainty(tuple(variables.names), tuple(std.tolist()), tuple(expected.tolist()))
        return FrameEstimate(
            index=index,
            frame_id=self.frame_id,
            state=state,
            joint_positions=joint_positions,
            joint_std=_joint_std(uncertainty, scene),
            uncertainty=uncertainty,
            loss=self.measurement.loss,
            start=self.start,
            iterations=self.measurement.iterations,
            seconds=self.seconds,
        )


def _joint_std(known: Uncertainty, scene: Scene) -> dict[str, Float[np.ndarray, " dofs"]]:
    return {arm.name: known.joint_std(arm.name, arm.robot.joint_names) for arm in scene.arms}


def _positions(
    scene: Scene, variables: Variables, correction: Float[np.ndarray, " n"]
) -> tuple[SceneState, dict[str, Float[np.ndarray, " dofs"]]]:
    offsets = torch.from_numpy(correction).to(variables.lower)
    state = variables.state(variables.clamp(offsets)).detached()
    joints = [values.cpu().double().numpy().copy() for values in state.joint_positions]
    return state, {arm.name: values for arm, values in zip(scene.arms, joints, strict=True)}


_LOOKED_AT = 3
"""Number of frames in which base frames are checked."""
_IN_VAIN = 5
"""Number of consecutive failures of the single-frame solver after which it is not tried again."""


def sequence_base_frame_gain(
    corrections: Mapping[int, Gaussian],
    solver: FrameSolver,
    opened: Callable[[int], tuple[Frame, Variables]],
    free: FreeParameters,
) -> float:
    """Share of the residual that free base frames would explain, median of a few frames [1].

    Args:
        corrections: position -> the correction of the measured values that was found; at least one.
        solver: of single frames.
        opened: loads the frame at a position, with its unknowns.
        free: the unknowns, by kind.
    """
    indices = sorted(corrections)
    chosen = [indices[place] for place in spread(len(indices), min(_LOOKED_AT, len(indices)))]
    return statistics.median(
        [solver.base_frame_gain(*opened(index), corrections[index].mean, free) for index in chosen]
    )


def assessed_estimates(
    estimates: Mapping[int, FrameEstimate],
    corrections: Mapping[int, Gaussian],
    scene: Scene,
    solver: FrameSolver,
    opened: Callable[[int], tuple[Frame, Variables]],
    *,
    alone: bool,
) -> Iterator[FrameEstimate]:
    """Assess estimates, then solve failed frames alone; yields each new estimate.

    Args:
        estimates: position -> final estimate.
        corrections: position -> its correction of the measured values.
        scene: of the sequence.
        solver: of single frames.
        opened: loads the frame at a position, with its unknowns.
        alone: whether failed frames are solved alone.
    """
    failed = []
    for index, estimate in estimates.items():
        began = time.perf_counter()
        frame, variables = opened(index)
        found = assess(solver.evidence(frame, variables, corrections[index].mean, estimate.loss))
        seconds = estimate.seconds + time.perf_counter() - began
        judged = replace(estimate.judged(found, scene), seconds=seconds)
        yield judged
        if found.verdict is Verdict.FAILED and not found.nothing_there:
            failed.append(judged)
    in_vain = 0
    for estimate in failed if alone else ():
        solved = _solved_alone(estimate, scene, solver, opened)
        in_vain = in_vain + 1 if solved.assessment is estimate.assessment else 0
        yield solved
        if in_vain == _IN_VAIN:
            return


def _solved_alone(
    estimate: FrameEstimate, scene: Scene, solver: FrameSolver, opened: Callable[[int], tuple[Frame, Variables]]
) -> FrameEstimate:
    """Estimate of a frame solved without the others; the given one if that fails."""
    began = time.perf_counter()
    frame, variables = opened(estimate.index)
    found = solver.alone(frame, variables)
    seconds = time.perf_counter() - began
    verdict = found and found.assessment and found.assessment.verdict
    if found is None or found.uncertainty is None or verdict in (None, Verdict.FAILED):
        return replace(estimate, seconds=estimate.seconds + seconds)
    return estimate.solved_alone(scene, variables, found, seconds)


def assessed_sequence(
    estimates: Mapping[int, FrameEstimate], visits: Mapping[int, Visit], scene: Scene, prior: Gaussian, keyframes: bool
) -> tuple[SequenceAssessment, dict[int, FrameEstimate]]:
    """Verdict on the sequence, and its estimates; if it failed, failed frames return to their measured values.

    Args:
        estimates: position -> assessed estimate; at least one.
        visits: records of the frames.
        scene: of the sequence.
        prior: of a correction, before any image.
        keyframes: whether some frames were set by hand; then all estimates stay.
    """
    found = {index: estimate.assessment for index, estimate in estimates.items() if estimate.assessment is not None}
    whole, kept = assess_sequence(list(found.values())), dict(estimates)
    if whole.verdict is Verdict.FAILED and not keyframes:
        for index, assessment in found.items():
            if assessment.verdict is Verdict.FAILED:
                measured = replace(visits[index], start=Origin.MEASURED).estimate(scene, index, prior, prior)
                kept[index] = replace(measured, assessment=assessment, seconds=estimates[index].seconds)
    return whole, kept
