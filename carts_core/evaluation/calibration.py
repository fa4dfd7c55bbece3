"""Evaluation of calibrations against ground truth, and reports."""

import json
from collections.abc import Mapping
from collections.abc import Sequence as Frames
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ..arrays import pose_distance
from ..files import OutputPath, output_stream, write_text
from ..html import render_page
from ..model.scene import Scene
from ..optimization import CalibrationResult
from ..recording import Frame, Sequence, calibrated_sequence_file
from ..rendering import Renderer
from ..wording import counted
from .metrics import dice

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class FrameResidual:
    """Residuals of one frame with measured joints, before and after a calibration."""

    frame: str
    weight: float
    """Weight of the frame in the calibration, in [0, 1]."""
    loss_before: float
    loss_after: float
    dice_before: dict[str, float]
    """Camera -> Dice, for cameras with a mask of this frame."""
    dice_after: dict[str, float]


def frame_residuals(sequence: Sequence, frames: Frames[Frame], result: CalibrationResult) -> list[FrameResidual]:
    """Residuals of the frames of a calibration: losses, and Dice if masks are given."""
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
    return {
        camera: dice(renderers[camera].segment(state)[0] >= 0, mask, frame.unlabelled.get(camera))
        for camera, mask in masks.items()
    }


def mean_dice(residuals: Frames[FrameResidual], camera: str) -> tuple[float, float] | None:
    """Mean Dice of a camera before and after the calibration; None if no frame has a mask."""
    seen = [residual for residual in residuals if camera in residual.dice_before]
    if not seen:
        return None
    before, after = (np.mean([getattr(one, f"dice_{when}")[camera] for one in seen]) for when in ("before", "after"))
    return float(before), float(after)


def calibration_json(before: Scene, result: CalibrationResult, residuals: Frames[FrameResidual]) -> dict[str, Any]:
    """Both calibrations, their difference and the residuals as JSON; matrices in metres, other units in key names."""
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
    """Name, rotation [deg] and translation [mm] of each base frame and camera whose pose differs between two scenes."""
    poses = [
        (f"T_world_base of {old.name}", old.T_world_base, new.T_world_base)
        for old, new in zip(before.arms, after.arms, strict=True)
    ]
    poses += [
        (f"T_camera_world of {old.name}", old.T_camera_world, new.T_camera_world)
        for old, new in zip(before.cameras, after.cameras, strict=True)
    ]
    moved = [(name, pose_distance(old, new)) for name, old, new in poses if not np.array_equal(old, new)]
    return [(name, float(angle), float(distance)) for name, (angle, distance) in moved]


def beyond_prior(before: Scene, result: CalibrationResult, known: Mapping[str, Float[np.ndarray, "6 6"]]) -> str | None:
    """Warning about base frames that moved farther than the hand-eye calibration allows; None if there are none.

    Args:
        before: scene with the previous calibration.
        result: result of the new calibration.
        known: arm -> covariance of its base frame, as in `HandEyeResult`.
    """
    said = []
    for arm in result.beyond:
        angle, way = pose_distance(before.arm(arm).T_world_base, result.scene.arm(arm).T_world_base)
        turn, shift = (np.sqrt(np.trace(known[arm][part, part])) for part in (slice(3), slice(3, 6)))
        said.append(
            f"the calibration moves the base frame of {arm} by {angle:.1f} deg and {way:.1f} mm, but its hand-eye "
            f"calibration has standard deviations of {np.degrees(turn):.1f} deg and {1e3 * shift:.1f} mm"
        )
    return f"{'; '.join(said)}." if said else None


def calibration_warning(before: Scene, result: CalibrationResult) -> str | None:
    """Warning about the use of a calibration; None if only intrinsics changed."""
    if not any(unknown.change for unknown in result.unknowns):
        return "The initial calibration was kept, since no better calibration was found."
    if not moved_frames(before, result.scene):
        return None
    return (
        "Images hardly distinguish a wrong base frame from a constant joint offset; for an arm at rest, they cannot. "
        "The new calibration therefore absorbs the offsets of these joint readings."
    )


def _difference(before: Float[np.ndarray, "4 4"], after: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    angle, distance = pose_distance(before, after)
    poses = {"before": before.tolist(), "after": after.tolist()}
    return {**poses, "rotation_deg": float(angle), "translation_mm": float(distance)}


def write_calibration(
    folder: OutputPath, target: Path, sequence: Sequence, result: CalibrationResult, residuals: Frames[FrameResidual]
) -> None:
    """Write `sequence.toml`, `calibration.json`, `frames.png`, `unknowns.png` and `README.md`.

    Args:
        folder: output folder, created if missing.
        target: final location of the folder; paths in the sequence file are relative to it.
        sequence: sequence with the previous calibration.
        result: result of the new calibration.
        residuals: residuals of the frames.
    """
    text = calibrated_sequence_file(sequence.path, target, sequence.scene, result.scene)
    write_text(folder / "sequence.toml", text)
    content = calibration_json(sequence.scene, result, residuals)
    write_text(folder / "calibration.json", json.dumps(content, indent=1))
    for name, figure in (("frames.png", _frames_figure(residuals)), ("unknowns.png", _unknowns_figure(result))):
        with output_stream(folder / name) as stream:
            figure.savefig(stream, format="png", dpi=110)
    page = render_page(
        "calibration.md",
        name=sequence.name,
        frames=counted(len(residuals), "frame"),
        result=result,
        unchanged=not any(unknown.change for unknown in result.unknowns),
        dice={camera: mean_dice(residuals, camera) for camera in _cameras(residuals)},
        moved=moved_frames(sequence.scene, result.scene),
        remark=calibration_warning(sequence.scene, result),
        residuals=residuals,
    )
    write_text(folder / "README.md", page)


def _cameras(residuals: Frames[FrameResidual]) -> list[str]:
    return list(dict.fromkeys(camera for residual in residuals for camera in residual.dice_before))


def _figure(width: float, height: float) -> "Figure":
    """Create an empty figure of a given size [inch]."""
    # Imported on use, because the import takes 0.3 s.
    import matplotlib  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    matplotlib.use("Agg")
    # matplotlib must not parse names of frames and cameras as formulas.
    matplotlib.rcParams["text.parse_math"] = False
    return Figure(figsize=(width, height), layout="constrained")


def _frames_figure(residuals: Frames[FrameResidual]) -> "Figure":
    cameras = _cameras(residuals)
    figure = _figure(7.5, 2.3 * (1 + len(cameras)))
    axes = figure.subplots(1 + len(cameras), 1, squeeze=False, sharex=True)[:, 0]
    names = [residual.frame for residual in residuals]
    for label in ("before", "after"):
        axes[0].plot(names, [getattr(residual, f"loss_{label}") for residual in residuals], ".-", label=label)
        for panel, camera in zip(axes[1:], cameras, strict=True):
            scores = [getattr(residual, f"dice_{label}").get(camera, np.nan) for residual in residuals]
            panel.plot(names, scores, ".-", label=label)
            panel.set(ylabel=f"Dice, {camera}")
    axes[0].set(ylabel="loss")
    axes[0].legend(fontsize=8)
    axes[-1].set_xlabel("frame")
    axes[-1].tick_params(axis="x", rotation=90, labelsize=7)
    for panel in axes:
        panel.grid(alpha=0.3)
    return figure


def _unknowns_figure(result: CalibrationResult) -> "Figure":
    units = list(dict.fromkeys(unknown.unit for unknown in result.unknowns))
    figure = _figure(3.6 * len(units), 0.8 + 0.3 * len(result.unknowns))
    for panel, unit in zip(figure.subplots(1, len(units), squeeze=False)[0], units, strict=True):
        shown = [unknown for unknown in result.unknowns if unknown.unit == unit][::-1]
        panel.errorbar(
            [unknown.change for unknown in shown],
            [unknown.name for unknown in shown],
            xerr=[2 * unknown.standard_deviation for unknown in shown],
            fmt="o",
            capsize=3,
        )
        panel.axvline(0.0, color="black", linewidth=0.8)
        panel.set_xlabel(f"change [{unit}]")
        panel.grid(alpha=0.3)
        panel.tick_params(labelsize=8)
    return figure
