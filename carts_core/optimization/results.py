"""Results of an optimization: iterates, verdicts, standard deviations, undetermined joints; requires no PyTorch."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from ..model.scene import Scene, SceneState
from ..reprs import short_repr
from ..settings import SurfaceSolver
from ..wording import counted

POSSIBLE, LIKELY = 0.13, 0.5
"""Minimum probabilities of failure at which a fit is doubtful, and at which it has failed [1]; see
docs/explanation/decisions.md."""

BASE_FRAME_GAIN = 0.12
"""Share of the residual explained by free base frames above which base frames are probably wrong [1]."""
DETERMINED = 1 / 3
"""Ratio of posterior to prior standard deviation below which an unknown is determined [1]."""
_OPEN_ANGLE = DETERMINED * math.radians(SurfaceSolver.prior_deg)
_OPEN_LENGTH = _OPEN_ANGLE * SurfaceSolver.length_scale
"""Standard deviation above which a joint is not determined [rad, m]."""


class Verdict(StrEnum):
    """Reliability of a fit."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    FAILED = "failed"

    @classmethod
    def of(cls, probability: float) -> "Verdict":
        """Verdict from the probability of failure [1]."""
        if probability >= LIKELY:
            return cls.FAILED
        return cls.DOUBTFUL if probability >= POSSIBLE else cls.GOOD


@dataclass(frozen=True)
class PoseDeviation:
    """Standard deviations of an arm's pose in a camera's frame, at the centroid of its clicked points or, in a
    calibration from images, at its mean tip position."""

    rotation_deg: float
    """Rotation in the worst direction [deg]."""
    sideways_mm: float
    """Translation perpendicular to the optical axis, in the worst direction [mm]."""
    depth_mm: float
    """Translation along the optical axis [mm]."""

    @staticmethod
    def of(covariance: Float[np.ndarray, "6 6"]) -> "PoseDeviation":
        """Standard deviations from the covariance of rotation and translation in the camera's frame [rad, m]."""
        parts = covariance[:3, :3], covariance[3:5, 3:5]
        turn, sideways = (max(np.linalg.eigvalsh(part)[-1], 0.0) for part in parts)
        return PoseDeviation(
            rotation_deg=float(np.degrees(np.sqrt(turn))),
            sideways_mm=float(1e3 * np.sqrt(sideways)),
            depth_mm=float(1e3 * np.sqrt(max(covariance[5, 5], 0.0))),
        )


Observability = Literal["determined", "weak", "not visible"]

_VISIBLE = 0.9


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations of the unknowns after an optimization."""

    names: tuple[str, ...]
    """Names of the unknowns as in `Variables.names`, such as `PSM1/yaw`."""
    std: tuple[float, ...]
    """Standard deviation [rad]; [m] for prismatic joints and translations."""
    expected: tuple[float, ...]
    """Prior standard deviation; at the end of a fit, rescaled by the size of the corrections."""
    std_ratio: tuple[float, ...] | None = None
    """Ratio of posterior to prior standard deviation for the prior of the settings [1]; None if `expected` is that
    prior."""

    __repr__ = short_repr

    def observability(self, name: str) -> Observability:
        """Observability of an unknown: whether its standard deviation decreases to less than a third, by at least a
        tenth, or hardly at all."""
        index = self.names.index(name)
        share = self.std[index] / self.expected[index] if self.std_ratio is None else self.std_ratio[index]
        return "determined" if share < DETERMINED else "weak" if share < _VISIBLE else "not visible"

    def joint_std(self, arm: str, joints: Sequence[str]) -> Float[np.ndarray, " dofs"]:
        """Standard deviation of joint positions of an arm [rad, m]; NaN where a joint was not free."""
        known = dict(zip(self.names, self.std, strict=True))
        return np.array([known.get(f"{arm}/{joint}", np.nan) for joint in joints])

    def doubted(self, probability: float) -> "Uncertainty":
        """Standard deviations that account for the probability that the fit is wrong [1], in which case the prior
        applies.

        The two cases are combined by the law of total variance.
        """

        def mixed(right: Sequence[float], wrong: Sequence[float]) -> tuple[float, ...]:
            variances = (np.square(values) for values in (right, wrong))
            return tuple(np.sqrt(np.dot((1.0 - probability, probability), list(variances))).tolist())

        ratio = None if self.std_ratio is None else mixed(self.std_ratio, [1.0] * len(self.std_ratio))
        return replace(self, std=mixed(self.std, self.expected), std_ratio=ratio)

    def rescaled(self, later: "Uncertainty") -> "Uncertainty":
        """Copy of `later`, found under a rescaled prior; its observability still refers to the original prior."""
        return replace(later, std_ratio=tuple(std / given for std, given in zip(self.std, self.expected, strict=True)))


def undetermined_joints(scene: Scene, joint_std: Mapping[str, Sequence[float | None] | np.ndarray]) -> list[str] | None:
    """`ARM.JOINT` of each joint whose standard deviation after a fit exceeds a third of the prior's.

    Args:
        joint_std: arm -> standard deviations [rad, m]; None and NaN (fixed joints) are ignored.

    Returns:
        The names; None if no standard deviation is known.
    """
    known, undetermined = False, []
    for arm in scene.arms:
        named = zip(arm.robot.joint_names, arm.robot.joint_types, joint_std.get(arm.name, ()), strict=False)
        for joint, kind, std in named:
            if std is None or math.isnan(std):
                continue
            known = True
            if std > (_OPEN_LENGTH if kind == "prismatic" else _OPEN_ANGLE):
                undetermined.append(f"{arm.name}.{joint}")
    return undetermined if known else None


def fit_words(verdict: str, undetermined: Sequence[str] | None) -> str:
    """Verdict on the mask and number of undetermined joints as text: `mask good, 4 joints not determined`.

    Args:
        undetermined: result of `undetermined_joints`; None if no standard deviation is known.
    """
    joints = joint_words(undetermined)
    return f"mask {verdict}, {joints}" if joints else f"mask {verdict}"


def joint_words(undetermined: Sequence[str] | None) -> str:
    """Number of undetermined joints as text; empty if no standard deviation is known."""
    if undetermined is None:
        return ""
    return f"{counted(len(undetermined), 'joint')} not determined" if undetermined else "all joints determined"


class StopReason(StrEnum):
    """Termination reason of an optimization."""

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
    """Loss without the prior; comparable within one observation and, unless `FrameOptimizer` is `live`, one blur."""
    gradient_norms: dict[str, float]
    """Absolute derivative of the objective with respect to each unknown, per radian-like unit."""
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
    """Cosine similarity of features, 1 minus the absolute difference of predictions (`Loss.L1`), or 1 minus the squared
    difference of surface maps; at most 1."""

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
