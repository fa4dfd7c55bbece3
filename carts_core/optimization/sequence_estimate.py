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
    """Where a frame's values come from."""

    WARM = "warm"
    """An optimization from the neighbour's correction."""
    COLD = "cold"
    """An optimization from the measured values."""
    KEYFRAME = "keyframe"
    """A person."""
    CARRIED = "carried"
    """The other frames alone: the image contradicts them and is left out."""
    MEASURED = "measured"
    """Nobody: the sequence failed, and so did this frame of it."""


@dataclass(frozen=True)
class FrameEstimate:
    """One frame of a sequence, given the measurements of the others."""

    index: int
    frame_id: str
    state: SceneState
    joint_positions: dict[str, Float[np.ndarray, " dofs"]]
    """Arm name -> [rad, m]."""
    joint_std: dict[str, Float[np.ndarray, " dofs"]]
    """Arm name -> standard deviation [rad, m]; 0 at a keyframe, NaN where a joint is not free."""
    uncertainty: Uncertainty
    """Of every unknown, with what was expected of it before any image."""
    loss: float
    """Of the surface factor, when the frame was last solved; high where the image does not fit."""
    start: Origin
    iterations: int
    """Steps of the optimization, over all visits."""
    seconds: float
    """Time spent on the frame, reading included, over all visits [s]."""
    assessment: Assessment | None = None
    """How far it can be relied on; None before all frames were visited."""

    def judged(self, assessment: Assessment, scene: Scene) -> "FrameEstimate":
        """The same with a verdict, and deviations that allow for a wrong fit.

        Those that a person gave stay, and those that come from other frames, because this image shows nothing of an arm
        or was left out.
        """
        if assessment.nothing_there or self.start in (Origin.KEYFRAME, Origin.CARRIED):
            return replace(self, assessment=assessment)
        known = assessment.of(self.uncertainty)
        return replace(self, assessment=assessment, uncertainty=known, joint_std=_joint_std(known, scene))

    def solved_alone(self, scene: Scene, variables: Variables, found: SolvedAlone, seconds: float) -> "FrameEstimate":
        """The same frame without the others, and with the verdict on that.

        Args:
            scene: of the sequence.
            variables: the frame's unknowns.
            found: their values and deviations, which must be known, and the verdict.
            seconds: that it has taken, on top of those before [s].
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
    """What is kept of a frame that was solved."""

    frame_id: str
    variables: Variables
    measurement: Measurement
    start: Origin
    seconds: float

    def estimate(self, scene: Scene, index: int, correction: Gaussian, prior: Gaussian) -> FrameEstimate:
        """The frame with a correction.

        Args:
            scene: of the sequence.
            index: of the frame in its sequence.
            correction: of the measured values, with its covariance [rad].
            prior: what was expected of it before any image [rad].
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
"""Frames that tell whether base frames are off."""
_IN_VAIN = 5
"""Frames in a row that fail alone as well, after which no more are tried."""


def sequence_base_frame_gain(
    corrections: Mapping[int, Gaussian],
    solver: FrameSolver,
    opened: Callable[[int], tuple[Frame, Variables]],
    free: FreeParameters,
) -> float:
    """What free base frames would explain of the residual that is left: the median of a few frames [1].

    Args:
        corrections: position -> the correction of the measured values that was found; at least one.
        solver: that knows the images.
        opened: gives the frame at a position, and its unknowns.
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
    """Estimates with their assessments, and again those of frames that failed and were then solved alone.

    Args:
        estimates: position -> final estimate.
        corrections: position -> the correction of the measured values that it is.
        scene: of the sequence.
        solver: that knows the images.
        opened: gives the frame at a position, and its unknowns.
        alone: whether frames that failed are solved alone, too.
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
    """The estimate of a frame that is solved without the others; as it was, where that fails, too."""
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
    """The verdict on the whole, and all estimates; where it has failed, frames that failed keep their measured values.

    Args:
        estimates: position -> assessed estimate; at least one.
        visits: what is kept of the frames.
        scene: of the sequence.
        prior: what is expected of a correction before any image.
        keyframes: whether a person set some; that counts more than the images, and all estimates stay.
    """
    found = {index: estimate.assessment for index, estimate in estimates.items() if estimate.assessment is not None}
    whole, kept = assess_sequence(list(found.values())), dict(estimates)
    if whole.verdict is Verdict.FAILED and not keyframes:
        for index, assessment in found.items():
            if assessment.verdict is Verdict.FAILED:
                measured = replace(visits[index], start=Origin.MEASURED).estimate(scene, index, prior, prior)
                kept[index] = replace(measured, assessment=assessment, seconds=estimates[index].seconds)
    return whole, kept
