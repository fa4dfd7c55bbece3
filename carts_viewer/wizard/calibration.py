"""Calibration in *New recording*: the job, its report, and the recording with its result."""

import os
import threading
from collections.abc import Callable, Collection, Mapping
from collections.abc import Sequence as Rows
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from carts_core.errors import CartsError, SettingsError
from carts_core.files import name_fault
from carts_core.model.camera import rigid_transform
from carts_core.model.scene import Scene
from carts_core.optimization.hand_eye import (
    ImagePoint,
    PointAgreement,
    PoseDeviation,
    agreement_with_points,
    mounts_of_points,
    moved_cameras,
)
from carts_core.recording.importing.found import FoundRecording, Note
from carts_core.wording import counted
from carts_viewer.jobs.solver import Calibrated, CalibrationStep, Started
from carts_viewer.jobs.solver_process import Run
from carts_viewer.start.roots import Roots
from carts_viewer.wizard.points import Clicking

CALIBRATION_FRAMES = 20
"""Number of evenly spaced frames of a calibration."""


@dataclass(frozen=True)
class CalibrationProgress:
    """Progress of a calibration."""

    text: str
    """Text for the user."""
    share: float
    """Completed share of the stages, in [0, 1]."""
    scene: Scene | None = None
    """The scene with the calibration so far."""
    result: Calibrated | None = None
    """Result of a finished calibration."""
    error: str = ""
    """Cause of a failure; empty if there is none."""
    ended: bool = False


STOPPED = CalibrationProgress("Stopped; the calibration from your points is unchanged.", 0.0, ended=True)
"""Progress at the end of a stopped calibration."""


class CalibrationJob:
    """A calibration by the solver, followed on a separate thread."""

    def __init__(
        self,
        steps: Run[Started | CalibrationStep | Calibrated],
        scene: Scene,
        report: Callable[[CalibrationProgress], None],
    ) -> None:
        """Start a calibration of a scene; `report` is called on the thread with every progress; the last is `ended`."""
        self._steps, self._scene, self._report = steps, scene, report
        self._cancelled, self._woken = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="carts-calibration", daemon=True)
        self._thread.start()

    def cancel(self) -> None:
        """Request a stop, without a result."""
        self._cancelled.set()
        self._woken.set()

    @property
    def cancelled(self) -> bool:
        """Whether a stop was requested."""
        return self._cancelled.is_set()

    def join(self, timeout: float | None = None) -> None:
        """Wait for the end, at most `timeout` [s]."""
        self._thread.join(timeout)

    def _run(self) -> None:
        try:
            progress = self._calibrate()
        except Exception as error:
            text = str(error) if isinstance(error, CartsError) else f"The calibration failed: {error!r}"
            progress = CalibrationProgress("", 0.0, error=text, ended=True)
        self._report(progress)

    def _calibrate(self) -> CalibrationProgress:
        self._report(CalibrationProgress("Loading the networks", 0.0))
        with closing(self._steps):
            while not self.cancelled:
                match self._next():
                    case Started():
                        self._report(CalibrationProgress("Reading images", 0.0))
                    case CalibrationStep() as step:
                        text = f"Stage {step.stage + 1} of {step.stages}, step {step.index + 1}, loss {step.loss:.4f}"
                        scene = step.calibration.applied_to(self._scene)
                        self._report(CalibrationProgress(text, step.stage / step.stages, scene))
                    case Calibrated() as result:
                        scene = result.calibration.applied_to(self._scene)
                        return CalibrationProgress("Calibrated", 1.0, scene, result, ended=True)
        return STOPPED

    def _next(self) -> Started | CalibrationStep | Calibrated | None:
        """The next result; None once a stop was requested."""
        reply = self._steps.next()
        reply.on_done(self._woken.set)
        while not (reply.done or self.cancelled):
            self._woken.wait()
            self._woken.clear()
        return None if self.cancelled else reply.result()


def as_plain(scene: Scene, calibrated: Collection[str]) -> dict[str, Any]:
    """A calibration as stored in a draft, with the base frames of the calibrated arms."""
    return {
        "arms": {arm.name: arm.T_world_base.tolist() for arm in scene.arms if arm.name in calibrated},
        "cameras": {camera.name: camera.T_camera_world.tolist() for camera in scene.cameras},
        "intrinsics": {camera.name: list(camera.intrinsics) for camera in scene.cameras},
    }


@dataclass(frozen=True)
class PoseReport:
    """Change of the pose of an arm in a camera."""

    arm: str
    camera: str
    turn_deg: float
    shift_mm: float
    """Displacement of the mean tip position in the clicked frames [mm]."""
    deviation: PoseDeviation
    """Uncertainty of the new pose."""


@dataclass(frozen=True)
class CalibrationReport:
    """Report of a finished calibration, as stored in a draft."""

    loss_before: float
    """Initial mean loss of the frames [1]."""
    loss_after: float
    verdict: str
    """good, doubtful or failed; empty if there is no verdict."""
    reason: str
    """Reason for the verdict, with a remedy."""
    poses: tuple[PoseReport, ...]
    before: tuple[float | None, ...]
    """Initial residuals of the points [px]; None for unused points."""
    after: tuple[float | None, ...]
    """Final residuals of the points [px]."""
    disagreeing: tuple[int, ...]
    """Indices of points whose residual has grown beyond the errors of clicks and measured joints."""
    objection: str
    """Description of the contradiction between points and calibration; empty if they agree."""
    rms_limit: float | None = None
    """Maximum RMS residual of the points that errors of clicks and measured joints explain [px]."""


def report_of(result: Calibrated, clicking: Clicking, points: Rows[ImagePoint]) -> CalibrationReport:
    """Report of a calibration that started from the clicked points."""
    found = clicking.result
    assert found is not None
    mounts = mounts_of_points(clicking.sequence, points)
    old, new = (
        moved_cameras(scene, mounts) for scene in (clicking.scene, result.calibration.applied_to(clicking.scene))
    )
    compared = agreement_with_points(new, clicking.sequence.measured, points, found)
    before, after = (
        tuple(float(each) if np.isfinite(each) else None for each in row) for row in (compared.before, compared.after)
    )
    return CalibrationReport(
        loss_before=result.loss_before,
        loss_after=result.loss_after,
        verdict=result.verdict,
        reason=result.reason,
        poses=_poses(result, old, new, clicking, points),
        before=before,
        after=after,
        disagreeing=compared.disagreeing,
        objection=_objection(result, compared, clicking, points),
        rms_limit=compared.rms_limit if np.isfinite(compared.rms_limit) else None,
    )


def _objection(result: Calibrated, compared: PointAgreement, clicking: Clicking, points: Rows[ImagePoint]) -> str:
    """Description of the contradiction between points and calibration; empty if they agree."""
    before, after, limits = compared.before, compared.after, compared.limits
    if compared.disagreeing and not compared.agrees:
        worst = max(compared.disagreeing, key=lambda row: after[row] / limits[row])
        point = points[worst]
        name = f"{point.landmark} in frame {clicking.sequence.frame_ids[point.frame]} ({point.camera})"
        return (
            f"{len(compared.disagreeing)} of {counted(len(points), 'point')} moved farther from the clicks than errors "
            f"of clicks and joints explain; the worst is the {name}: {before[worst]:.1f} to {after[worst]:.1f} px, "
            f"with {limits[worst]:.1f} px allowed."
        )
    if not compared.agrees:
        return (
            "All points together moved farther from the clicks than errors of clicks and joints explain: RMS "
            f"{compared.rms_before:.1f} to {compared.rms_after:.1f} px, with {compared.rms_limit:.1f} px allowed."
        )
    return result.beyond[:1].upper() + result.beyond[1:]


def _poses(
    result: Calibrated, before: Scene, after: Scene, clicking: Clicking, points: Rows[ImagePoint]
) -> tuple[PoseReport, ...]:
    """Change of the pose of each arm in each camera."""
    assert clicking.result is not None
    frames = sorted({point.frame for point in points})
    poses = []
    for (name, camera), deviation in result.deviations.items():
        if name not in clicking.result.base_covariances:
            continue
        robot = before.arm(name).robot
        middle = robot.forward_kinematics(clicking.sequence.measured[name][frames])[:, -1, :, 3].mean(0)
        old, new = (scene.camera(camera).T_camera_world @ scene.arm(name).T_world_base for scene in (before, after))
        turn = Rotation.from_matrix(new[:3, :3] @ old[:3, :3].T).magnitude()
        shift = np.linalg.norm((new - old)[:3] @ middle)
        poses.append(PoseReport(name, camera, float(np.degrees(turn)), 1e3 * float(shift), deviation))
    return tuple(poses)


def calibrated_scene(scene: Scene, calibration: Mapping[str, Any]) -> Scene:
    """The scene with a calibration (`as_plain`); `SettingsError` if malformed or of other arms or cameras."""
    try:
        frames = {name: rigid_transform(T, f"T_world_base of {name}") for name, T in calibration["arms"].items()}
        arms = tuple(replace(arm, T_world_base=frames.pop(arm.name, arm.T_world_base)) for arm in scene.arms)
        if frames:
            raise KeyError(*frames)
        cameras = tuple(
            replace(
                camera,
                T_camera_world=rigid_transform(calibration["cameras"][camera.name], f"T_camera_world of {camera.name}"),
                intrinsics=tuple(float(value) for value in calibration["intrinsics"][camera.name]),
            )
            for camera in scene.cameras
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise SettingsError("the calibration belongs to other arms or cameras. Calibrate again.") from error
    return replace(scene, arms=arms, cameras=cameras)


def calibrated_recording(
    recording: FoundRecording, before: Scene, calibration: Mapping[str, Any], text: str
) -> FoundRecording:
    """The recording with a calibration (`as_plain`) instead of placeholders, which uncalibrated arms keep; errors are
    those of `calibrated_scene`.

    Args:
        before: scene of the recording.
        text: origin of the calibration, for the report.
    """
    scene = calibrated_scene(before, calibration)
    arms = tuple(
        replace(arm, T_world_base=scene.arm(arm.name).T_world_base, base_from=text)
        if arm.name in calibration["arms"]
        else arm
        for arm in recording.arms
    )
    replaced = {(name, "T_world_base") for name in calibration["arms"]}
    cameras = []
    for camera in recording.cameras:
        old, found = before.camera(camera.name), scene.camera(camera.name)
        placed = replace(camera, T_camera_world=found.T_camera_world)
        if not np.allclose(found.T_camera_world, old.T_camera_world, rtol=0.0, atol=1e-9):
            replaced.add((camera.name, "T_camera_world"))
        if not np.allclose(found.intrinsics, old.intrinsics, rtol=1e-9, atol=0.0):
            placed = replace(placed, intrinsics=found.intrinsics, pixel_center=0.5)
            replaced.add((camera.name, "intrinsics"))
        cameras.append(placed)
    notes = [note for note in recording.notes if (note.about, note.placeholder) not in replaced]
    return replace(recording, arms=arms, cameras=tuple(cameras), notes=(*notes, Note("found", f"calibration: {text}.")))


def target_folder(roots: Roots, source: Path, name: str) -> Path:
    """Folder for the sequence of a recording: beside the recording, or inside it if it is an allowed folder; in another
    allowed folder if that one is read-only.

    Raises:
        SettingsError: the name is not a file name, or no folder is writable.
    """
    if (fault := name_fault(name)) is not None:
        raise SettingsError(f"the name is {name!r}, {fault}. Choose another name.")
    beside = roots.checked(source.parent if source not in roots.folders else source)
    parent = next((folder for folder in (beside, *roots.folders) if os.access(folder, os.W_OK | os.X_OK)), None)
    if parent is None:
        raise SettingsError(
            f"{beside} and the allowed folders are read-only. Make one of them writable, or restart carts view with "
            "another --root FOLDER."
        )
    folder = parent / f"{name}_sequence"
    number = 2
    while folder.exists() or folder.is_symlink():
        folder = parent / f"{name}_sequence_{number}"
        number += 1
    return folder
