"""Iterates and progress of an optimization; requires no PyTorch."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float, UInt8

from ..model.scene import SceneState
from ..reprs import short_repr
from .indications import Uncertainty


class StopReason(StrEnum):
    """Reason for the end of an optimization."""

    CONVERGED = "converged"
    ITERATIONS = "iterations"
    START_KEPT = "start kept"
    FAILED = "failed"
    """The image contradicts the estimate; the start is kept."""
    NOT_OPTIMIZED = "not optimized"
    CANCELLED = "cancelled"


@dataclass(frozen=True)
class Iterate:
    """One iterate of an optimization with its rendering; an immutable copy."""

    index: int
    """Iteration number; 0 for the start."""
    state: SceneState
    loss: float
    """Loss without the prior; comparable within one observation and, if not `live`, one blur."""
    gradient_norms: dict[str, float]
    """Gradient norm per unknown, in radian-like units."""
    seconds: float
    """Duration of this iteration [s]."""
    arm_names: tuple[str, ...]
    joint_names: tuple[tuple[str, ...], ...]
    """Joint names per arm."""
    silhouette: Float[np.ndarray, "cameras h w"]
    """Rendered silhouette; all maps are at the resolution of comparison."""
    image: UInt8[np.ndarray, "cameras h w 3"]
    """Rendered arms, RGB."""
    uncertainty: Uncertainty | None
    """Standard deviations; None for losses without curvature."""
    attention: Float[np.ndarray, "cameras h w"]
    similarity: Float[np.ndarray, "cameras h w"]
    """Cosine similarity of features, or 1 minus the squared difference of surface maps; at most 1."""

    __repr__ = short_repr

    def joint_positions(self) -> dict[str, np.ndarray]:
        """Arm name -> joint positions [dofs], [rad, m]."""
        values = (value.astype(np.float64) for value in self.state.numpy().joint_positions)
        return dict(zip(self.arm_names, values, strict=True))

    def joint_std(self) -> dict[str, np.ndarray]:
        """Arm name -> standard deviation of the joint positions [dofs], [rad, m]; NaN if unknown."""
        known = self.uncertainty or Uncertainty((), (), ())
        return {arm: known.joint_std(arm, joints) for arm, joints in zip(self.arm_names, self.joint_names, strict=True)}


@dataclass(frozen=True)
class Progress:
    """Loss, time and stage of an iterate, stored in the history."""

    index: int
    loss: float
    seconds: float
    stage: int = 0
    """Stage index, from 0; losses are comparable within one stage, see `FrameOptimizer.comparable_losses`."""
