"""The figures of a calibration in New recording: loss, shift, verdict, and the residuals of clicked points."""

from collections.abc import Sequence as Rows
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from carts_core.evaluation.calibration import beyond_prior
from carts_core.model.keypoints import link_transforms
from carts_core.optimization import CalibrationResult
from carts_core.optimization.hand_eye import ImagePoint, PointAgreement, PoseDeviation, agreement_with_points
from carts_core.wording import counted
from carts_viewer.recording.clicking import Clicking


@dataclass(frozen=True)
class PoseReport:
    """What became of an arm's pose before a camera."""

    arm: str
    camera: str
    turn_deg: float
    shift_mm: float
    """At the mean of the tips in the clicked frames [mm]."""
    deviation: PoseDeviation
    """Of the new pose."""


@dataclass(frozen=True)
class CalibrationReport:
    """A calibration that has ended, as a draft keeps it."""

    loss_before: float
    """Mean over the frames [1]."""
    loss_after: float
    verdict: str
    """good, doubtful or failed; empty without a verdict."""
    reason: str
    """Of the verdict, with a remedy; for people."""
    poses: tuple[PoseReport, ...]
    before: tuple[float | None, ...]
    """Residuals of the draft's points [px]; None for points that were not used."""
    after: tuple[float | None, ...]
    disagreeing: tuple[int, ...]
    """Points whose residual has grown beyond what noise explains."""
    objection: str
    """Why the points speak against the calibration, for people; empty where they agree."""


def report_of(result: CalibrationResult, clicking: Clicking, points: Rows[ImagePoint]) -> CalibrationReport:
    """The figures of a calibration.

    Args:
        result: of the calibration that began with that of the points.
        clicking: with the calibration from the points.
        points: that were clicked.

    Raises:
        CartsError: the points are of other arms, cameras or frames.
    """
    found = clicking.result
    assert found is not None
    measured = clicking.sequence.measured
    compared = agreement_with_points(result.scene, measured, points, found)
    assessment = result.assessment
    before, after = (tuple(_number(each) for each in row) for row in (compared.before, compared.after))
    return CalibrationReport(
        loss_before=float(np.mean(result.frame_losses_before)),
        loss_after=float(np.mean(result.frame_losses_after)),
        verdict="" if assessment is None else assessment.verdict.value,
        reason="" if assessment is None else f"{assessment.reason} {assessment.remedy}".strip(),
        poses=_poses(result, clicking, points),
        before=before,
        after=after,
        disagreeing=compared.disagreeing,
        objection=_objection(result, compared, clicking, points),
    )


def _objection(
    result: CalibrationResult, compared: PointAgreement, clicking: Clicking, points: Rows[ImagePoint]
) -> str:
    """Why the points speak against the calibration; empty where they agree."""
    before, after, limits = compared.before, compared.after, compared.limits
    if compared.disagreeing:
        worst = max(compared.disagreeing, key=lambda row: after[row] / limits[row])
        return (
            f"{len(compared.disagreeing)} of {counted(len(points), 'point')} moved farther from the clicks than their "
            f"noise explains: the {_named(clicking, points[worst])} from {before[worst]:.1f} to {after[worst]:.1f} px, "
            f"with {limits[worst]:.1f} px allowed."
        )
    if not compared.agrees:
        return (
            "All points together moved farther from the clicks than their noise explains: RMS "
            f"{compared.rms_before:.1f} to {compared.rms_after:.1f} px, with {compared.rms_limit:.1f} px allowed."
        )
    assert clicking.result is not None
    text = beyond_prior(clicking.scene, result, clicking.result.base_covariances)
    return "" if text is None else text[0].upper() + text[1:]


def _poses(result: CalibrationResult, clicking: Clicking, points: Rows[ImagePoint]) -> tuple[PoseReport, ...]:
    """How far each arm moved before each camera."""
    frames = sorted({point.frame for point in points})
    poses = []
    for (name, camera), deviation in result.deviations.items():
        arm = clicking.scene.arm(name)
        middle = link_transforms(arm, clicking.sequence.measured[name][frames])[:, -1, :, 3].mean(0)
        old, new = (
            scene.camera(camera).T_camera_world @ scene.arm(name).T_world_base
            for scene in (clicking.scene, result.scene)
        )
        turn = Rotation.from_matrix(new[:3, :3] @ old[:3, :3].T).magnitude()
        shift = np.linalg.norm((new - old)[:3] @ middle)
        poses.append(PoseReport(name, camera, float(np.degrees(turn)), 1e3 * float(shift), deviation))
    return tuple(poses)


def _named(clicking: Clicking, point: ImagePoint) -> str:
    return f"{point.landmark} in frame {clicking.sequence.frame_ids[point.frame]} ({point.camera})"


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
