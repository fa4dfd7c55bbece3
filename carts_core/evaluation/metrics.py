"""How good a mask or a joint estimate is."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from ..scene import Scene


def dice(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"]) -> float:
    """Dice score of two masks, 0 to 1; two empty masks agree."""
    total = int(a.sum()) + int(b.sum())
    return 1.0 if total == 0 else 2.0 * int((a & b).sum()) / total


def joint_mae_deg(
    scene: Scene,
    estimate: Mapping[str, Float[np.ndarray, " dofs"]],
    truth: Mapping[str, Float[np.ndarray, " dofs"]],
    joints: Mapping[str, tuple[str, ...]],
) -> float | None:
    """Mean absolute error [deg] of the named revolute joints over all arms; None where nothing can be compared.

    Args:
        scene: whose arms these are.
        estimate, truth: arm name -> joint positions [rad, m].
        joints: arm name -> joints that count.
    """
    errors = []
    for arm in scene.arms:
        if arm.name not in truth:
            continue
        difference = np.abs(np.asarray(estimate[arm.name]) - np.asarray(truth[arm.name]))
        for index, (name, kind) in enumerate(zip(arm.robot.joint_names, arm.robot.joint_types, strict=True)):
            if kind == "revolute" and name in joints.get(arm.name, ()):
                errors.append(difference[index])
    return float(np.rad2deg(np.mean(errors))) if errors else None
