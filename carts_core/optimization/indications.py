"""Reliability of results: verdicts, standard deviations, undetermined joints, and base frames that may be wrong."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal

import numpy as np
from jaxtyping import Float

from ..model.scene import Scene
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
        """Observability of an unknown: whether its standard deviation decreases to a third, slightly, or hardly at
        all."""
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
        """Standard deviations under a rescaled prior; observability still refers to the original prior."""
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
