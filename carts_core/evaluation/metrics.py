"""How good a mask or a joint estimate is."""

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Float

from ..model.scene import Arm, Scene


def dice(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"]) -> float:
    """Dice score of two masks, 0 to 1; two empty masks agree."""
    total = int(a.sum()) + int(b.sum())
    return 1.0 if total == 0 else 2.0 * int((a & b).sum()) / total


def normalized_surface_distance(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"], tolerance: float) -> float:
    """Share of both masks' outlines that lies within `tolerance` [px] of the other's outline, 0 to 1 (NSD).

    An outline is the mask's pixels that have a neighbour (left, right, above, below) outside the mask. The image's
    border is no outline: there the mask is cut off, not ended. Two masks without outline agree if they are equal.
    """
    outlines = [_outline(mask) for mask in (a, b)]
    total = sum(int(outline.sum()) for outline in outlines)
    if total == 0:
        return float(np.array_equal(a, b))
    if not all(outline.any() for outline in outlines):
        return 0.0
    near = 0
    for outline, other in (outlines, reversed(outlines)):
        distance = cv2.distanceTransform((~other).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        near += int((distance[outline] <= tolerance + 1e-4).sum())
    return near / total


def _outline(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    # OpenCV erodes as if the mask went on beyond the image.
    return mask & (cv2.erode(mask.astype(np.uint8), cross) == 0)


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
        if arm.name in truth:
            difference = np.abs(np.asarray(estimate[arm.name]) - np.asarray(truth[arm.name]))
            errors += _revolute(arm, difference, joints)
    return float(np.rad2deg(np.mean(errors))) if errors else None


def joint_std_deg(
    scene: Scene, joint_std: Mapping[str, Float[np.ndarray, " dofs"]], joints: Mapping[str, tuple[str, ...]]
) -> float | None:
    """Mean standard deviation [deg] of the named revolute joints over all arms; None where none is known.

    Args:
        scene: whose arms these are.
        joint_std: arm name -> standard deviations [rad, m]; NaN ones do not count.
        joints: arm name -> joints that count.
    """
    values = [
        value for arm in scene.arms for value in _revolute(arm, joint_std[arm.name], joints) if np.isfinite(value)
    ]
    return float(np.rad2deg(np.mean(values))) if values else None


def _revolute(arm: Arm, values: Float[np.ndarray, " dofs"], joints: Mapping[str, tuple[str, ...]]) -> list[float]:
    named = zip(arm.robot.joint_names, arm.robot.joint_types, values, strict=True)
    return [float(v) for name, kind, v in named if kind == "revolute" and name in joints.get(arm.name, ())]
