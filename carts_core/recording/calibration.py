"""Calibration values, written in the sequence file or taken out of a JSON file beside it."""

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RobotError, SequenceError, SettingsError
from ..files.reading import VALUES, parse_json, read_text
from ..model.camera import HALF_PIXEL, Camera, rigid_transform
from ..model.instruments import SCHEME, robot_file
from ..wording import closest, listed, shown
from .toml_table import TomlTable


def take_value(table: TomlTable, key: str, default: Any) -> Any:
    """The value of `key`; text `file.json#a/b` stands for the value under `a`, `b` in that JSON file.

    Raises:
        SequenceError: the JSON file or the name in it does not exist.
    """
    value = table.take(key, object, default)
    if not isinstance(value, str):
        return value
    file_name, mark, pointer = value.partition("#")
    if not mark or not pointer:
        raise table.error(
            key, f'is {shown(value)}. Write the numbers here, or "file.json#name" to take them from a file.'
        )
    path = table.path(file_name)
    try:
        found = parse_json(read_text(path, VALUES))
    except FileNotFoundError as error:
        raise table.error(key, f"points at {path}, which is missing. Correct the path.") from error
    except (OSError, ValueError) as error:
        raise table.error(key, f"points at {path}, which is not a readable JSON file: {error}.") from error
    for name in pointer.strip("/").split("/"):
        if isinstance(found, list) and name.isdigit() and int(name) < len(found):
            found = found[int(name)]
        elif isinstance(found, dict) and name in found:
            found = found[name]
        else:
            names = list(found) if isinstance(found, dict) else []
            raise table.error(
                key,
                f"points at {name!r}, which {path} does not have.{closest(name, names)} "
                f"It has: {listed(names) or 'no names at this place'}.",
            )
    return found


def take_transform(table: TomlTable, key: str, default: Any) -> np.ndarray:
    """A rigid transform [4, 4], translation in [m].

    Raises:
        SequenceError: it is not rigid.
    """
    value = take_value(table, key, default)
    try:
        return rigid_transform(value, table.name(key))
    except SettingsError as error:
        raise SequenceError(str(error)) from error


def take_camera(table: TomlTable) -> Camera:
    """The camera that one `[[cameras]]` table describes.

    Raises:
        SequenceError: a value is missing or impossible.
    """
    name = table.take("name", str)
    width, height = _take_size(table)
    intrinsics = _take_intrinsics(table)
    distortion = take_value(table, "distortion", [])
    if not isinstance(distortion, list) or not all(_is_number(value) for value in distortion):
        raise table.error(
            "distortion", f"is {shown(distortion)}. Give a list of 0, 4, 5, 8, 12 or 14 numbers: k1 k2 p1 p2 k3 ..."
        )
    T_camera_world = take_transform(table, "T_camera_world", np.eye(4).tolist())
    try:
        return Camera(name, width, height, intrinsics, T_camera_world, tuple(float(value) for value in distortion))
    except SettingsError as error:
        raise SequenceError(f"{table.file}: {table.where}: {error}") from error


def _take_size(table: TomlTable) -> tuple[int, int]:
    size = take_value(table, "size", [])
    if not (isinstance(size, list) and len(size) == 2 and all(isinstance(value, int) and value > 0 for value in size)):
        raise table.error("size", f"is {shown(size)}. Give [width, height] in whole pixels, say size = [640, 480].")
    return size[0], size[1]


def _take_intrinsics(table: TomlTable) -> tuple[float, float, float, float]:
    K = take_value(table, "K", None)
    if isinstance(K, dict) and sorted(K) == ["cx", "cy", "fx", "fy"] and all(_is_number(value) for value in K.values()):
        fx, fy, cx, cy = (float(K[key]) for key in ("fx", "fy", "cx", "cy"))
    else:
        try:
            matrix = np.array(K, dtype=np.float64)
        except (TypeError, ValueError):
            matrix = np.empty(0)
        if matrix.shape != (3, 3):
            raise table.error(
                "K", f"is {shown(K)}. Give 3 rows of 3 numbers, or {{ fx = ..., fy = ..., cx = ..., cy = ... }}."
            )
        fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
        if not np.allclose(matrix, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], atol=1e-6 * abs(fx)):
            raise table.error(
                "K",
                f"is {shown(K)}. It must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: skew is not supported, "
                "and rows must not be swapped with columns.",
            )
    center = table.take("pixel_center", float, HALF_PIXEL)
    if center not in (0.0, HALF_PIXEL):
        raise table.error(
            "pixel_center", f"is {center!r}, but must be 0.5 (ours) or 0.0 (OpenCV, ROS, MATLAB minus 1)."
        )
    return float(fx), float(fy), float(cx) + HALF_PIXEL - center, float(cy) + HALF_PIXEL - center


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def resolve_robot(table: TomlTable) -> Path:
    """The URDF that the key `robot` names: a path, or `builtin:NAME`.

    Raises:
        SequenceError: no robot of that name is built in.
    """
    value = table.take("robot", str)
    if value.startswith(SCHEME):
        try:
            return robot_file(value)
        except RobotError as error:
            raise table.error("robot", f"is not known: {error}") from error
    return table.path(value)
