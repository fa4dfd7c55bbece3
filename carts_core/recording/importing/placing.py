"""Placing of arms and cameras: frames with kinematics, checks against the view, stand-in calibrations."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ...errors import SequenceError
from ...model.camera import T_DVRK_OPENCV
from ...model.psm_kinematics import CLASSIC, JOINT_NAMES, forward
from ...model.robot import Robot
from ...settings.interchange import ImportOptions
from ...wording import counted
from .cameras import check_intrinsics, placed_cameras
from .found import FoundArm, FoundCamera, FoundRecording, Notes
from .joint_units import check_limits

_ROWS = 200
_NEAREST, _FARTHEST = 0.01, 0.6
"""Depths at which an endoscope sees an instrument [m]."""
_BORDER = 0.5
"""Share of the image's size by which a tip may be outside, since base frames are some centimetres off."""
_IN_VIEW, _OUT = 0.5, 0.1
"""Share of rows with the tip in view that is sufficient, and share that is too small."""


def tips_of(arm: FoundArm) -> Float[np.ndarray, "rows 3"]:
    """Positions of the tip, or of the last link of another robot, in the base frame [m]."""
    assert arm.values is not None
    if arm.columns[: len(JOINT_NAMES)] == JOINT_NAMES:
        return forward(arm.values[:, : len(JOINT_NAMES)], CLASSIC)[:, :3, 3]
    robot = Robot.load(arm.robot)
    joints = np.zeros((len(arm.values), len(robot.joint_names)))
    for column, name in enumerate(arm.columns):
        joints[:, robot.joint_names.index(name)] = arm.values[:, column]
    return robot.forward_kinematics(torch.from_numpy(joints)).numpy()[:, -1, :3, 3]


def check_in_view(arm: FoundArm, camera: FoundCamera, notes: Notes) -> None:
    """Warn if a base frame puts the tip out of view and another reading of it puts it in view."""
    if arm.values is None or arm.T_world_base is None or camera.intrinsics is None:
        return
    tips = tips_of(arm)[:: max(1, len(arm.values) // _ROWS)]
    if _in_view(tips, arm.T_world_base, camera) > _OUT:
        return
    readings = {
        "its inverse (the camera in the base's frame)": np.linalg.inv(arm.T_world_base),
        "the other axes of the camera (--axes)": T_DVRK_OPENCV @ arm.T_world_base,
        "the inverse with the other axes": np.linalg.inv(T_DVRK_OPENCV @ arm.T_world_base),
        "millimetres for metres": _scaled(arm.T_world_base, 1e-3),
    }
    fitting = [name for name, T in readings.items() if _in_view(tips, T, camera) >= _IN_VIEW]
    if fitting:
        text = f"{arm.name}: the base frame from {arm.base_from} puts the tip where {camera.name} cannot see it"
        notes.warning(f"{text}; {' or '.join(fitting)} would fit. Correct the file.")


def _scaled(T: np.ndarray, factor: float) -> np.ndarray:
    result = T.copy()
    result[:3, 3] *= factor
    return result


def _in_view(tips: np.ndarray, T_camera_base: np.ndarray, camera: FoundCamera) -> float:
    """Share of the tips in view of a camera."""
    assert camera.intrinsics is not None
    points = tips @ T_camera_base[:3, :3].T + T_camera_base[:3, 3]
    depth = points[:, 2]
    fx, fy, cx, cy = camera.intrinsics
    u = fx * points[:, 0] / np.where(depth > 0, depth, np.nan) + cx
    v = fy * points[:, 1] / np.where(depth > 0, depth, np.nan) + cy
    width, height = camera.size
    inside = (np.abs(u / width - 0.5) < 0.5 + _BORDER) & (np.abs(v / height - 0.5) < 0.5 + _BORDER)
    return float(np.mean(inside & (depth > _NEAREST) & (depth < _FARTHEST)))


def check_pair(cameras: tuple[FoundCamera, ...], notes: Notes) -> None:
    """Warn if the right camera of a pair is on the left of the left one."""
    by_name = {camera.name: camera for camera in cameras}
    if not {"left", "right"} <= set(by_name):
        return
    left, right = (by_name[side].T_camera_world for side in ("left", "right"))
    if right is None:
        return
    T_right_left = right if left is None else right @ np.linalg.inv(left)
    if T_right_left[0, 3] > abs(T_right_left[1, 3]):
        distance = 1e3 * float(T_right_left[0, 3])
        text = f"the right camera is {distance:.1f} mm at the left of the left one: left and right are swapped, or the"
        notes.warning(f"{text} calibration is the inverse (left in the right one's frame).")


MAX_GAP = 0.1
"""Largest time between a frame and the rows used for it, as in the sequence format [s]."""
FOCAL_WIDTHS = 1.2
"""Default focal length of an endoscope of about 45 degrees, in image widths."""
_DISTANCE = 0.12
"""Default distance from the camera to the tips [m]."""
_BEHIND = -1.0
"""Default position of an arm without kinematics: behind the camera, so that no image shows it [m]."""


def completed(recording: FoundRecording, options: ImportOptions) -> FoundRecording:
    """The recording restricted to frames with kinematics and completed with defaults; notes list them.

    Joints are compared with the limits of their robots, and base frames with the view of the cameras.

    Raises:
        SequenceError: there are no frames, no camera, or no frame has kinematics.
    """
    if not recording.cameras:
        raise SequenceError(
            f"{recording.name}: no images were found ({recording.kind}). Name them: --images left FOLDER_OR_VIDEO."
        )
    if not recording.frame_ids:
        raise SequenceError(f"{recording.name}: there are no frames ({recording.kind}). Name other images.")
    notes = Notes(recording.notes)
    recording = _frames_with_kinematics(recording, notes)
    for camera in recording.cameras:
        if camera.intrinsics is not None:
            check_intrinsics(camera, options, notes)
    cameras = tuple(_with_intrinsics(camera, notes) for camera in recording.cameras)
    cameras = placed_cameras(cameras, notes)
    if options.time_offset is not None and all(arm.times is None for arm in recording.arms):
        raise SequenceError(
            f"{recording.name}: --time-offset needs times, and rows are matched with images without any. Give the "
            "images' rate (--frame-rate), or leave it out."
        )
    known = tuple(
        replace(arm, beyond_limits=not check_limits(arm, notes)) if arm.values is not None else arm
        for arm in recording.arms
    )
    check_pair(cameras, notes)
    for arm in known:
        check_in_view(arm, cameras[0], notes)
    stand_in = FoundArm("PSM1", robot=options.robot.get("PSM1", FoundArm.robot))
    arms = tuple(_placed(arm, number, notes) for number, arm in enumerate(known or (stand_in,)))
    return replace(recording, cameras=cameras, arms=arms, notes=tuple(notes))


def _frames_with_kinematics(recording: FoundRecording, notes: Notes) -> FoundRecording:
    if recording.frame_times is None:
        return recording
    wanted = recording.frame_times + recording.time_offset
    keep = np.ones(len(wanted), bool)
    logs = [(arm.name, arm.times) for arm in recording.arms if arm.times is not None]
    if recording.motion is not None and logs:
        logs.append(("the endoscope", recording.motion.times))
    for name, times in logs:
        after = np.searchsorted(times, wanted).clip(0, len(times) - 1)
        before = np.where(times[after] > wanted, after - 1, after).clip(0)
        gaps = np.maximum(np.abs(wanted - times[before]), np.abs(times[after] - wanted))
        keep &= gaps <= MAX_GAP
        spacing = np.diff(times)
        # A log with one row per image may have large gaps throughout.
        if len(spacing) and (long := spacing > max(MAX_GAP, 2.0 * float(np.median(spacing)))).any():
            notes.warning(f"{name}: {counted(int(long.sum()), 'gap')} of up to {spacing.max():.3g} s in the log.")
    if keep.all():
        return recording
    if not keep.any():
        spans = "; ".join(f"{name} {times[0]:.3f} to {times[-1]:.3f} s" for name, times in logs)
        raise SequenceError(
            f"{recording.name}: no frame has joint positions within {MAX_GAP} s. Images are from {wanted[0]:.3f} to "
            f"{wanted[-1]:.3f} s, kinematics: {spans}. Clocks or their units differ: give --time-offset or --clock."
        )
    notes.warning(
        f"{int((~keep).sum())} of {counted(len(keep), 'frame')} left out: no joint positions within {MAX_GAP} s."
    )
    ids = tuple(frame for frame, kept in zip(recording.frame_ids, keep, strict=True) if kept)
    cameras = []
    for camera in recording.cameras:
        # Videos whose frames are counted need numbers once some are left out.
        numbers = np.arange(len(keep)) if camera.numbers is None and not camera.pattern else camera.numbers
        cameras.append(replace(camera, numbers=None if numbers is None else numbers[keep]))
    return replace(recording, frame_ids=ids, frame_times=recording.frame_times[keep], cameras=tuple(cameras))


def _with_intrinsics(camera: FoundCamera, notes: Notes) -> FoundCamera:
    if camera.intrinsics is not None:
        return camera
    width, height = camera.size
    focal = FOCAL_WIDTHS * width
    notes.missing(
        f"{camera.name}: no calibration; a focal length of {focal:.0f} px stands in for it. Give --calibration "
        f"{camera.name} FILE, or let carts calibrate find it."
    )
    return replace(camera, intrinsics=(focal, focal, width / 2, height / 2), pixel_center=0.5)


def _placed(arm: FoundArm, number: int, notes: Notes) -> FoundArm:
    if arm.T_world_base is not None:
        return arm
    T = np.eye(4)
    if arm.values is None:
        T[2, 3] = _BEHIND
        notes.missing(f"no kinematics of {arm.name}: it is kept behind the camera, and masks are all there is.")
        return replace(arm, T_world_base=T, base_from="nothing: behind the camera")
    tip = tips_of(replace(arm, values=np.median(arm.values, axis=0)[None]))[0]
    side = -1.0 if number % 2 == 0 else 1.0
    towards = np.array([0.6 * side, 0.25, 0.76])
    turn = Rotation.align_vectors([towards / np.linalg.norm(towards)], [tip / np.linalg.norm(tip)])
    T[:3, :3] = turn[0].as_matrix()
    T[:3, 3] = [0.0, 0.0, max(_DISTANCE, 0.5 * float(np.linalg.norm(tip)))] - T[:3, :3] @ tip
    notes.missing(
        f"{arm.name}: no base frame (hand-eye calibration); it is placed before the camera as a stand-in. Give "
        f"--base {arm.name} FILE, or place it in carts view and refine with carts calibrate."
    )
    return replace(arm, T_world_base=T, base_from="nothing: a stand-in")
