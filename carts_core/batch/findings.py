"""What a job found, for the report over all: verdicts, corrections of joints, base frames, and its worst frames."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import msgspec
import numpy as np

from ..export import KinematicsRow, outlined, read_kinematics_csv
from ..export.kinematics import joint_columns, joint_units, position_values, std_values
from ..files import OutputPath, holds_file, write_bytes, write_text
from ..files.reading import IMAGE, VALUES, parse_json, read_bytes, typed
from ..recording import Sequence
from .manifest import Job

FILE = "findings.json"
_FORMAT: Literal["carts-findings/1"] = "carts-findings/1"
_WORST = 3
"""Frames of a job that are shown."""
_WIDTH = 480
"""Of their pictures, at most [px]."""


@dataclass(frozen=True)
class FrameFinding:
    """The verdict on a frame."""

    camera: str
    frame: str
    verdict: str
    """`good`, `doubtful` or `failed`."""
    reason: str
    probability: Annotated[float, msgspec.Meta(ge=0, le=1)]
    """That its mask is wrong [1]."""
    picture: str = ""
    """File in the job's folder; empty for frames that are not among the worst."""


@dataclass(frozen=True)
class Findings:
    """What a job found."""

    recording: str
    frames: list[FrameFinding] = field(default_factory=list)
    corrections: dict[str, list[float]] = field(default_factory=dict)
    """`ARM.JOINT` -> corrected minus measured, of each frame [deg, mm]."""
    deviations: dict[str, list[float]] = field(default_factory=dict)
    """`ARM.JOINT` -> reported standard deviation, of each frame that has one [deg, mm]."""
    base_frames: dict[str, list[list[float]]] = field(default_factory=dict)
    """`ARM in CAMERA` -> T_camera_base, calibrated where that was asked for [4 x 4, m]."""


@dataclass(frozen=True)
class _Written(Findings):
    """Content of the file."""

    format: Literal["carts-findings/1"] = _FORMAT


def read_findings(folder: OutputPath) -> Findings | None:
    """What the job of a folder found; None before it has ended.

    Raises:
        OSError, ValueError: the file is damaged.
    """
    path = folder / FILE
    if not holds_file(path):
        return None
    found = typed(parse_json(read_bytes(path.path, VALUES)), _Written)
    if any(len(rows) != 4 or {len(row) for row in rows} != {4} for rows in found.base_frames.values()):
        raise ValueError("a base frame is no 4 x 4 matrix")
    return found


def write_findings(job: Job, folder: OutputPath, sequence_file: Path) -> None:
    """Write `findings.json`, and pictures of the worst frames.

    Args:
        job: that is done.
        folder: of the job.
        sequence_file: with the calibration that its last steps used.
    """
    sequence = Sequence.open(sequence_file)
    scene, found = sequence.scene, Findings(str(job.recording))
    for arm in scene.arms:
        for camera in scene.cameras:
            T_mount_world = sequence.mounts(0).get(camera.name)
            moved = np.eye(4) if T_mount_world is None else T_mount_world
            seen_in = camera.name if T_mount_world is None else f"the first frame of {camera.name}"
            found.base_frames[f"{arm.name} in {seen_in}"] = (camera.T_camera_world @ moved @ arm.T_world_base).tolist()
    steps = [step for step in ("sequence", "optimize") if step in job.steps]
    parts = sorted((folder / steps[0]).path.glob("*/*/kinematics.csv")) if steps else []
    for table in parts:
        rows = read_kinematics_csv(table, scene)
        _add_corrections(found, sequence, rows)
        cameras = table.parent.name
        records = _records(table.parent / "results.json")
        frames = [
            FrameFinding(cameras, row.frame_id, record["verdict"], record["reason"], record["probability"])
            for row in rows
            if (record := records.get(row.frame_id)) and record.get("verdict")
        ]
        found.frames.extend(_pictured(folder, sequence, table.parent, frames))
    write_text(folder / FILE, json.dumps({"format": _FORMAT, **asdict(found)}))


def _add_corrections(found: Findings, sequence: Sequence, rows: list[KinematicsRow]) -> None:
    scene = sequence.scene
    order = {frame_id: index for index, frame_id in enumerate(sequence.frame_ids)}
    units = [np.rad2deg(1.0) if unit == "rad" else 1000.0 for unit in joint_units(scene)]
    for row in rows:
        index = order[row.frame_id]
        measured = np.concatenate([sequence.measured[arm.name][index] for arm in scene.arms])
        change, deviation = position_values(scene, row) - measured, std_values(scene, row)
        for name, unit, moved, std in zip(joint_columns(scene), units, change, deviation, strict=True):
            found.corrections.setdefault(name, []).append(round(float(moved * unit), 6))
            if np.isfinite(std):
                found.deviations.setdefault(name, []).append(round(float(std * unit), 6))


def _records(path: Path) -> Mapping[str, Mapping[str, Any]]:
    try:
        return parse_json(read_bytes(path, VALUES))["frames"]
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _pictured(folder: OutputPath, sequence: Sequence, part: Path, frames: list[FrameFinding]) -> Iterator[FrameFinding]:
    """The frames, the worst with pictures: the image with the mask's outline."""
    worst = sorted(frames, key=lambda frame: -frame.probability)[:_WORST]
    domain, first = part.parent.name, part.name.split("+")[0]
    masks = part / "masks" / first if "+" in part.name else part / "masks"
    for frame in frames:
        if frame not in worst:
            yield frame
            continue
        index = list(sequence.frame_ids).index(frame.frame)
        image = sequence.frame(index, domain, [first]).images[first]
        mask = cv2.imdecode(np.frombuffer(read_bytes(masks / f"{frame.frame}.png", IMAGE), np.uint8), 0)
        assert mask is not None
        shown = outlined(image, mask > 0)
        scale = min(1.0, _WIDTH / shown.shape[1])
        small = cv2.resize(shown, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        name = f"worst-{part.name}-{frame.frame}.jpg"
        write_bytes(folder / name, cv2.imencode(".jpg", small[..., ::-1])[1].tobytes())
        yield FrameFinding(**{**asdict(frame), "picture": name})
