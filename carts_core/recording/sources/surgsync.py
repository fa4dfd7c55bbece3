"""SurgSync: raw clips and packed episodes, with their stereo calibration and hand-eye registration.

    clip      image/{left,right}/I.png, kinematic/PSM1/I.json, camera_calibration/left.yaml, hand_eye_calibration/
    episode   video_raw/stereo_{left,right}.mkv, PSM1.parquet, calibration/left.yaml, calibration/hand_eye/

Row n of a table, and file n of a folder, is frame n of every camera.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SequenceError
from ...files.reading import VALUES, parse_json, read_text
from ...model.psm_kinematics import JOINT_NAMES
from ...settings.interchange import ImportOptions
from ..importing.cameras import Images, cameras_of, common_ids, find_images, image_files
from ..importing.columns import order_of_names
from ..importing.foreign_tables import read_foreign_table
from ..importing.found import FoundArm, FoundCamera, FoundRecording, Notes, Source
from ..importing.logs import ArmLog, Track, arm_from_log, track
from ..importing.row_matching import by_rows, frame_times

_ARMS = ("PSM1", "PSM2", "PSM3")
_TRACKS = ("joints", "poses", "local_poses", "jaw")
_LENGTHS = {"joints": 6, "poses": 7, "local_poses": 7, "jaw": 1}


def _detect(path: Path) -> bool:
    packed = (path / "video_raw").is_dir() and any((path / f"{arm}.parquet").is_file() for arm in _ARMS)
    return packed or (bool(image_files(path / "image/left")) and (path / "kinematic").is_dir())


def _read(path: Path, options: ImportOptions) -> FoundRecording:
    notes = Notes()
    packed = (path / "video_raw").is_dir()
    images: dict[str, Images] = {}
    for side in ("left", "right"):
        place = path / f"video_raw/stereo_{side}.mkv" if packed else path / "image" / side
        if place.exists():
            images[side] = find_images(place)
    if not images:
        raise SequenceError(f"{path} has neither video_raw/stereo_left.mkv nor image/left. Copy it again, whole.")
    cameras = cameras_of(images, options, notes, _calibrations(path, tuple(images)))
    if (extrinsics := next(iter(sorted(path.rglob("stereo_calib_params.json"))), None)) is not None:
        cameras = tuple(_with_extrinsics(camera, extrinsics, notes) for camera in cameras)
    ids = common_ids(list(images.values()))
    if not ids:
        raise SequenceError(f"{path}: no frame has an image of both cameras. Copy it again, whole.")
    options = replace(options, base={**_registrations(path), **options.base})
    rename = {recorded: name for name, recorded in options.arms.items()}
    arms: list[FoundArm] = []
    for recorded in _ARMS:
        if rename and recorded not in rename:
            continue
        tracks = _packed(path, recorded) if packed else _raw(path, recorded, ids)
        if any(found is not None for found in tracks.values()):
            log = ArmLog(rename.get(recorded, recorded), **tracks)
            arms.append(arm_from_log(log, options, notes))
    if not arms:
        raise SequenceError(f"{path} has no kinematics of {', '.join(_ARMS)}. Copy it again, whole.")
    times = frame_times(next(iter(images.values())), ids, options, notes).times
    found, kept_ids, kept = by_rows(arms, ids, notes, times)
    if packed:
        cameras = tuple(replace(camera, numbers=kept) for camera in cameras)
    kind = "an episode of SurgSync" if packed else "a clip of SurgSync"
    offset = options.time_offset or 0.0
    return FoundRecording(kind, path.name, cameras, found, kept_ids, found[0].times, tuple(notes), offset)


def _calibrations(path: Path, sides: tuple[str, ...]) -> dict[str, Path]:
    places = {side: (path / "calibration" / f"{side}.yaml", path / f"camera_calibration/{side}.yaml") for side in sides}
    return {side: file for side, files in places.items() for file in files if file.is_file()}


def _registrations(path: Path) -> dict[str, Path]:
    files = sorted(path.rglob("*-registration-open-cv.json")) or sorted(path.rglob("*-registration-dVRK.json"))
    return {file.name.partition("-")[0]: file for file in files}


def _with_extrinsics(camera: FoundCamera, file: Path, notes: Notes) -> FoundCamera:
    """The right camera at its pose of the stereo calibration, if the file has R and T."""
    if camera.name != "right":
        return camera
    content = _json(file)
    try:
        R = np.array(content["R"], np.float64).reshape(3, 3)
        T = np.array(content["T"], np.float64).reshape(3)
    except (KeyError, TypeError, ValueError):
        notes.warning(f"{file} has no R and T; the right camera is placed by right.yaml alone.")
        return camera
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R, T * (1e-3 if np.linalg.norm(T) > 1.0 else 1.0)
    return replace(camera, T_camera_world=pose)


def _json(file: Path) -> Any:
    try:
        return parse_json(read_text(file, VALUES))
    except (OSError, ValueError) as error:
        raise SequenceError(f"{file} is not readable JSON ({error}). Copy it again.") from error


def _packed(path: Path, arm: str) -> dict[str, Any]:
    """Time series of an arm by rows of its table; times are row numbers."""
    file = path / f"{arm}.parquet"
    if not file.is_file():
        return dict.fromkeys(_TRACKS)
    table = read_foreign_table(file)
    given = [table.columns.get(f"measured_js.name.{index}") for index in range(len(JOINT_NAMES))]
    order = order_of_names(tuple(str(cells[0]) for cells in given if cells is not None))
    columns = {
        "joints": [f"measured_js.position.{index}" for index in order or range(len(JOINT_NAMES))],
        "poses": [
            *(f"measured_cp.position.{i}" for i in range(3)),
            *(f"measured_cp.orientation.{i}" for i in range(4)),
        ],
        "local_poses": [
            *(f"local_measured_cp.position.{index}" for index in range(3)),
            *(f"local_measured_cp.orientation.{index}" for index in range(4)),
        ],
        "jaw": ["jaw.measured_position"],
    }
    rows = np.arange(len(table), dtype=float)
    return {
        role: track(list(zip(rows, *(table.numbers(name).astype(np.float64) for name in names), strict=True)))
        for role, names in columns.items()
        if set(names) <= set(table.columns)
    }


def _raw(path: Path, arm: str, ids: tuple[str, ...]) -> dict[str, Any]:
    """Time series of an arm from a JSON file per frame; times are positions in `ids`."""
    folder = path / "kinematic" / arm
    rows: dict[str, list[tuple[float, ...]]] = {role: [] for role in _TRACKS}
    for position, frame in enumerate(ids):
        file = folder / f"{frame}.json"
        if not file.is_file():
            continue
        content = _json(file)
        try:
            top = content[0] if isinstance(content, list) else content
            body = top["arm"]
            measured = body["measured_data"]
            # Offline recordings keep the jaw inside the arm.
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
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            raise SequenceError(f"{file} is no kinematics of one frame ({error!r}). Copy it again.") from error
    found: dict[str, Track | None] = {role: track(entries) for role, entries in rows.items()}
    return found


def _named_positions(state: dict[str, Any]) -> list[float] | None:
    """Joint positions in the order of the PSM, by their names if present."""
    positions = state.get("position")
    order = order_of_names(tuple(map(str, state.get("name") or ())))
    return positions if positions is None or order is None else [positions[index] for index in order]


def _pose(block: Any) -> list[float] | None:
    if not block or block.get("position") is None or block.get("orientation") is None:
        return None
    return [*block["position"][:3], *block["orientation"][:4]]


SOURCE = Source(
    "surgsync",
    "a raw clip or packed episode of SurgSync",
    "a folder with video_raw/ and PSM1.parquet, or with image/left and kinematic/",
    _detect,
    ("time_offset", "frame_rate"),
    _read,
)
