"""Copy of a SurgSync recording (raw clip or packed episode) with results in its JSON files or tables, and masks."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from ..decoders import tables
from ..errors import SequenceError
from ..files import MARKER, OutputPath, write_bytes, write_text
from ..files.decoding import decoded
from ..model.psm_kinematics import JOINT_NAMES
from ..model.robot import Robot
from ..model.scene import Arm
from ..package_imports import require_package
from ..recording import Sequence
from ..recording.importing.cameras import files_with
from ..recording.importing.foreign_tables import ForeignTable
from ..recording.importing.found import Track, read_json, well_formed
from ..recording.sources.datasets import SURGSYNC, SURGSYNC_ARMS, is_packed, surgsync_tracks
from .dataset import Dataset, ExportFrame, ExportProgress
from .encodings import mask_png
from .recording_copy import below, copy_files
from .source_tables import POSE, PoseMap, as_imported, joint_maps, matched_arms, pose_map, rows_of_frames, source_of

_MEDIA = ("image", "video_raw", "video")
_POSES = {"poses": "corrected_cp", "local_poses": "local_corrected_cp"}
"""Recorded series -> name of the corrected poses."""
_JAW = len(JOINT_NAMES)


@dataclass(frozen=True, eq=False)
class _ArmResults:
    """Results of one arm, with a row per exported frame."""

    joints: Float[ndarray, "frames 7"]
    """Joint positions [rad, m] and jaw angle [rad], NaN without a jaw."""
    std: Float[ndarray, "frames 7"]
    poses: Mapping[str, Float[ndarray, "frames 7"]]
    """Name of the corrected poses, as in `_POSES` -> tip poses: position in the unit of the recording, quaternion x y
    z w."""


def write_surgsync(dataset: Dataset, folder: OutputPath, progress: ExportProgress) -> None:
    """Write a copy of the recording of SurgSync that the sequence was imported from, with results.

    Raises:
        SequenceError: the recording is unknown, missing, not of SurgSync, or not that of the sequence.
    """
    root = source_of(dataset.recording, dataset.sequence)
    if not SURGSYNC.detect(root):
        raise SequenceError(f"{root} is not {SURGSYNC.label}: it needs {SURGSYNC.looked_for}. Choose another format.")
    if is_packed(root):
        require_package("pyarrow", "import")
    sequence = as_imported(dataset.sequence)
    arms = {arm.name: arm for arm in dataset.scene.arms if set(JOINT_NAMES) <= set(arm.robot.joint_names)}
    recorded = _series(root, sequence)
    found = matched_arms(
        arms, recorded, lambda arm, name: _pose_maps(recorded[name], arms[arm].robot, sequence.measured[arm])
    )
    if not found:
        raise SequenceError(
            f"the joint positions of {sequence.path} are not those of {root}. Give the recording from which the "
            "sequence was imported: --recording PATH."
        )
    for view in dataset.views(progress):
        target = folder / "annotation" / "carts_mask" / view.camera.name / f"{view.frame.frame_id}.png"
        write_bytes(target, mask_png(dataset.recorded_mask(view)))
    written: set[Path] = set()
    write = _write_packed if is_packed(root) else _write_raw
    for arm, (name, maps) in found.items():
        written |= write(root, folder, name, dataset, _arm_results(arms[arm], dataset.frames, maps))
    # An earlier export's description and masks are not copied.
    parts = [entry.name for entry in sorted(root.iterdir()) if entry.name not in (MARKER, "rendered")]
    skip = written | {*(root / "annotation" / "carts_mask").rglob("*")}
    copy_files(root, folder, dataset.images, parts=parts, media=_MEDIA, skip=skip)


def _series(root: Path, sequence: Sequence) -> dict[str, dict[str, Float[ndarray, "frames n"]]]:
    """Recorded arm -> role, as in `surgsync_tracks` -> values in the frames of the sequence."""
    tracks = {
        arm: {
            role: track for role, track in surgsync_tracks(root, arm, sequence.frame_ids).items() if track is not None
        }
        for arm in SURGSYNC_ARMS
    }
    rows = np.arange(len(sequence))
    if is_packed(root):
        last = max((int(track.times[-1]) for series in tracks.values() for track in series.values()), default=-1)
        rows = rows_of_frames(sequence, last + 1, None, root)
    return {arm: {role: _at_rows(track, rows) for role, track in series.items()} for arm, series in tracks.items()}


def _pose_maps(
    series: Mapping[str, Float[ndarray, "frames n"]], robot: Robot, measured: Float[ndarray, "frames dofs"]
) -> dict[str, PoseMap] | None:
    """Conversions from joint positions to the recorded poses of an arm; None if its recorded values are not the
    measured joint positions [rad, m]."""
    if (joints := series.get("joints")) is not None:
        table = ForeignTable(Path(), dict(zip(JOINT_NAMES, joints.T, strict=True)))
        columns = {name: name for name in JOINT_NAMES}
        if not joint_maps(robot, columns, table, measured, np.arange(len(measured))):
            return None
    fits = {name: pose_map(robot, POSE, series[role], measured) for role, name in _POSES.items() if role in series}
    found = {name: fit for name, fit in fits.items() if fit is not None}
    return found if found or joints is not None else None


def _at_rows(track: Track, rows: Int[ndarray, " frames"]) -> Float[ndarray, "frames n"]:
    """Values of a series in rows; NaN in rows without values."""
    found = np.full((len(rows), track.values.shape[1]), np.nan)
    place = {int(time): number for number, time in enumerate(track.times)}
    for frame, row in enumerate(rows.tolist()):
        if row in place:
            found[frame] = track.values[place[row]]
    return found


def _arm_results(arm: Arm, frames: tuple[ExportFrame, ...], maps: Mapping[str, PoseMap]) -> _ArmResults:
    names = arm.robot.joint_names
    columns = [names.index(name) for name in JOINT_NAMES]
    jaw = names.index("jaw") if "jaw" in names else None
    joints, std = np.full((2, len(frames), _JAW + 1), np.nan)
    for row, frame in enumerate(frames):
        known = (frame.joint_std or {}).get(arm.name, np.full(len(names), np.nan))
        for target, values in ((joints, frame.joint_positions[arm.name]), (std, known)):
            target[row, :_JAW] = values[columns]
            target[row, _JAW] = np.nan if jaw is None else values[jaw]
    return _ArmResults(joints, std, {name: fit.poses(joints[:, :_JAW]) for name, fit in maps.items()})


def _write_raw(root: Path, folder: OutputPath, arm: str, dataset: Dataset, results: _ArmResults) -> set[Path]:
    """Write the JSON files of an arm with `corrected_data` beside `measured_data`; returns the rewritten files."""
    position = {frame.frame_id: row for row, frame in enumerate(dataset.frames)}
    written = set()
    for file in files_with(root / "kinematic" / arm, (".json",)):
        content = read_json(file)
        with well_formed(f"{file} is not the kinematics of a frame"):
            top = content[0] if isinstance(content, list) else content
            body = top["arm"]
            jaw = top.get("jaw") or body.get("jaw")
            row = position.get(file.stem)
            body["corrected_data"] = None if row is None else _values(results, row, dataset.frames[row])
            if jaw:
                jaw["corrected_data"] = None if row is None else _state(results, row, slice(_JAW, None))
        write_text(below(folder, root, file), json.dumps(content, indent=4, ensure_ascii=False, allow_nan=False))
        written.add(file)
    return written


def _values(results: _ArmResults, row: int, frame: ExportFrame) -> dict[str, Any]:
    """Results of an arm in one frame, in the form of SurgSync's `measured_data`."""
    poses = {
        name: {"position": values[row, :3].tolist(), "orientation": values[row, 3:].tolist()}
        for name, values in results.poses.items()
    }
    return {
        "corrected_js": {"name": list(JOINT_NAMES), **_state(results, row, slice(0, _JAW))},
        **poses,
        "corrected": frame.source != "measured",
        "source": frame.source,
        "verdict": frame.verdict,
    }


def _state(results: _ArmResults, row: int, columns: slice) -> dict[str, list[float | None]]:
    """Positions and standard deviations of some joints; None if unknown."""
    both = {"position": results.joints[row, columns], "std": results.std[row, columns]}
    return {key: [None if math.isnan(value) else value for value in values.tolist()] for key, values in both.items()}


def _write_packed(root: Path, folder: OutputPath, arm: str, dataset: Dataset, results: _ArmResults) -> set[Path]:
    """Write the table of an arm with columns for the results; returns the rewritten file."""
    file = root / f"{arm}.parquet"
    with well_formed(f"table {file} cannot be read"):
        count = len(next(iter(decoded(tables.read_parquet, file).values())))
        rows = np.array([int(frame.frame_id) for frame in dataset.frames])

        def spread(values: ndarray, default: float = math.nan) -> list[Any]:
            column = np.full((count, *values.shape[1:]), default)
            column[rows] = values
            return ["numbers", column]

        def texts(values: list[str]) -> list[Any]:
            column = np.full(count, "", object)
            column[rows] = values
            return tables.text_column(column)

        corrected = np.array([frame.source != "measured" for frame in dataset.frames], float)
        columns = {
            "corrected_js.position": spread(results.joints[:, :_JAW]),
            "corrected_js.std": spread(results.std[:, :_JAW]),
            "jaw.corrected_position": spread(results.joints[:, _JAW]),
            "jaw.corrected_std": spread(results.std[:, _JAW]),
        }
        for name, values in results.poses.items():
            columns |= {f"{name}.position": spread(values[:, :3]), f"{name}.orientation": spread(values[:, 3:])}
        columns["corrected"] = ["numbers", spread(corrected, 0.0)[1].astype(bool)]
        columns["corrected.source"] = texts([frame.source for frame in dataset.frames])
        columns["corrected.verdict"] = texts([frame.verdict or "" for frame in dataset.frames])
        write_bytes(below(folder, root, file), decoded(tables.extended_parquet, file, columns))
    return {file}
