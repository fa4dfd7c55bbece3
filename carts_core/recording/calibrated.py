"""A sequence file with another calibration: the same recording, described from another folder."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from ..files.reading import SEQUENCE, read_text
from ..model.camera import HALF_PIXEL
from ..model.instruments import SCHEME
from ..model.scene import Scene


def calibrated_sequence_file(
    path: Path, folder: Path, before: Scene, after: Scene, command: str = "calibrate", time_offset: float | None = None
) -> str:
    """The text of a sequence file like the one at `path`, for another folder and with another calibration.

    What differs between the scenes is written as numbers; everything else, comments included, stays. Paths, which are
    relative to the file's folder, are changed for the new one; absolute paths stay.

    Args:
        path: a sequence file that was read without an error.
        folder: where the new one will lie.
        before: the scene that `path` describes.
        after: the same with other base frames, extrinsics or intrinsics.
        command: the `carts` command that found them, for the heading.
        time_offset: the key of that name in `[frames]` [s]; None leaves it as it is.
    """
    document: dict[str, Any] = tomlkit.parse(read_text(path, SEQUENCE))
    source, target = path.parent.resolve(), folder.resolve()

    def moved(value: str) -> str:
        return value if os.path.isabs(value) else Path(os.path.relpath(source / value, target)).as_posix()

    def move(table: dict[str, Any], *keys: str) -> None:
        for key in keys:
            value = table.get(key)
            if isinstance(value, str):
                table[key] = moved(value)
            elif isinstance(value, dict):
                # Patterns by domain; K as a table of numbers has no text in it.
                for name, entry in value.items():
                    value[name] = moved(entry) if isinstance(entry, str) else entry

    move(document["kinematics"], "table", "truth")
    move(document.get("frames", {}), "table", "video")
    if time_offset is not None:
        document["frames"]["time_offset"] = time_offset
    for table, old, new in zip(document["arms"], before.arms, after.arms, strict=True):
        move(table, "table", "truth", "T_world_base")
        if not table["robot"].startswith(SCHEME):
            move(table, "robot")
        if not np.array_equal(old.T_world_base, new.T_world_base):
            table["T_world_base"] = _matrix(new.T_world_base)
    for table, old, new in zip(document["cameras"], before.cameras, after.cameras, strict=True):
        move(table, "images", "masks", "background", "size", "K", "distortion", "T_camera_world")
        if isinstance(table.get("motion"), dict):
            move(table["motion"], "table")
        else:
            move(table, "motion")
        if not np.array_equal(old.T_camera_world, new.T_camera_world):
            table["T_camera_world"] = _matrix(new.T_camera_world)
        if old.intrinsics != new.intrinsics:
            table["K"] = dict(zip(("fx", "fy", "cx", "cy"), new.intrinsics, strict=True))
            table["pixel_center"] = HALF_PIXEL
    heading = f"# What carts {command} found is filled in. Other comments are those of the original file."
    return f"{heading}\n{tomlkit.dumps(document)}"


def _matrix(values: np.ndarray) -> Any:
    # Adding 0 makes -0.0 a plain zero.
    return tomlkit.item((np.round(values, 12) + 0.0).tolist()).multiline(True)  # pyright: ignore
