"""Data sets with specific layouts: SurgPose, EndoVis 2017 and 2018, JIGSAWS, SurgSync, and the data sets of CaRTS.

SurgPose      NNNNNN/{regular,green}/{left,right}_video.mp4, api_jp_data.yaml, StereoCalibrationDVRK.ini
EndoVis       {instrument_dataset_N,seq_N}/{left_frames,right_frames}/frame000.png, camera_calibration.txt
JIGSAWS       TASK/kinematics/AllGestures/TRIAL.txt (76 columns), TASK/video/TRIAL_capture{1,2}.avi
SurgSync      clips: image/{left,right}/I.png, kinematic/PSM1/I.json, camera_calibration/, hand_eye_calibration/
              episodes: video_raw/stereo_{left,right}.mkv, PSM1.parquet, calibration/{left.yaml,hand_eye/}
CTS           SET/DOMAIN/images_l/I.png, SET/green_screen/{ground_truth_l/I.png, psm1_js.npy, psm2_js.npy}
AMBF          VIDEO/{images,segmentations}/I.png, VIDEO/kinematics.npy (eight columns per arm, the last two of the jaw)
SegSTRONG-C   SUBSET/DOMAIN/{left,right}/I.png, SUBSET/ground_truth/{left,right}/I.png, no kinematics
"""

import re
import shlex
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ...errors import SequenceError
from ...files.reading import TABLE, VALUES, parse_yaml, read_text
from ...model.psm_kinematics import JOINT_NAMES
from ...wording import counted, listed
from ..images import mask_remarks, read_mask, spread_files
from ..importing.cameras import (
    Images,
    calibration_of,
    cameras_of,
    common_ids,
    files_with,
    find_images,
    image_files,
    subfolders,
)
from ..importing.columns import order_of_names
from ..importing.foreign_tables import TABLE_SUFFIXES, read_array, read_foreign_table
from ..importing.found import (
    FoundArm,
    FoundCamera,
    FoundRecording,
    Import,
    PartError,
    Source,
    read_json,
    well_formed,
)
from ..importing.joint_units import in_si, psm_joints
from ..importing.logs import ArmLog, arm_from_log, track
from ..importing.row_matching import by_rows, frame_times

_JIGSAWS_COLUMNS = 76
_JIGSAWS_ARMS = {"PSM_left": 38, "PSM_right": 57}
"""Arm -> index of its first column: x y z, R by rows, two velocities and the gripper angle."""
_JIGSAWS_RATE = 30.0
_LISTED = 12
"""Maximum number of trials listed in an error."""
_ENDOVIS_PART = (320, 28, 1280, 1024)
"""Left, top, width and height of the picture inside EndoVis frames of 1920 x 1080 [px]."""


def _surgpose_folder(path: Path) -> Path | None:
    """Folder with the videos of a trajectory."""
    for folder in (path / "regular", path / "green", path):
        if (folder / "left_video.mp4").is_file():
            return folder
    return None


def _read_surgpose(path: Path, job: Import) -> FoundRecording:
    folder = _surgpose_folder(path)
    assert folder is not None
    images = {side: find_images(folder / f"{side}_video.mp4") for side in ("left", "right")}
    calibration = next(iter(sorted(path.rglob("StereoCalibrationDVRK.ini"))), None)
    cameras = cameras_of(images, job, dict.fromkeys(images, calibration) if calibration else {})
    ids = common_ids(images, path)
    file = min(path.rglob("api_jp_data.yaml"))
    with well_formed(f"{file} does not map frames to the joint positions of each arm"):
        rows = {int(frame): dict(row) for frame, row in parse_yaml(read_text(file, VALUES)).items()}
    wanted = set(job.options.arms.values()) or {"PSM1", "PSM2", "PSM3"}
    names = sorted({str(arm) for row in rows.values() for arm in row} & wanted)
    if not names:
        problem = f"{file} has no joint positions of {', '.join(sorted(wanted))}. Copy it again, or choose other arms."
        raise PartError("recording", problem, "Use --arms.")
    arms = []
    for recorded in names:
        own = {frame: row[recorded] for frame, row in rows.items() if recorded in row}
        with well_formed(f"{file}: joint positions of {recorded} are not numbers"):
            log = track([*own], [[*map(float, values[:6])] for values in own.values()])
        if log is None or log.values.shape[1] != 6:
            raise SequenceError(f"{file}: {recorded} needs six joint positions in every frame. Copy it again.")
        arms.append(arm_from_log(ArmLog(job.arm_name(recorded) or recorded, joints=log), job))
    times = frame_times(images["left"], ids, job).times
    if len(rows) != len(ids):
        text = f"{file.name} has {len(rows)} rows, and the videos have {len(ids)} images."
        job.warning(f"{text} Each row is assigned to the image with the same number. Check the delay.")
    found, kept_ids, kept = by_rows(arms, ids, job, times)
    job.warning(
        "the kinematics of SurgPose need compensation, its base frames differ between trajectories, and in many "
        "trajectories the rows are up to 71 frames late.",
        remedy="Estimate the delay with carts time-offset.",
    )
    numbered = [replace(camera, numbers=kept) for camera in cameras]
    return job.recording("a trajectory of SurgPose", path.name, numbered, found, kept_ids, found[0].times)


def _detect_endovis(path: Path) -> bool:
    """Whether a folder is a sequence of EndoVis, which has no kinematics."""
    calibrated = (path / "camera_calibration.txt").is_file()
    return bool(image_files(path / "left_frames")) and (calibrated or not files_with(path, TABLE_SUFFIXES))


def _read_endovis(path: Path, job: Import) -> FoundRecording:
    folders = {side: path / f"{side}_frames" for side in ("left", "right")}
    images = {side: find_images(folder) for side, folder in folders.items() if image_files(folder)}
    ids = common_ids(images, path)
    cameras = []
    for camera in cameras_of(images, job.with_options(calibration={})):
        shown = camera
        if camera.size == (1920, 1080):
            shown = replace(camera, crop=_ENDOVIS_PART, size=_ENDOVIS_PART[2:])
            left, top, width, height = _ENDOVIS_PART
            job.guessed(f"the part of {width} x {height} px at {left}, {top} is used, without the frame.", camera.name)
        calibrated = calibration_of(shown, job)
        cameras.append(_endovis_calibration(calibrated, path / "camera_calibration.txt", job))
    job.missing("labels of EndoVis are class numbers, not 0 and 255, and are left out.")
    return job.recording("a sequence of EndoVis", path.name, cameras, (), ids, None)


def _endovis_calibration(camera: FoundCamera, file: Path, job: Import) -> FoundCamera:
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
        problem = f"{file} has no readable calibration (missing or invalid: {error}). Copy it again, or choose another."
        remedy = f"Use --calibration {camera.name} FILE."
        raise PartError("calibration", problem, remedy, about=camera.name) from error
    job.found(f"calibration from {file.name}.", camera.name)
    return replace(camera, intrinsics=(fx, fy, cx, cy), distortion=distortion, T_camera_world=T)


def jigsaws_trials(folder: Path) -> tuple[Path, ...]:
    """Kinematics files of the JIGSAWS trials in the data set's root, a task or one of its folders, sorted by name."""
    levels = ("", "AllGestures", "kinematics/AllGestures", "*/kinematics/AllGestures", "*/*/kinematics/AllGestures")
    try:
        found = {file for level in levels for file in folder.glob(f"{level}/*.txt" if level else "*.txt")}
    except OSError:
        return ()
    wanted = (file for file in found if file.parts[-3:-1] == ("kinematics", "AllGestures") and file.is_file())
    return tuple(sorted(file for file in wanted if not file.name.startswith(".")))


def _detect_jigsaws(path: Path) -> bool:
    if path.is_dir():
        return bool(jigsaws_trials(path))
    return path.suffix == ".txt" and path.is_file() and path.parent.parent.name == "kinematics"


def _read_jigsaws(path: Path, job: Import) -> FoundRecording:
    trials = jigsaws_trials(path) if path.is_dir() else (path,)
    if len(trials) > 1:
        names = listed([trial.stem for trial in trials], _LISTED)
        problem = f"{path} has {len(trials)} trials of JIGSAWS: {names}. Import one of them."
        raise PartError("recording", problem, f"Command: carts import {shlex.quote(str(trials[0]))}")
    if not trials:
        raise SequenceError(
            f"{path} has no kinematics/AllGestures/TRIAL.txt. Give the root folder of JIGSAWS, or a trial."
        )
    path = trials[0]
    with well_formed(f"{path} is not a table of numbers"):
        rows = np.array([line.split() for line in read_text(path, TABLE).splitlines() if line.strip()], np.float64)
    if rows.ndim != 2 or rows.shape[1] != _JIGSAWS_COLUMNS:
        raise SequenceError(f"{path} has the shape {rows.shape}; a trial of JIGSAWS has {_JIGSAWS_COLUMNS} columns.")
    videos = path.parents[2] / "video"
    found = {side: videos / f"{path.stem}_capture{number}.avi" for number, side in ((1, "left"), (2, "right"))}
    images = {side: find_images(video) for side, video in found.items() if video.is_file()}
    if not images:
        raise SequenceError(f"{videos} has no {path.stem}_capture1.avi. Also copy the videos of the task.")
    cameras = cameras_of(images, job)
    ids = common_ids(images, videos)
    rate = job.options.frame_rate or _JIGSAWS_RATE
    times = np.arange(len(rows), dtype=float) / rate
    if len(rows) != len(ids):
        job.warning(f"{path.name} has {len(rows)} rows, and the videos have {len(ids)} images.")
    arms: list[FoundArm] = []
    for arm, first in _JIGSAWS_ARMS.items():
        R = rows[:, first + 3 : first + 12].reshape(-1, 3, 3)
        if np.abs(np.linalg.det(R) - 1).max() > 0.05:
            raise SequenceError(f"{path}: columns {first + 4} to {first + 12} are not rotations. Copy it again.")
        poses = track(times, np.column_stack([rows[:, first : first + 3], Rotation.from_matrix(R).as_quat()]))
        seen, jaw = arm in job.options.base, track(times, rows[:, first + 18])
        log = ArmLog(arm, None, jaw, poses if seen else None, None if seen else poses, opencv_axes=True)
        arms.append(arm_from_log(log, job))
    taken = frame_times(next(iter(images.values())), ids, job.with_options(frame_rate=rate)).times
    return job.recording("a trial of JIGSAWS", path.stem, cameras, arms, ids, taken)


SURGPOSE = Source(
    "surgpose",
    "a trajectory of SurgPose",
    "a folder with api_jp_data.yaml and regular/left_video.mp4",
    lambda path: _surgpose_folder(path) is not None and any(path.rglob("api_jp_data.yaml")),
    ("time_offset", "frame_rate"),
    _read_surgpose,
)
ENDOVIS = Source(
    "endovis",
    "a sequence of EndoVis 2017 or 2018",
    "a folder with left_frames/",
    _detect_endovis,
    (),
    _read_endovis,
)
JIGSAWS = Source(
    "jigsaws",
    "a trial of JIGSAWS",
    "a file TASK/kinematics/AllGestures/TRIAL.txt, or a folder with such files",
    _detect_jigsaws,
    ("time_offset", "frame_rate"),
    _read_jigsaws,
)


SURGSYNC_ARMS = ("PSM1", "PSM2", "PSM3")
"""Arms of SurgSync's recordings."""
_SIDES = ("left", "right")
_CALIBRATION_FOLDERS = ("calibration", "camera_calibration")
_TRACKS = ("joints", "poses", "local_poses", "jaw")
_LENGTHS = {"joints": 6, "poses": 7, "local_poses": 7, "jaw": 1}


def _detect_surgsync(path: Path) -> bool:
    packed = (path / "video_raw").is_dir() and any((path / f"{arm}.parquet").is_file() for arm in SURGSYNC_ARMS)
    return packed or (bool(image_files(path / "image/left")) and (path / "kinematic").is_dir())


def is_packed(path: Path) -> bool:
    """Whether a recording of SurgSync is a packed episode; otherwise it is a raw clip."""
    return (path / "video_raw").is_dir()


def surgsync_tracks(path: Path, arm: str, ids: tuple[str, ...]) -> dict[str, Any]:
    """Time series (`Track`) of an arm in a recording of SurgSync: `joints`, `jaw`, `poses` and `local_poses`; missing
    series are None or absent.

    Args:
        path: folder of the recording.
        arm: name of the arm in the recording.
        ids: names of the frames of a raw clip.

    Returns:
        The series; times are row numbers of a packed episode, or indices into `ids` of a raw clip.
    """
    return _packed(path, arm) if is_packed(path) else _raw(path, arm, ids)


def _read_surgsync(path: Path, job: Import) -> FoundRecording:
    packed = is_packed(path)
    places = {side: path / f"video_raw/stereo_{side}.mkv" if packed else path / "image" / side for side in _SIDES}
    images = {side: find_images(place) for side, place in places.items() if place.exists()}
    if not images:
        raise SequenceError(f"{path} has neither video_raw/stereo_left.mkv nor image/left. Copy the recording again.")
    calibrations = {side: [path / folder / f"{side}.yaml" for folder in _CALIBRATION_FOLDERS] for side in images}
    cameras = cameras_of(
        images, job, {side: file for side, files in calibrations.items() for file in files if file.is_file()}
    )
    if (extrinsics := next(iter(sorted(path.rglob("stereo_calib_params.json"))), None)) is not None:
        cameras = tuple(_with_extrinsics(camera, extrinsics, job) for camera in cameras)
    ids = common_ids(images, path)
    files = sorted(path.rglob("*-registration-open-cv.json")) or sorted(path.rglob("*-registration-dVRK.json"))
    job = job.with_options(base={**{file.name.partition("-")[0]: file for file in files}, **job.options.base})
    arms: list[FoundArm] = []
    for recorded in SURGSYNC_ARMS:
        if (name := job.arm_name(recorded)) is None:
            continue
        tracks = surgsync_tracks(path, recorded, ids)
        if any(found is not None for found in tracks.values()):
            arms.append(arm_from_log(ArmLog(name, **tracks), job))
    if not arms:
        raise SequenceError(f"{path} has no kinematics of {', '.join(SURGSYNC_ARMS)}. Copy the recording again.")
    times = frame_times(next(iter(images.values())), ids, job).times
    found, kept_ids, kept = by_rows(arms, ids, job, times)
    if packed:
        cameras = tuple(replace(camera, numbers=kept) for camera in cameras)
    kind = "an episode of SurgSync" if packed else "a clip of SurgSync"
    return job.recording(kind, path.name, cameras, found, kept_ids, found[0].times)


def _with_extrinsics(camera: FoundCamera, file: Path, job: Import) -> FoundCamera:
    """Right camera with the pose of the stereo calibration, if the file has R and T."""
    if camera.name != "right":
        return camera
    content = read_json(file)
    try:
        R = np.array(content["R"], np.float64).reshape(3, 3)
        T = np.array(content["T"], np.float64).reshape(3)
    except (KeyError, TypeError, ValueError):
        job.warning(f"{file} has no R and T; the pose of the right camera is from right.yaml only.", camera.name)
        return camera
    T = T * (1e-3 if np.linalg.norm(T) > 1.0 else 1.0)
    return replace(camera, T_camera_world=np.vstack([np.column_stack([R, T]), [0.0, 0.0, 0.0, 1.0]]))


def _packed(path: Path, arm: str) -> dict[str, Any]:
    """Time series of an arm from its table; times are row numbers."""
    file = path / f"{arm}.parquet"
    if not file.is_file():
        return dict.fromkeys(_TRACKS)
    table = read_foreign_table(file)
    given = [table.columns.get(f"measured_js.name.{index}") for index in range(len(JOINT_NAMES))]
    order = order_of_names(tuple(str(cells[0]) for cells in given if cells is not None))
    pose = [*(f"position.{index}" for index in range(3)), *(f"orientation.{index}" for index in range(4))]
    columns = {
        "joints": [f"measured_js.position.{index}" for index in order or range(len(JOINT_NAMES))],
        "poses": [f"measured_cp.{part}" for part in pose],
        "local_poses": [f"local_measured_cp.{part}" for part in pose],
        "jaw": ["jaw.measured_position"],
    }
    return {
        role: track(np.arange(len(table)), np.column_stack([table.numbers(name) for name in names]))
        for role, names in columns.items()
        if set(names) <= set(table.columns)
    }


def _raw(path: Path, arm: str, ids: tuple[str, ...]) -> dict[str, Any]:
    """Time series of an arm from one JSON file per frame; times are indices into `ids`."""
    folder = path / "kinematic" / arm
    rows: dict[str, list[tuple[float, ...]]] = {role: [] for role in _TRACKS}
    for position, frame in enumerate(ids):
        file = folder / f"{frame}.json"
        if not file.is_file():
            continue
        content = read_json(file)
        with well_formed(f"{file} is not the kinematics of a frame"):
            top = content[0] if isinstance(content, list) else content
            body = top["arm"]
            measured = body["measured_data"]
            # Offline recordings store the jaw within the arm.
            jaw = top.get("jaw") or body.get("jaw") or {}
            values = {
                "joints": _named_positions(measured.get("measured_js") or {}),
                "poses": _pose(measured.get("measured_cp")),
                "local_poses": _pose(measured.get("local_measured_cp")),
                "jaw": (jaw.get("measured_data") or {}).get("position"),
            }
            for role, numbers in values.items():
                if numbers is not None and len(numbers) >= _LENGTHS[role]:
                    rows[role].append((float(position), *map(float, numbers[: _LENGTHS[role]])))
    return {role: track([row[0] for row in found], [row[1:] for row in found]) for role, found in rows.items()}


def _named_positions(state: dict[str, Any]) -> list[float] | None:
    """Joint positions in the order of the PSM, by their names if present."""
    positions = state.get("position")
    order = order_of_names(tuple(map(str, state.get("name") or ())))
    return positions if positions is None or order is None else [positions[index] for index in order]


def _pose(block: Any) -> list[float] | None:
    if not block or block.get("position") is None or block.get("orientation") is None:
        return None
    return [*block["position"][:3], *block["orientation"][:4]]


SURGSYNC = Source(
    "surgsync",
    "a raw clip or packed episode of SurgSync",
    "a folder with video_raw/ and PSM1.parquet, or with image/left and kinematic/",
    _detect_surgsync,
    ("time_offset", "frame_rate"),
    _read_surgsync,
)


_TRUTH = "green_screen"
_FIRST = ("regular",)
_AMBF_COLUMNS = 8
_AMBF_FIELD_OF_VIEW = 1.2
"""Vertical field of view of the simulated camera [rad]."""
_DECIMETRES_FROM = 0.3
"""Insertion, in the unit of the file, above which the lengths of a simulation are assumed to be in decimetres."""


def _ordered(names: Iterable[str]) -> list[str]:
    """Sort domains, the regular domain first."""
    return sorted(names, key=lambda name: (name not in _FIRST, name))


def _domain_images(path: Path, domains: list[str], folders: dict[str, str], job: Import) -> dict[str, Images]:
    """Images of each camera, with one pattern for all domains and the frames that all domains have."""
    images = {}
    for camera, folder in folders.items():
        if not all(image_files(path / domain / folder) for domain in domains):
            continue
        found = {domain: find_images(path / domain / folder) for domain in domains}
        first = found[domains[0]]
        if any(each.pattern != first.pattern or each.size != first.size for each in found.values()):
            raise SequenceError(
                f"{path}: names or sizes of the images of {folder} differ between domains. Make them equal."
            )
        ids = common_ids(found, path)
        if any(len(each.ids) != len(ids) for each in found.values()):
            text = f"frames that are not in all domains ({', '.join(domains)}) are left out"
            job.warning(f"{text}, so {counted(len(ids), 'frame')} can be used.", camera)
        place = "{domain}" if len(domains) > 1 else domains[0]
        images[camera] = Images(path, f"{place}/{folder}/{first.pattern}", ids, first.size)
    if not images:
        raise SequenceError(
            f"{path}: no camera has images in all domains ({', '.join(domains)}). Remove the incomplete domains."
        )
    return images


def _with_masks(camera: FoundCamera, folder: Path, ids: tuple[str, ...], job: Import) -> FoundCamera:
    """Camera with the masks of a folder, if these are white on black."""
    if not image_files(folder):
        return camera
    masks = find_images(folder)
    shared = [frame for frame in ids if frame in set(masks.ids)]
    if not shared:
        job.warning(f"masks in {folder} are left out, since none belongs to a frame.", camera.name)
        return camera
    files = [folder / masks.pattern.format(frame=frame) for frame in shared]
    try:
        for file in spread_files(files):
            read_mask(file)
    except SequenceError as error:
        job.missing(f"masks in {folder} are left out: {error}", camera.name)
        return camera
    for text in mask_remarks(files):
        job.found(text, camera.name)
    return replace(camera, masks=str(folder / masks.pattern), sparse_masks=len(shared) < len(ids))


def _read_cts(path: Path, job: Import) -> FoundRecording:
    domains = _ordered(each.name for each in subfolders(path) if image_files(each / "images_l"))
    images = _domain_images(path, domains, {"left": "images_l", "right": "images_r"}, job)
    ids = common_ids(images, path)
    cameras = [
        _with_masks(camera, path / _TRUTH / f"ground_truth_{camera.name[0]}", ids, job)
        for camera in cameras_of(images, job)
    ]
    arms = []
    for name in ("PSM1", "PSM2", "PSM3"):
        file = path / _TRUTH / f"{name.lower()}_js.npy"
        if file.is_file():
            table = read_foreign_table(file)
            values = np.stack(list(table.columns.values())[:6], 1).astype(np.float64)
            arms.append(_arm(name, values, ids, file, job))
    if not arms:
        raise SequenceError(f"{path / _TRUTH} has no psm1_js.npy or psm2_js.npy. Copy the whole set again.")
    found, times = _timed(arms, ids, next(iter(images.values())), job)
    return job.recording("a set of CTS", path.name, cameras, found, ids, times, domains=_domains(domains))


def _domains(names: list[str]) -> dict[str, str]:
    return {name: name for name in names} if len(names) > 1 else {}


def _timed(
    arms: list[FoundArm], ids: tuple[str, ...], images: Images, job: Import
) -> tuple[tuple[FoundArm, ...], np.ndarray | None]:
    """Arms with rows at the times of their images, and these times [s]; None for the times if neither the
    image names nor a given frame rate determines them."""
    times = frame_times(images, ids, job).times
    rows = np.arange(len(ids), dtype=float)
    found, _, _ = by_rows([replace(arm, times=rows) for arm in arms], ids, job, times)
    return found, times


def _arm(name: str, values: np.ndarray, ids: tuple[str, ...], file: Path, job: Import) -> FoundArm:
    """Joint positions of the frames: row n belongs to the n-th frame if the counts are equal, else to frame number
    n."""
    if values.shape[1] < 6 or not np.isfinite(values).all():
        raise SequenceError(f"{file} does not have six finite joint positions per row. Copy it again.")
    numbers = np.array([int(frame) for frame in ids])
    if len(values) == len(ids):
        rows = np.arange(len(ids))
    elif numbers.max() < len(values):
        rows = numbers
    else:
        raise SequenceError(
            f"{file} has {len(values)} rows for {len(ids)} images, whose highest number is {numbers.max()}. "
            "Remove images without kinematics."
        )
    columns = (*JOINT_NAMES, "jaw")[: values.shape[1]]
    values = in_si(values, psm_joints(name, columns, job), job, arm=name)
    return FoundArm(name, columns, values[rows], None, job.options.robot.get(name, FoundArm.robot))


def _read_ambf(path: Path, job: Import) -> FoundRecording:
    images = find_images(path / "images")
    (camera,) = cameras_of({"camera": images}, job)
    if camera.intrinsics is None:
        width, height = images.size
        focal = height / 2 / np.tan(_AMBF_FIELD_OF_VIEW / 2)
        camera = replace(camera, intrinsics=(focal, focal, width / 2, height / 2), pixel_center=0.5)
        text = f"the vertical field of view is {_AMBF_FIELD_OF_VIEW} rad."
        job.guessed(text, camera.name, "--calibration camera FILE")
    camera = _with_masks(camera, path / "segmentations", images.ids, job)
    file = path / "kinematics.npy"
    values = read_array(file)
    if values.ndim != 2 or values.shape[1] % _AMBF_COLUMNS or values.dtype.kind not in "fiu":
        raise SequenceError(f"{file} has the shape {values.shape}; expected: eight columns of numbers per arm.")
    arms = []
    for number in range(values.shape[1] // _AMBF_COLUMNS):
        own = values[:, _AMBF_COLUMNS * number : _AMBF_COLUMNS * (number + 1)].astype(np.float64)
        joints = np.column_stack([own[:, :6], own[:, 6] + own[:, 7]])
        chosen = job
        if np.abs(joints[:, 2]).max() > _DECIMETRES_FROM and job.options.length_unit is None:
            chosen = job.with_options(length_unit="dm")
            job.guessed("insertion is in decimetres.", f"PSM{number + 1}", "--length-unit m")
        arms.append(_arm(f"PSM{number + 1}", joints, images.ids, file, chosen))
    found, times = _timed(arms, images.ids, images, job)
    return job.recording("a simulated video (AMBF)", path.name, (camera,), found, images.ids, times)


def _is_subset(path: Path) -> bool:
    return (path / "ground_truth").is_dir() and any(
        image_files(each / "left") for each in subfolders(path) if each.name != "ground_truth"
    )


def _subsets(path: Path) -> list[Path]:
    level, found = [path], []
    for _ in range(4):
        found += [each for each in level if _is_subset(each)]
        level = [each for folder in level for each in subfolders(folder)][:500]
    return found


def _read_segstrong(path: Path, job: Import) -> FoundRecording:
    if not _is_subset(path):
        subsets = ", ".join(str(each.relative_to(path)) for each in _subsets(path))
        raise SequenceError(f"{path} has several recordings. Import one of them: {subsets}.")
    folders = [each for each in subfolders(path) if each.name != "ground_truth"]
    domains = _ordered(each.name for each in folders if image_files(each / "left"))
    images = _domain_images(path, domains, {"left": "left", "right": "right"}, job)
    ids = common_ids(images, path)
    cameras = [_with_masks(camera, path / "ground_truth" / camera.name, ids, job) for camera in cameras_of(images, job)]
    return job.recording("a subset of SegSTRONG-C", path.name, cameras, (), ids, None, domains=_domains(domains))


CTS = Source(
    "cts",
    "a set of CaRTS (CTS)",
    "a folder with green_screen/psm1_js.npy and DOMAIN/images_l",
    lambda path: any(image_files(each / "images_l") for each in subfolders(path)) and (path / _TRUTH).is_dir(),
    ("time_offset", "frame_rate"),
    _read_cts,
)
AMBF = Source(
    "ambf",
    "a simulated video of CaRTS (AMBF)",
    "a folder with kinematics.npy and images/",
    lambda path: (path / "kinematics.npy").is_file() and bool(image_files(path / "images")),
    ("time_offset", "frame_rate"),
    _read_ambf,
)
SEGSTRONG_C = Source(
    "segstrong-c",
    "a subset of SegSTRONG-C",
    "a folder with ground_truth/ and DOMAIN/left",
    lambda path: path.is_dir() and bool(_subsets(path)),
    (),
    _read_segstrong,
)
