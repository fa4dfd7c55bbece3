"""Public data sets with layouts of their own: SurgPose, EndoVis 2017 and 2018, JIGSAWS.

SurgPose   NNNNNN/{regular,green}/{left,right}_video.mp4, api_jp_data.yaml, StereoCalibrationDVRK.ini
EndoVis    {instrument_dataset_N,seq_N}/{left_frames,right_frames}/frame000.png, camera_calibration.txt
JIGSAWS    TASK/kinematics/AllGestures/TRIAL.txt (76 columns), TASK/video/TRIAL_capture{1,2}.avi
"""

import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...errors import SequenceError
from ...files.reading import TABLE, VALUES, parse_yaml, read_text
from ...settings.interchange import ImportOptions
from ...wording import listed
from ..importing.cameras import cameras_of, common_ids, find_images, image_files
from ..importing.found import FoundArm, FoundCamera, FoundRecording, Notes, Source
from ..importing.logs import ArmLog, arm_from_log, track
from ..importing.row_matching import by_rows, frame_times

_JIGSAWS_COLUMNS = 76
_JIGSAWS_ARMS = {"PSM_left": 38, "PSM_right": 57}
"""Arm -> its first column, from 0: x y z, R by rows, two velocities and the gripper's angle."""
_JIGSAWS_RATE = 30.0
_LISTED = 12
"""Largest number of trials listed in an error."""
_ENDOVIS_PART = (320, 28, 1280, 1024)
"""Left, top, width and height of the picture inside EndoVis frames of 1920 x 1080 [px]."""


def _surgpose_folder(path: Path) -> Path | None:
    """Folder with the videos of a trajectory."""
    for folder in (path / "regular", path / "green", path):
        if (folder / "left_video.mp4").is_file():
            return folder
    return None


def _detect_surgpose(path: Path) -> bool:
    return _surgpose_folder(path) is not None and any(path.rglob("api_jp_data.yaml"))


def _read_surgpose(path: Path, options: ImportOptions) -> FoundRecording:
    notes = Notes()
    folder = _surgpose_folder(path)
    assert folder is not None
    images = {side: find_images(folder / f"{side}_video.mp4") for side in ("left", "right")}
    calibration = next(iter(sorted(path.rglob("StereoCalibrationDVRK.ini"))), None)
    cameras = cameras_of(images, options, notes, dict.fromkeys(images, calibration) if calibration else {})
    ids = common_ids(list(images.values()))
    file = next(iter(sorted(path.rglob("api_jp_data.yaml"))))
    rows = _yaml_rows(file)
    rename = {recorded: name for name, recorded in options.arms.items()}
    names = sorted({str(arm) for row in rows.values() for arm in row} & (set(rename) or {"PSM1", "PSM2", "PSM3"}))
    if not names:
        raise SequenceError(
            f"{file} has no joint positions of PSM1, PSM2 or PSM3. Copy it again, or name arms: --arms."
        )
    arms = []
    for recorded in names:
        try:
            log = track(
                [(float(frame), *map(float, row[recorded][:6])) for frame, row in rows.items() if recorded in row]
            )
        except (TypeError, ValueError) as error:
            raise SequenceError(
                f"{file}: joint positions of {recorded} are no numbers ({error}). Copy it again."
            ) from error
        if log is None or log.values.shape[1] != 6:
            raise SequenceError(f"{file}: {recorded} needs six joint positions in every frame. Copy it again.")
        arms.append(arm_from_log(ArmLog(str(rename.get(recorded, recorded)), joints=log), options, notes))
    times = frame_times(images["left"], ids, options, notes).times
    if len(rows) != len(ids):
        text = f"{file.name} has {len(rows)} rows and there are {len(ids)} images."
        notes.warning(f"{text} Each row is taken for the image of its number; look at the delay.")
    found, kept_ids, kept = by_rows(arms, ids, notes, times)
    numbered = tuple(replace(camera, numbers=kept) for camera in cameras)
    text = (
        "the kinematics of SurgPose need compensation, its base frames differ from trajectory to trajectory, and "
        "rows of many are up to 71 frames late: estimate the delay with carts time-offset."
    )
    notes.warning(text)
    return FoundRecording(
        "a trajectory of SurgPose",
        path.name,
        numbered,
        found,
        kept_ids,
        found[0].times,
        tuple(notes),
        options.time_offset or 0.0,
    )


def _yaml_rows(file: Path) -> dict[int, dict]:
    try:
        content = parse_yaml(read_text(file, VALUES))
        return {int(frame): dict(row) for frame, row in content.items()}
    except (OSError, AttributeError, TypeError, ValueError) as error:
        text = " ".join(str(error).split())
        raise SequenceError(f"{file} is no YAML file of frames with joints by arm ({text}). Copy it again.") from error


def _detect_endovis(path: Path) -> bool:
    return bool(image_files(path / "left_frames"))


def _read_endovis(path: Path, options: ImportOptions) -> FoundRecording:
    notes = Notes()
    images = {
        side: find_images(path / f"{side}_frames") for side in ("left", "right") if image_files(path / f"{side}_frames")
    }
    ids = common_ids(list(images.values()))
    if not ids:
        raise SequenceError(f"{path}: no frame is in both left_frames and right_frames. Copy the sequence again.")
    cameras = []
    for camera in cameras_of(images, options, notes):
        framed = camera.size == (1920, 1080)
        shown = replace(camera, crop=_ENDOVIS_PART, size=_ENDOVIS_PART[2:]) if framed else camera
        cameras.append(_endovis_calibration(shown, path / "camera_calibration.txt", notes))
    notes.missing("labels of EndoVis are of classes, not 0 and 255, and are left out.")
    return FoundRecording("a sequence of EndoVis", path.name, tuple(cameras), (), ids, None, tuple(notes))


def _endovis_calibration(camera: FoundCamera, file: Path, notes: Notes) -> FoundCamera:
    if camera.intrinsics is not None or not file.is_file():
        return camera
    number = 1 if camera.name == "right" else 0
    try:
        text = read_text(file, VALUES)
        values = {
            match[1]: [float(value) for value in match[2].replace(",", " ").split()]
            for match in re.finditer(
                r"^\s*([A-Za-z]+[-\w]*)\s*[:=]\s*\[?([-+\d.eE,\s]*?)\]?\s*(?://.*)?$", text, re.MULTILINE
            )
        }
        (fx, fy), (cx, cy) = values[f"Camera-{number}-F"][:2], values[f"Camera-{number}-C"][:2]
        distortion = tuple(values[f"Camera-{number}-K"][:5])
        T = np.eye(4)
        if number == 1:
            T[:3, :3] = Rotation.from_rotvec(values["Extrinsic-Omega"][:3]).as_matrix()
            T[:3, 3] = np.array(values["Extrinsic-T"][:3]) * 1e-3
    except (OSError, ValueError, KeyError) as error:
        raise SequenceError(f"{file} lacks a readable {error}. Copy it again, or give --calibration.") from error
    notes.found(f"calibration of {camera.name}: from {file.name}.")
    return replace(camera, intrinsics=(fx, fy, cx, cy), distortion=distortion, T_camera_world=T)


def jigsaws_trials(folder: Path) -> tuple[Path, ...]:
    """Kinematics of the JIGSAWS trials in a folder, sorted by name.

    Args:
        folder: the root of the data set, one of its tasks, or a folder of a task.
    """
    levels = ("", "AllGestures", "kinematics/AllGestures", "*/kinematics/AllGestures", "*/*/kinematics/AllGestures")
    try:
        found = {file for level in levels for file in folder.glob(f"{level}/*.txt" if level else "*.txt")}
    except OSError:
        return ()
    return tuple(sorted(file for file in found if not file.name.startswith(".") and _is_trial(file)))


def _is_trial(file: Path) -> bool:
    return file.parts[-3:-1] == ("kinematics", "AllGestures") and file.is_file()


def _detect_jigsaws(path: Path) -> bool:
    if path.is_dir():
        return bool(jigsaws_trials(path))
    return path.suffix == ".txt" and path.is_file() and path.parent.parent.name == "kinematics"


def _read_jigsaws(path: Path, options: ImportOptions) -> FoundRecording:
    trials = jigsaws_trials(path) if path.is_dir() else (path,)
    if len(trials) > 1:
        names = listed([trial.stem for trial in trials], _LISTED)
        raise SequenceError(
            f"{path} has {len(trials)} trials of JIGSAWS: {names}. Import one of them: "
            f"carts import {shlex.quote(str(trials[0]))}"
        )
    if not trials:
        raise SequenceError(f"{path} has no kinematics/AllGestures/TRIAL.txt. Give the root of JIGSAWS, or a trial.")
    path = trials[0]
    notes = Notes()
    try:
        rows = np.array([line.split() for line in read_text(path, TABLE).splitlines() if line.strip()], np.float64)
    except (OSError, ValueError) as error:
        raise SequenceError(f"{path} is no table of numbers ({error}). Copy it again.") from error
    if rows.ndim != 2 or rows.shape[1] != _JIGSAWS_COLUMNS:
        raise SequenceError(f"{path} has the shape {rows.shape}; a trial of JIGSAWS has {_JIGSAWS_COLUMNS} columns.")
    videos = path.parents[2] / "video"
    found = {side: videos / f"{path.stem}_capture{number}.avi" for number, side in ((1, "left"), (2, "right"))}
    images = {side: find_images(video) for side, video in found.items() if video.is_file()}
    if not images:
        raise SequenceError(f"{videos} has no {path.stem}_capture1.avi. Copy the videos of the task too.")
    cameras = cameras_of(images, options, notes)
    ids = common_ids(list(images.values()))
    rate = options.frame_rate or _JIGSAWS_RATE
    times = np.arange(len(rows), dtype=float) / rate
    if len(rows) != len(ids):
        notes.warning(f"{path.name} has {len(rows)} rows and there are {len(ids)} images.")
    arms: list[FoundArm] = []
    for arm, first in _JIGSAWS_ARMS.items():
        R = rows[:, first + 3 : first + 12].reshape(-1, 3, 3)
        if np.abs(np.linalg.det(R) - 1).max() > 0.05:
            raise SequenceError(f"{path}: columns {first + 4} to {first + 12} are no rotations. Copy it again.")
        poses = np.column_stack([rows[:, first : first + 3], Rotation.from_matrix(R).as_quat()])
        seen = arm in options.base
        logged = track([(time, *pose) for time, pose in zip(times, poses, strict=True)])
        jaw = track(list(zip(times, rows[:, first + 18], strict=True)))
        log = ArmLog(
            arm, jaw=jaw, poses=logged if seen else None, local_poses=None if seen else logged, opencv_axes=True
        )
        arms.append(arm_from_log(log, options, notes))
    taken = frame_times(next(iter(images.values())), ids, replace(options, frame_rate=rate), notes).times
    offset = options.time_offset or 0.0
    return FoundRecording("a trial of JIGSAWS", path.stem, cameras, tuple(arms), ids, taken, tuple(notes), offset)


SURGPOSE = Source(
    "surgpose",
    "a trajectory of SurgPose",
    "a folder with api_jp_data.yaml and regular/left_video.mp4",
    _detect_surgpose,
    ("time_offset", "frame_rate"),
    _read_surgpose,
)
ENDOVIS = Source(
    "endovis", "a sequence of EndoVis 2017 or 2018", "a folder with left_frames/", _detect_endovis, (), _read_endovis
)
JIGSAWS = Source(
    "jigsaws",
    "a trial of JIGSAWS",
    "a file TASK/kinematics/AllGestures/TRIAL.txt, or a folder with such files",
    _detect_jigsaws,
    ("time_offset", "frame_rate"),
    _read_jigsaws,
)
