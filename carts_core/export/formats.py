"""Export formats by name, and the kinematics formats: joint positions as CSV, NPZ or JSON, and dVRK base frames."""

import json
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..errors import CartsError
from ..files import MARKER, OutputPath, output_stream, published, published_file, write_text
from ..model.camera import T_DVRK_OPENCV
from ..recording import Sequence as Recording
from ..settings import FormatName
from .dataset import Dataset, ExportFrame, ExportProgress
from .kinematics import JOINED, joint_columns, joint_units, kinematics_csv, position_values, std_values


def _camera_poses(dataset: Dataset, frames: Sequence[ExportFrame]) -> dict[str, Float[np.ndarray, "frames 4 4"]]:
    """Moving camera -> T_camera_world of each frame [m]."""
    mounts = [dataset.sequence.mounts(frame.index) for frame in frames]
    return {
        camera.name: np.stack([camera.T_camera_world @ one[camera.name] for one in mounts])
        for camera in dataset.scene.cameras
        if camera.name in dataset.sequence.moving_cameras
    }


def write_kinematics_csv(dataset: Dataset, path: OutputPath, progress: ExportProgress) -> None:
    """Write a CSV table for `read_kinematics_csv` and `carts export --kinematics`."""
    write_text(path, kinematics_csv(dataset.scene, progress.track(dataset.frames)))


def write_kinematics_npz(dataset: Dataset, path: OutputPath, progress: ExportProgress) -> None:
    """Write a NumPy archive (NPZ) without pickled objects.

    The arrays are: `frame_id`, `source`, `verdict` (of the mask, empty if not assessed), `not_determined` (joints not
    determined by the images, separated by `; `) and `index` [frames]; `column` (`ARM.JOINT`) and `unit` [columns];
    `joint_positions` and `joint_std` [frames, columns] in the unit given by `unit`; unknown `joint_std` is NaN. For
    moving cameras, `T_camera_world` [frames, cameras, 4, 4] [m] contains the poses, and `camera` the names.
    """
    frames = list(progress.track(dataset.frames))
    moving, poses = _camera_poses(dataset, frames), {}
    if moving:
        poses = {"camera": np.array(list(moving)), "T_camera_world": np.stack([*moving.values()], 1)}
    with output_stream(path) as file:
        np.savez_compressed(
            file,
            frame_id=np.array([frame.frame_id for frame in frames]),
            index=np.array([frame.index for frame in frames]),
            source=np.array([frame.source for frame in frames]),
            verdict=np.array([frame.verdict or "" for frame in frames]),
            not_determined=np.array([JOINED.join(frame.undetermined(dataset.scene) or ()) for frame in frames]),
            column=np.array(joint_columns(dataset.scene)),
            unit=np.array(joint_units(dataset.scene)),
            joint_positions=np.array([position_values(dataset.scene, frame) for frame in frames]),
            joint_std=np.array([std_values(dataset.scene, frame) for frame in frames]),
            **poses,  # pyright: ignore[reportArgumentType]
        )


def write_kinematics_json(dataset: Dataset, path: OutputPath, progress: ExportProgress) -> None:
    """Write JSON: the unit of every `ARM.JOINT`, then the frames with positions and standard deviations (null if
    unknown)."""
    columns, moving = joint_columns(dataset.scene), _camera_poses(dataset, dataset.frames)
    frames = [
        {
            "frame": frame.frame_id,
            "index": frame.index,
            "source": frame.source,
            "verdict": frame.verdict,
            "not_determined": frame.undetermined(dataset.scene),
            "joint_positions": dict(zip(columns, position_values(dataset.scene, frame).tolist(), strict=True)),
            "joint_std": {
                column: None if math.isnan(value) else value
                for column, value in zip(columns, std_values(dataset.scene, frame).tolist(), strict=True)
            },
            **({"T_camera_world": {name: Ts[place].tolist() for name, Ts in moving.items()}} if moving else {}),
        }
        for place, frame in enumerate(progress.track(dataset.frames))
    ]
    content = {
        "sequence": dataset.sequence.name,
        "units": dict(zip(columns, joint_units(dataset.scene), strict=True)),
        "frames": frames,
    }
    write_text(path, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False))


def _write_base_frames(
    entry: Callable[[str, list[list[float]]], dict[str, Any]],
    dataset: Dataset,
    path: OutputPath,
    progress: ExportProgress,
) -> None:
    """Write the base frames of all arms relative to the first exported camera, in dVRK axes."""
    camera = dataset.scene.cameras[0]
    if camera.name in dataset.sequence.moving_cameras:
        raise CartsError(
            f"camera {camera.name!r} moves, but a dVRK base frame is valid for one camera pose only. Export the base "
            "frames of a recording with a stationary endoscope."
        )
    arms = [
        {"name": arm.name, **entry(camera.name, (T_DVRK_OPENCV @ camera.T_camera_world @ arm.T_world_base).tolist())}
        for arm in progress.track(dataset.scene.arms)
    ]
    write_text(path, json.dumps({"arms": arms}, indent=1, ensure_ascii=False))


write_dvrk = partial(_write_base_frames, lambda name, T: {"base_frame": {"reference_frame": name, "transform": T}})
"""Function that writes base frames to be merged into a dVRK system file (version 2.4)."""
write_dvrk_2_3 = partial(_write_base_frames, lambda name, T: {"base-frame": {"reference-frame": name, "transform": T}})
"""Function that writes base frames for a dVRK console file (version 2.3 and earlier)."""
write_dvrk_suj = partial(_write_base_frames, lambda name, T: {"measured_cp": T})
"""Function that writes base frames as a fixed set-up joint file of the dVRK."""


@dataclass(frozen=True)
class ExportFormat:
    """Export format."""

    label: str
    """Label of the format."""
    write: Callable[[Dataset, OutputPath, ExportProgress], None]
    """Function that writes the file or folder."""
    suffix: str = ""
    """Suffix of the file; empty for a folder."""
    images: bool = False
    """Whether the format refers to images."""
    categories: bool = False
    """Whether arms, parts or links can be its categories."""
    refines: bool = False
    """Whether masks can be refined; formats that describe poses contain rendered masks."""
    source: str = ""
    """Format of the imported recording (as in `carts import`) to whose tables the results are added; empty for formats
    that any sequence can be exported to."""


def _imported(name: str, module: str = "annotation_formats") -> Callable[[Dataset, OutputPath, ExportProgress], None]:
    """Writer that is imported at its first use, since it needs further libraries."""

    def write(dataset: Dataset, output: OutputPath, progress: ExportProgress) -> None:
        getattr(import_module(f".{module}", __package__), name)(dataset, output, progress)

    return write


FORMATS: dict[FormatName, ExportFormat] = {
    "masks": ExportFormat("PNG masks", _imported("write_masks"), refines=True),
    "coco": ExportFormat("COCO", _imported("write_coco"), images=True, categories=True, refines=True),
    "coco-keypoints": ExportFormat("COCO keypoints", _imported("write_coco_keypoints"), images=True),
    "bop": ExportFormat("BOP poses", _imported("write_bop"), images=True),
    "yolo": ExportFormat("YOLO segmentation", _imported("write_yolo"), images=True, categories=True, refines=True),
    "voc": ExportFormat("Pascal VOC", _imported("write_voc"), images=True, categories=True, refines=True),
    "cvat": ExportFormat("CVAT for images", _imported("write_cvat"), images=True, categories=True, refines=True),
    "datumaro": ExportFormat("Datumaro", _imported("write_datumaro"), images=True, categories=True, refines=True),
    "csv": ExportFormat("Kinematics, CSV", write_kinematics_csv, ".csv"),
    "npz": ExportFormat("Kinematics, NumPy", write_kinematics_npz, ".npz"),
    "json": ExportFormat("Kinematics, JSON", write_kinematics_json, ".json"),
    "dvrk": ExportFormat("Base frames for the dVRK", write_dvrk, ".json"),
    "dvrk-2.3": ExportFormat("Base frames for the dVRK up to 2.3", write_dvrk_2_3, ".json"),
    "dvrk-suj": ExportFormat("Fixed set-up joints for the dVRK", write_dvrk_suj, ".json"),
    "video": ExportFormat("Overlay video", _imported("write_video", "video")),
    "rosbag2": ExportFormat("ROS 2 bag (MCAP)", _imported("write_rosbag2", "rosbag_format"), refines=True),
    "lerobot": ExportFormat(
        "LeRobot data set", _imported("write_lerobot", "lerobot_format"), refines=True, source="lerobot"
    ),
    "surgsync": ExportFormat(
        "SurgSync recording", _imported("write_surgsync", "surgsync_format"), refines=True, source="surgsync"
    ),
    "recorded-csv": ExportFormat(
        "Recorded tables, CSV", _imported("write_recorded_csv", "recorded_csv_format"), refines=True, source="folder"
    ),
}


def formats_of(sequence: Recording) -> dict[FormatName, ExportFormat]:
    """Formats to which a sequence can be exported: those with a `source` only if it was imported from this
    format."""
    source = ""
    if sequence.recording is not None:
        from ..recording.importing.importer import detect  # noqa: PLC0415 -- most sequences need no importer

        with suppress(CartsError):
            source = detect(sequence.recording).name
    return {name: known for name, known in FORMATS.items() if known.source in ("", source)}


def export(
    dataset: Dataset,
    name: FormatName,
    output: OutputPath | Path,
    *,
    overwrite: bool = False,
    progress: ExportProgress | None = None,
) -> Path:
    """Write a dataset in a format; the output is replaced atomically.

    Args:
        dataset: content of the export.
        name: one of `FORMATS`.
        output: folder or file to create. A file with another suffix gets the format's suffix.
        overwrite: replace a file, or a folder written by an export.
        progress: progress and cancellation; none by default.

    Returns:
        Path of the output.

    Raises:
        ExportCancelled: `progress` was cancelled.
        CartsError: the output exists or cannot be written, or required data is missing.
    """
    chosen, progress = FORMATS[name], progress or ExportProgress()
    if chosen.suffix:
        if Path(output).suffix.lower() != chosen.suffix:
            output = output.parent / (output.name + chosen.suffix)
        with published_file(output, overwrite=overwrite) as path:
            chosen.write(dataset, path, progress)
        return Path(output)
    with published(output, overwrite=overwrite, pause=progress.pause) as path:
        dataset = replace(dataset, refine=dataset.refine if chosen.refines else None, rendered_folder=path / "rendered")
        chosen.write(dataset, path, progress)
        write_text(path / MARKER, _summary(dataset, name))
    return Path(output)


def _summary(dataset: Dataset, name: FormatName) -> str:
    """Description of an exported folder, as JSON; non-ASCII characters are escaped, since paths need not be UTF-8."""
    views = [
        {
            "name": name,
            "frame": frame.frame_id,
            "index": frame.index,
            "camera": camera.name,
            "image": None if file is None else str(file),
            "source": frame.source,
            "verdict": frame.verdict,
            "not_determined": frame.undetermined(dataset.scene),
            "review": frame.review,
            "dice": frame.dice,
            "mask": dataset.mask_source(frame, camera),
        }
        for (name, frame, camera), file in zip(dataset.steps, dataset.files, strict=True)
    ]
    content = {"format": name, "sequence": dataset.sequence.name, "domain": dataset.domain, "views": views}
    return json.dumps(content, indent=1)
