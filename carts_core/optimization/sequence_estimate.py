"""Estimates of the frames of a sequence, and their verdicts."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import torch
from jaxtyping import Float

from ..model.scene import Scene, SceneState
from .error_model import Gaussian
from .measurement import Measurement, SolvedAlone
from .observability import Uncertainty
from .variables import Variables
from .verdict import Assessment


class Origin(StrEnum):
    """Source of a frame's values."""

    WARM = "warm"
    """Optimized from the neighbouring frame's correction."""
    COLD = "cold"
    """Optimized from the measured values."""
    KEYFRAME = "keyframe"
    """Set manually."""
    CARRIED = "carried"
    """Predicted from the other frames; the image contradicts them and is ignored."""
    MEASURED = "measured"
    """Measured values, kept because the sequence and this frame failed."""


@dataclass(frozen=True)
class FrameEstimate:
    """Estimate of one frame, based on its own and the other frames' measurements."""

    index: int
    frame_id: str
    state: SceneState
    joint_positions: dict[str, Float[np.ndarray, " dofs"]]
    """Arm name -> joint positions [rad, m]."""
    joint_std: dict[str, Float[np.ndarray, " dofs"]]
    """Arm name -> standard deviation [rad, m]; 0 for exact keyframes, NaN for fixed joints."""
    uncertainty: Uncertainty
    """Posterior and prior standard deviations of all unknowns."""
    loss: float
    """Loss of the surface factor when the frame was last solved."""
    start: Origin
    iterations: int
    """Number of optimization steps over all visits."""
    seconds: float
    """Time spent on the frame over all visits, including reading [s]."""
    assessment: Assessment | None = None
    """Verdict; None before all frames are visited."""

    def judged(self, assessment: Assessment, scene: Scene) -> "FrameEstimate":
        """Estimate with a verdict, and standard deviations that account for a wrong fit.

        Standard deviations of keyframes, and of values predicted from other frames, are not changed.
        """
        if assessment.nothing_there or self.start in (Origin.KEYFRAME, Origin.CARRIED):
            return replace(self, assessment=assessment)
        known = assessment.of(self.uncertainty)
        return replace(self, assessment=assessment, uncertainty=known, joint_std=_joint_std(known, scene))

    def solved_alone(self, scene: Scene, variables: Variables, found: SolvedAlone, seconds: float) -> "FrameEstimate":
        """Estimate whose values are replaced by those of the single-frame solver.

        Args:
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
        """Estimate of the frame for a correction of the measured values [rad], given the prior before any image."""
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
