"""Reliability of results: verdicts, joints that are not determined, and base frames that may be wrong."""

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum

import numpy as np

from ..model.scene import Scene
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
