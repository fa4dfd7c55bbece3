"""Metrics of masks and joint positions."""

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Float

from ..model.scene import Arm, Scene


def dice(
    a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"], ignored: Bool[np.ndarray, "h w"] | None = None
) -> float:
    """Dice score of two masks in [0, 1], without ignored pixels; 1 if both are empty."""
    if ignored is not None:
        a, b = a & ~ignored, b & ~ignored
    total = int(a.sum()) + int(b.sum())
    return 1.0 if total == 0 else 2.0 * int((a & b).sum()) / total


def normalized_surface_distance(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"], tolerance: float) -> float:
    """Normalized surface distance (NSD): share of both outlines within `tolerance` [px] of the other outline, in [0,
    1].

    An outline consists of the mask's pixels with a 4-neighbour outside the mask, without the image border. For two
    masks without outlines, the score is 1 if they are equal, else 0.
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
    # OpenCV extrapolates the mask beyond the border.
    return mask & (cv2.erode(mask.astype(np.uint8), cross) == 0)


def joint_mae_deg(
    scene: Scene,
    estimate: Mapping[str, Float[np.ndarray, " dofs"]],
    truth: Mapping[str, Float[np.ndarray, " dofs"]],
    joints: Mapping[str, tuple[str, ...]],
) -> float | None:
    """Mean absolute error [deg] of the named revolute joints over all arms; None without ground truth.

    Args:
        scene: scene with the arms.
        estimate, truth: arm name -> joint positions [rad, m].
        joints: arm name -> joints to compare.
    """
    errors = []
    for arm in scene.arms:
        if arm.name in truth:
            difference = arm.robot.difference(estimate[arm.name], truth[arm.name])
            errors += _revolute(arm, np.abs(difference), joints)
    return float(np.rad2deg(np.mean(errors))) if errors else None


def joint_std_deg(
    scene: Scene, joint_std: Mapping[str, Float[np.ndarray, " dofs"]], joints: Mapping[str, tuple[str, ...]]
) -> float | None:
    """Mean standard deviation [deg] of the named revolute joints over all arms; None if no standard deviation is known.

    Args:
        scene: scene with the arms.
        joint_std: arm name -> standard deviations [rad, m]; NaN values are ignored.
        joints: arm name -> joints to compare.
    """
    values = [
        value for arm in scene.arms for value in _revolute(arm, joint_std[arm.name], joints) if np.isfinite(value)
    ]
    return float(np.rad2deg(np.mean(values))) if values else None


def _revolute(arm: Arm, values: Float[np.ndarray, " dofs"], joints: Mapping[str, tuple[str, ...]]) -> list[float]:
    named = zip(arm.robot.joint_names, arm.robot.joint_types, values, strict=True)
    return [float(v) for name, kind, v in named if kind == "revolute" and name in joints.get(arm.name, ())]
