"""Which frames have kinematics, and stand-ins for a calibration that a recording does not have."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ...errors import SequenceError
from ...settings.importing import ImportOptions
from ...wording import counted
from .cameras import check_intrinsics, placed_cameras
from .found import FoundArm, FoundCamera, FoundRecording, Note
from .joint_units import check_limits
from .views import check_in_view, check_pair, tips_of

MAX_GAP = 0.1
"""[s] As in the sequence format: rows that are used may be this far away."""
FOCAL_WIDTHS = 1.2
"""Stand-in for a focal length: that of an endoscope of some 45 degrees, in widths of the image."""
_DISTANCE = 0.12
"""[m] Stand-in for the distance from the camera to the tips."""
_BEHIND = -1.0
"""[m] Where an arm without kinematics stands: behind the camera, where no image shows it."""


def completed(recording: FoundRecording, options: ImportOptions) -> FoundRecording:
    """The recording with only the frames that have kinematics, and with stand-ins; notes say which.

    Joints are compared with the limits of their robots, and base frames with what the cameras see.

    Raises:
        SequenceError: there are no frames, no camera, or no frame has kinematics.
    """
    if not recording.cameras:
        raise SequenceError(
            f"{recording.name}: no images were found ({recording.kind}). Name them: --images left FOLDER_OR_VIDEO."
        )
    if not recording.frame_ids:
        raise SequenceError(f"{recording.name}: there are no frames ({recording.kind}). Name other images.")
    notes = list(recording.notes)
    recording = _frames_with_kinematics(recording, notes.append)
    for camera in recording.cameras:
        if camera.intrinsics is not None:
            check_intrinsics(camera, options, notes.append)
    cameras = tuple(_with_intrinsics(camera, notes.append) for camera in recording.cameras)
    cameras = placed_cameras(cameras, notes.append)
    if options.time_offset is not None and all(arm.times is None for arm in recording.arms):
        raise SequenceError(
            f"{recording.name}: --time-offset needs times, and rows are matched with images without any. Give the "
            "images' rate (--frame-rate), or leave it out."
        )
    known = tuple(
        replace(arm, beyond_limits=not check_limits(arm, notes.append)) if arm.values is not None else arm
        for arm in recording.arms
    )
    check_pair(cameras, notes.append)
    for arm in known:
        check_in_view(arm, cameras[0], notes.append)
    stand_in = FoundArm("PSM1", robot=options.robot.get("PSM1", FoundArm.robot))
    arms = tuple(_placed(arm, number, notes.append) for number, arm in enumerate(known or (stand_in,)))
    return replace(recording, cameras=cameras, arms=arms, notes=tuple(notes))


def _frames_with_kinematics(recording: FoundRecording, note: Callable[[Note], None]) -> FoundRecording:
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
        # A log of one row for each image may be slow throughout.
        if len(spacing) and (long := spacing > max(MAX_GAP, 2.0 * float(np.median(spacing)))).any():
            note(
                Note(
                    "warning",
                    f"{name}: {counted(int(long.sum()), 'gap')} of up to {spacing.max():.3g} s in the log.",
                )
            )
    if keep.all():
        return recording
    if not keep.any():
        spans = "; ".join(f"{name} {times[0]:.3f} to {times[-1]:.3f} s" for name, times in logs)
        raise SequenceError(
            f"{recording.name}: no frame has joint positions within {MAX_GAP} s. Images are from {wanted[0]:.3f} to "
            f"{wanted[-1]:.3f} s, kinematics: {spans}. Clocks or their units differ: give --time-offset or --clock."
        )
    note(
        Note(
            "warning",
            f"{int((~keep).sum())} of {counted(len(keep), 'frame')} left out: no joint positions within {MAX_GAP} s.",
        )
    )
    ids = tuple(frame for frame, kept in zip(recording.frame_ids, keep, strict=True) if kept)
    cameras = []
    for camera in recording.cameras:
        # Videos whose frames are counted need numbers once some are left out.
        numbers = np.arange(len(keep)) if camera.numbers is None and not camera.pattern else camera.numbers
        cameras.append(replace(camera, numbers=None if numbers is None else numbers[keep]))
    return replace(recording, frame_ids=ids, frame_times=recording.frame_times[keep], cameras=tuple(cameras))


def _with_intrinsics(camera: FoundCamera, note: Callable[[Note], None]) -> FoundCamera:
    if camera.intrinsics is not None:
        return camera
    width, height = camera.size
    focal = FOCAL_WIDTHS * width
    note(
        Note(
            "missing",
            f"{camera.name}: no calibration; a focal length of {focal:.0f} px stands in for it. Give --calibration "
            f"{camera.name} FILE, or let carts calibrate find it.",
        )
    )
    return replace(camera, intrinsics=(focal, focal, width / 2, height / 2), pixel_center=0.5)


def _placed(arm: FoundArm, number: int, note: Callable[[Note], None]) -> FoundArm:
    if arm.T_world_base is not None:
        return arm
    T = np.eye(4)
    if arm.values is None:
        T[2, 3] = _BEHIND
        note(Note("missing", f"no kinematics of {arm.name}: it is kept behind the camera, and masks are all there is."))
        return replace(arm, T_world_base=T, base_from="nothing: behind the camera")
    tip = tips_of(replace(arm, values=np.median(arm.values, axis=0)[None]))[0]
    side = -1.0 if number % 2 == 0 else 1.0
    towards = np.array([0.6 * side, 0.25, 0.76])
    turn = Rotation.align_vectors([towards / np.linalg.norm(towards)], [tip / np.linalg.norm(tip)])
    T[:3, :3] = turn[0].as_matrix()
    T[:3, 3] = [0.0, 0.0, max(_DISTANCE, 0.5 * float(np.linalg.norm(tip)))] - T[:3, :3] @ tip
    note(
        Note(
            "missing",
            f"{arm.name}: no base frame (hand-eye calibration); it is placed before the camera as a stand-in. Give "
            f"--base {arm.name} FILE, or place it in carts view and refine with carts calibrate.",
        )
    )
    return replace(arm, T_world_base=T, base_from="nothing: a stand-in")
