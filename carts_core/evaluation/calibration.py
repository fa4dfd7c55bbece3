"""How well a calibration fits: per frame before and after, and as JSON."""

from collections.abc import Mapping
from collections.abc import Sequence as Frames
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ..model.camera import Camera
from ..model.scene import Arm, Scene
from ..optimization import CalibrationResult
from ..recording import Frame, Sequence
from ..rendering import Renderer
from .metrics import dice


@dataclass(frozen=True)
class FrameResidual:
    """One frame, with joints as measured, under both calibrations."""

    frame: str
    weight: float
    """How far it counted, in [0, 1]."""
    loss_before: float
    loss_after: float
    dice_before: dict[str, float]
    """Camera -> Dice; only cameras with a mask of this frame."""
    dice_after: dict[str, float]


def frame_residuals(sequence: Sequence, frames: Frames[Frame], result: CalibrationResult) -> list[FrameResidual]:
    """Compare the frames that a calibration was made from with the images and, where they are, the masks."""
    overlaps = []
    for scene in (sequence.scene, result.scene):
        renderers = {camera: Renderer(scene, cameras=[camera]) for camera in frames[0].images}
        overlaps.append([_overlap(scene, frame, renderers) for frame in frames])
    values = zip(
        frames, result.frame_weights, result.frame_losses_before, result.frame_losses_after, *overlaps, strict=True
    )
    return [
        FrameResidual(frame.frame_id, float(weight), float(before), float(after), *dice_of_cameras)
        for frame, weight, before, after, *dice_of_cameras in values
    ]


def _overlap(scene: Scene, frame: Frame, renderers: dict[str, Renderer]) -> dict[str, float]:
    masks, state = frame.masks or {}, scene.state(frame.measured, mounts=frame.mounts)
    return {camera: dice(renderers[camera].segment(state)[0] >= 0, mask) for camera, mask in masks.items()}


def mean_dice(residuals: Frames[FrameResidual], camera: str) -> tuple[float, float] | None:
    """Mean Dice of a camera before and after; None where no frame has a mask."""
    pairs = [
        (residual.dice_before[camera], residual.dice_after[camera])
        for residual in residuals
        if camera in residual.dice_before
    ]
    return (float(np.mean([pair[0] for pair in pairs])), float(np.mean([pair[1] for pair in pairs]))) if pairs else None


def calibration_json(before: Scene, result: CalibrationResult, residuals: Frames[FrameResidual]) -> dict[str, Any]:
    """Both calibrations, their difference, and the residuals; matrices in metres, the rest as the keys say."""
    cameras = zip(before.cameras, result.scene.cameras, strict=True)
    found = result.assessment
    return {
        "stopped": result.stop_reason,
        "verdict": found and found.verdict.value,
        "reason": found and found.reason,
        "remedy": found and found.remedy,
        "probability_of_failure": found and found.probability,
        "arms": {
            old.name: {"T_world_base": _difference(old.T_world_base, new.T_world_base)}
            for old, new in zip(before.arms, result.scene.arms, strict=True)
        },
        "cameras": {
            old.name: {
                "T_camera_world": _difference(old.T_camera_world, new.T_camera_world),
                "intrinsics_px": {"before": old.intrinsics, "after": new.intrinsics},
            }
            for old, new in cameras
        },
        "unknowns": [asdict(unknown) for unknown in result.unknowns],
        "frames": [asdict(residual) for residual in residuals],
    }


def moved_frames(before: Scene, after: Scene) -> list[tuple[str, float, float]]:
    """Every base frame and camera that differs: what it is, by how many degrees, and by how many millimetres."""
    pairs: list[tuple[Arm | Camera, np.ndarray, np.ndarray]] = []
    for old, new in zip(before.arms, after.arms, strict=True):
        pairs.append((old, old.T_world_base, new.T_world_base))
    for old, new in zip(before.cameras, after.cameras, strict=True):
        pairs.append((old, old.T_camera_world, new.T_camera_world))
    return [
        (
            ("T_world_base of " if isinstance(thing, Arm) else "T_camera_world of ") + thing.name,
            *pose_distance(old, new),
        )
        for thing, old, new in pairs
        if not np.array_equal(old, new)
    ]


def beyond_prior(before: Scene, result: CalibrationResult, known: Mapping[str, Float[np.ndarray, "6 6"]]) -> str | None:
    """Which base frames have moved farther than hand-eye calibration leaves open; None if none has.

    Args:
        before: with the calibration as it was.
        result: the new one.
        known: arm -> covariance of its base frame, as of `HandEyeResult`.
    """
    said = []
    for arm in result.beyond:
        angle, way = pose_distance(before.arm(arm).T_world_base, result.scene.arm(arm).T_world_base)
        turn, shift = (np.sqrt(np.trace(known[arm][part, part])) for part in (slice(3), slice(3, 6)))
        said.append(
            f"the base frame of {arm} moves by {angle:.1f} deg and {way:.1f} mm, where its hand-eye calibration is "
            f"known to {np.degrees(turn):.1f} deg and {1e3 * shift:.1f} mm"
        )
    return f"{'; '.join(said)}." if said else None


def remark(before: Scene, result: CalibrationResult) -> str | None:
    """What to know before the calibration is used; None where only intrinsics changed."""
    if not any(unknown.change for unknown in result.unknowns):
        return (
            "The start was kept: nothing that was tried made these frames fit better, so the calibration is as it was."
        )
    if not moved_frames(before, result.scene):
        return None
    return (
        "Images can hardly tell a wrong base frame from a joint that is read wrong by the same amount in every frame, "
        "and not at all where an arm stands still. What moved here may be either: it fits these joint readings, and is "
        "no more right than they are."
    )


def _difference(before: Float[np.ndarray, "4 4"], after: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    angle, distance = pose_distance(before, after)
    return {
        "before": before.tolist(),
        "after": after.tolist(),
        "rotation_deg": angle,
        "translation_mm": distance,
    }


def pose_distance(before: Float[np.ndarray, "4 4"], after: Float[np.ndarray, "4 4"]) -> tuple[float, float]:
    """Angle [deg] between two poses, and distance of their translations [mm]."""
    turned = after[:3, :3] @ before[:3, :3].T
    # The chord is exact for small angles, where the arc cosine of the trace is not.
    angle = 2.0 * np.arcsin(np.clip(np.linalg.norm(turned - np.eye(3)) / np.sqrt(8.0), 0.0, 1.0))
    return float(np.rad2deg(angle)), float(1000.0 * np.linalg.norm(after[:3, 3] - before[:3, 3]))
