"""Checks and defaults of an imported recording, and writing of its sequence file and tables."""

import io
import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ...errors import CartsError, SequenceError
from ...files import MARKER, OutputPath, file_name, published, write_bytes, write_text
from ...html import render_page
from ...model.camera import T_DVRK_OPENCV
from ...model.instruments import SCHEME
from ...model.psm_kinematics import CLASSIC, JOINT_NAMES, forward
from ...model.robot import Robot
from ...settings.interchange import ImportOptions
from ...wording import counted
from .. import Sequence
from ..frame_list import escaped
from ..kinematics_table import TableError, joints_of
from ..matching import ORIENTATION, POSITION, neighbours
from .cameras import check_intrinsics, placed_cameras
from .found import FoundArm, FoundCamera, FoundRecording, Import, PartError
from .joint_units import check_limits, urdf_of

_ROWS = 200
_NEAREST, _FARTHEST = 0.01, 0.6
"""Range of plausible depths of an instrument in endoscope images [m]."""
_BORDER = 0.5
"""Margin around the image in which a tip still counts as in view, as a share of the image size; large, since base
frames have errors of centimetres."""
_IN_VIEW, _OUT = 0.5, 0.1
"""Minimum share of rows with the tip in view for another interpretation of a base frame, and maximum share at which the
base frame is questioned [1]."""


def tips_of(arm: FoundArm) -> Float[np.ndarray, "rows 3"]:
    """Positions of the tip, or of the last link of another robot, in the base frame [m]."""
    assert arm.values is not None
    if arm.columns[: len(JOINT_NAMES)] == JOINT_NAMES:
        return forward(arm.values[:, : len(JOINT_NAMES)], CLASSIC)[:, :3, 3]
    robot = Robot.load(arm.robot)
    joints = np.zeros((len(arm.values), len(robot.joint_names)))
    for column, name in enumerate(arm.columns):
        joints[:, robot.joint_names.index(name)] = arm.values[:, column]
    return robot.forward_kinematics(joints)[:, -1, :3, 3]


def check_in_view(arm: FoundArm, camera: FoundCamera, job: Import) -> None:
    """Warn if a base frame puts the tip out of view, but another interpretation of the base frame puts the tip in
    view."""
    if arm.values is None or arm.T_world_base is None or camera.intrinsics is None:
        return
    tips = tips_of(arm)[:: max(1, len(arm.values) // _ROWS)]
    if _in_view(tips, arm.T_world_base, camera) > _OUT:
        return
    readings = {
        "its inverse (the camera in the base frame)": np.linalg.inv(arm.T_world_base),
        "the other camera axes": T_DVRK_OPENCV @ arm.T_world_base,
        "the inverse with the other axes": np.linalg.inv(T_DVRK_OPENCV @ arm.T_world_base),
        "millimetres for metres": arm.T_world_base * [1.0, 1.0, 1.0, 1e-3],  # The last row is not used.
    }
    fitting = [name for name, T in readings.items() if _in_view(tips, T, camera) >= _IN_VIEW]
    if fitting:
        text = f"the base frame from {arm.base_from} puts the tip outside the view of {camera.name}"
        remedy = "Or give the camera axes: --axes." if "the other camera axes" in fitting else ""
        job.warning(f"{text}; {' or '.join(fitting)} would fit. Correct the base frame.", arm.name, remedy=remedy)


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


def check_pair(cameras: tuple[FoundCamera, ...], job: Import) -> None:
    """Warn if the right camera of a pair is to the left of the left camera."""
    by_name = {camera.name: camera for camera in cameras}
    if not {"left", "right"} <= set(by_name):
        return
    left, right = (by_name[side].T_camera_world for side in ("left", "right"))
    if right is None:
        return
    T_right_left = right if left is None else right @ np.linalg.inv(left)
    if T_right_left[0, 3] > abs(T_right_left[1, 3]):
        distance = 1e3 * float(T_right_left[0, 3])
        text = f"the right camera is {distance:.1f} mm to the left of the left camera: the cameras are swapped, or the"
        job.warning(f"{text} calibration is the inverse (left camera in the frame of the right one).")


_ENDOSCOPE = "the endoscope"
MAX_GAP = 0.1
"""Maximum time difference between a frame and the rows used for it, as in the sequence format [s]."""
FOCAL_WIDTHS = 1.2
"""Default focal length, in image widths; a field of view of about 45 degrees."""
_DISTANCE = 0.12
"""Minimum default distance from the camera to the tips [m]."""
_BEHIND = -1.0
"""Default depth of an arm without kinematics: behind the camera, so that it is not visible [m]."""


def completed(recording: FoundRecording, options: ImportOptions) -> FoundRecording:
    """Restrict a recording to frames with kinematics and complete it with defaults; notes list both.

    Joints are compared with the limits of their robots, and base frames with the view of the cameras.
    """
    if not recording.cameras:
        raise PartError(
            "images",
            f"{recording.name}: no images were found ({recording.kind}).",
            "Give them: --images left FOLDER_OR_VIDEO.",
        )
    if not recording.frame_ids:
        raise SequenceError(f"{recording.name}: no frames were found ({recording.kind}). Choose other images.")
    job = Import(options, [*recording.notes])
    recording = _frames_with_kinematics(recording, job)
    for camera in recording.cameras:
        if camera.intrinsics is not None:
            check_intrinsics(camera, job)
    cameras = placed_cameras(tuple(_with_intrinsics(camera, job) for camera in recording.cameras), job)
    if options.time_offset is not None and all(arm.times is None for arm in recording.arms):
        raise PartError(
            "columns",
            f"{recording.name}: a time offset needs times, but rows and images are matched without times. Give the "
            "frame rate of the images, or leave out the offset.",
            "Use --frame-rate, or leave out --time-offset.",
        )
    known = tuple(
        replace(arm, beyond_limits=not check_limits(arm, job)) if arm.values is not None else arm
        for arm in recording.arms
    )
    check_pair(cameras, job)
    for arm in known:
        check_in_view(arm, cameras[0], job)
    stand_in = FoundArm("PSM1", robot=options.robot.get("PSM1", FoundArm.robot))
    arms = tuple(_placed(arm, number, job) for number, arm in enumerate(known or (stand_in,)))
    return replace(recording, cameras=cameras, arms=arms, notes=tuple(job.notes))


def _frames_with_kinematics(recording: FoundRecording, job: Import) -> FoundRecording:
    if recording.frame_times is None:
        return recording
    wanted = recording.frame_times + recording.time_offset
    keep = np.ones(len(wanted), bool)
    # Times in the clock that the time offset of the recording refers to.
    logs = [(arm.name, arm.times - arm.time_offset) for arm in recording.arms if arm.times is not None]
    if recording.motion is not None and logs:
        logs.append((_ENDOSCOPE, recording.motion.times))
    for name, times in logs:
        before, after = neighbours(times, wanted)
        gaps = np.maximum(np.abs(wanted - times[before]), np.abs(times[after] - wanted))
        keep &= gaps <= MAX_GAP
        spacing = np.diff(times)
        # A log with one row per image may have large gaps everywhere.
        if len(spacing) and (long := spacing > max(MAX_GAP, 2.0 * float(np.median(spacing)))).any():
            where, about = (" of the endoscope", "") if name == _ENDOSCOPE else ("", name)
            job.warning(f"{counted(int(long.sum()), 'gap')} of up to {spacing.max():.3g} s in the log{where}.", about)
    if keep.all():
        return recording
    if not keep.any():
        spans = "; ".join(f"{name} {times[0]:.3f} to {times[-1]:.3f} s" for name, times in logs)
        raise PartError(
            "columns",
            f"{recording.name}: no frame has joint positions within {MAX_GAP} s. Images are from {wanted[0]:.3f} to "
            f"{wanted[-1]:.3f} s, kinematics: {spans}. The clocks or their units differ.",
            "Give --time-offset or --clock.",
        )
    job.warning(
        f"left out {int((~keep).sum())} of {counted(len(keep), 'frame')}: no joint positions within {MAX_GAP} s."
    )
    ids = tuple(frame for frame, kept in zip(recording.frame_ids, keep, strict=True) if kept)
    cameras = []
    for camera in recording.cameras:
        # Videos with consecutive frames need explicit frame numbers if frames are omitted.
        numbers = np.arange(len(keep)) if camera.numbers is None and not camera.pattern else camera.numbers
        cameras.append(replace(camera, numbers=None if numbers is None else numbers[keep]))
    return replace(recording, frame_ids=ids, frame_times=recording.frame_times[keep], cameras=tuple(cameras))


def _with_intrinsics(camera: FoundCamera, job: Import) -> FoundCamera:
    if camera.intrinsics is not None:
        return camera
    width, height = camera.size
    focal = FOCAL_WIDTHS * width
    job.missing(
        f"no calibration; a placeholder focal length of {focal:.0f} px is used.",
        camera.name,
        remedy=f"Give --calibration {camera.name} FILE, or estimate it with carts calibrate.",
        placeholder="intrinsics",
    )
    return replace(camera, intrinsics=(focal, focal, width / 2, height / 2), pixel_center=0.5)


def _placed(arm: FoundArm, number: int, job: Import) -> FoundArm:
    if arm.T_world_base is not None:
        return arm
    T = np.eye(4)
    if arm.values is None:
        T[2, 3] = _BEHIND
        text = "no kinematics; the arm is placed behind the camera, and only masks can be annotated."
        job.missing(text, arm.name, placeholder="values")
        return replace(arm, T_world_base=T, base_from="a placeholder behind the camera")
    tip = tips_of(replace(arm, values=np.median(arm.values, axis=0)[None]))[0]
    side = -1.0 if number % 2 == 0 else 1.0
    towards = np.array([0.6 * side, 0.25, 0.76])
    turn = Rotation.align_vectors([towards / np.linalg.norm(towards)], [tip / np.linalg.norm(tip)])
    T[:3, :3] = turn[0].as_matrix()
    T[:3, 3] = [0.0, 0.0, max(_DISTANCE, 0.5 * float(np.linalg.norm(tip)))] - T[:3, :3] @ tip
    job.missing(
        "no base frame (hand-eye calibration); a placeholder pose in front of the camera is used.",
        arm.name,
        remedy=f"Give --base {arm.name} FILE, or place the arm in carts view and refine with carts calibrate.",
        placeholder="T_world_base",
    )
    return replace(arm, T_world_base=T, base_from="a placeholder in front of the camera")


FRAMES = "frames.csv"
MOTION = "endoscope.csv"
_HANDLE = "frame"


def write_sequence(
    recording: FoundRecording, folder: Path, *, overwrite: bool = False, files: Mapping[str, str] | None = None
) -> Path:
    """Atomically write FOLDER/sequence.toml, its tables and further `files`; returns the sequence file. Images are not
    copied."""
    with TemporaryDirectory() as trial:
        _write(recording, Path(trial), Path(trial))
        try:
            sequence = Sequence.open(Path(trial) / "sequence.toml")
            sequence.frame(0)
            sequence.frame(len(sequence) - 1)
        except TableError as error:
            raise SequenceError(f"{recording.name}{_place_of(error, recording)}{error.text}") from error
        except CartsError as error:
            if trial not in str(error):
                raise
            text = str(error).replace(f"{trial}/sequence.toml", recording.name)
            raise SequenceError(text.replace(f"{trial}/", "")) from error
    with published(folder, overwrite=overwrite) as draft:
        _write(recording, draft, folder.absolute())
        for name, text in (files or {}).items():
            write_text(draft / name, text)
        write_text(draft / MARKER, json.dumps({"format": "sequence", "source": recording.kind}))
    return folder / "sequence.toml"


def _place_of(error: TableError, recording: FoundRecording) -> str:
    """Location of an error in the recording, instead of the temporary table."""
    arm = next((arm for arm in recording.arms if error.path.name == _table_of(arm)), None)
    if error.row is None:
        return "" if arm is None else f": log of {arm.name}"
    return (
        f": frame {recording.frame_ids[error.row]!r}"
        if arm is None
        else f": row {error.row + 1} in the log of {arm.name}"
    )


def _write(recording: FoundRecording, target: Path | OutputPath, place: Path) -> None:
    """Write all files into `target`, with paths relative to `place`."""
    tables = _tables(recording)
    for name, content in tables.items():
        write_bytes(target / name, content)
    write_text(target / "sequence.toml", _toml(recording, place.resolve()))


def _tables(recording: FoundRecording) -> dict[str, bytes]:
    frame_columns: dict[str, list[str]] = {_HANDLE: list(recording.frame_ids)}
    start = _start(recording)
    if recording.frame_times is not None:
        frame_columns["timestamp"] = [f"{time:.9f}" for time in recording.frame_times - start]
    for camera in recording.cameras:
        if camera.numbers is not None:
            frame_columns[_column(camera)] = [str(int(number)) for number in camera.numbers]
    tables: dict[str, bytes] = {}
    for arm in recording.arms:
        if arm.values is None:
            continue
        if arm.times is None:
            if len(arm.values) != len(recording.frame_ids):
                raise SequenceError(
                    f"{arm.name} has {len(arm.values)} rows of joint positions for {len(recording.frame_ids)} images. "
                    "Each image needs one row. Remove the other rows, or give times for images and rows."
                )
            for name, values in zip(arm.columns, arm.values.T, strict=True):
                frame_columns[f"{arm.name}.{name}"] = [f"{value:.9f}" for value in values]
        else:
            tables[_table_of(arm)] = _csv(arm.columns, arm.times - start, arm.values)
    if _moves(recording):
        assert recording.motion is not None
        Ts = recording.motion.values
        turns = Rotation.from_matrix(Ts[:, :3, :3]).as_quat()
        tables[MOTION] = _csv((*POSITION, *ORIENTATION), recording.motion.times - start, Ts[:, :3, 3], turns)
    rows = zip(*frame_columns.values(), strict=True)
    lines = [",".join(frame_columns), *(",".join(cells) for cells in rows)]
    return {FRAMES: ("\n".join(lines) + "\n").encode(), **tables}


def _moves(recording: FoundRecording) -> bool:
    """Whether camera motion is written, which requires logs with times."""
    return recording.motion is not None and any(arm.times is not None for arm in recording.arms)


def _csv(columns: tuple[str, ...], times: np.ndarray, *values: np.ndarray) -> bytes:
    stream, header = io.BytesIO(), ",".join(["timestamp", *columns])
    np.savetxt(stream, np.column_stack([times, *values]), "%.9f", ",", header=header, comments="")
    return stream.getvalue()


def _start(recording: FoundRecording) -> float:
    return 0.0 if recording.frame_times is None else float(recording.frame_times.min())


def _table_of(arm: FoundArm) -> str:
    return f"{file_name(arm.name)}.csv"


def _column(camera: FoundCamera) -> str:
    return f"{camera.name}_{'ns' if camera.topic else 'frame'}"


def _toml(recording: FoundRecording, place: Path) -> str:
    arms, cameras = [], []
    for arm in recording.arms:
        urdf = urdf_of(arm.name, arm.robot)
        names = [joint.name for joint in joints_of(arm.robot)]
        known = arm.columns if arm.values is not None else ()
        columns = [name for name in known if name != "jaw" or "jaw" in names]
        robot = arm.robot if arm.robot.startswith(SCHEME) else _relative(urdf, place)
        arms.append((arm, robot, columns, [name for name in names if name not in known]))
    for camera in recording.cameras:
        images, masks = escaped(_relative(camera.images, place)), ""
        if camera.pattern:
            images = f"{images}/{camera.pattern}"
        if camera.masks:
            parent, pattern = os.path.split(camera.masks)
            masks = f"{escaped(_relative(Path(parent), place))}/{pattern}"
        pose = np.eye(4) if camera.T_camera_world is None else camera.T_camera_world
        cameras.append((camera, images, masks, pose))
    return render_page(
        "imported_sequence.toml",
        recording=recording,
        path="" if recording.path is None else _relative(recording.path, place),
        arms=arms,
        cameras=cameras,
        timed=[arm for arm in recording.arms if arm.times is not None],
        start=_start(recording),
        moves=_moves(recording),
        frames=FRAMES,
        motion=MOTION,
        max_gap=MAX_GAP,
        table_of=_table_of,
        column=_column,
        text=_text,
        K=lambda camera: zip(("fx", "fy", "cx", "cy"), map(float, camera.intrinsics), strict=True),
        rows=lambda T: (np.round(T, 12) + 0.0).tolist(),  # Adding 0 turns -0.0 into 0.0.
    )


def _relative(path: Path, place: Path) -> str:
    return Path(os.path.relpath(path.absolute(), place)).as_posix()


def _text(value: object) -> str:
    """Format a string or a list of strings as TOML, with the syntax of JSON strings."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
