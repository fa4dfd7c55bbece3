"""Points in a table, and what was found from them as JSON."""

import csv
import io
import math
from collections.abc import Sequence as Rows
from pathlib import Path
from typing import Any

from ...errors import SettingsError
from ...files.reading import TABLE, read_text
from ...recording import Sequence
from .points import ImagePoint
from .result import HandEyeResult

COLUMNS = ("frame", "camera", "arm", "landmark", "u", "v")


def read_points(path: Path, sequence: Sequence) -> list[ImagePoint]:
    """Points of a CSV file with the columns `frame` (its id), `camera`, `arm`, `landmark`, `u` and `v` [px].

    Raises:
        SettingsError: the file cannot be read, lacks a column, or names a frame that is not there.
    """
    try:
        text = read_text(path, TABLE)
        rows = list(csv.DictReader(io.StringIO(text)))
    except FileNotFoundError as error:
        raise SettingsError(f"{path} is missing. Give a CSV file with the columns {', '.join(COLUMNS)}.") from error
    except (OSError, ValueError, csv.Error) as error:
        raise SettingsError(f"{path} cannot be read ({error}). Give a CSV file in UTF-8.") from error
    if not rows:
        raise SettingsError(f"{path} has no points. Give a row per point with {', '.join(COLUMNS)}.")
    if missing := [column for column in COLUMNS if column not in rows[0]]:
        raise SettingsError(f"{path} has no column {missing[0]!r}. It needs {', '.join(COLUMNS)}.")
    position = {name: index for index, name in enumerate(sequence.frame_ids)}
    points = []
    for number, row in enumerate(rows, start=2):
        if row["frame"] not in position:
            first, last = sequence.frame_ids[0], sequence.frame_ids[-1]
            raise SettingsError(f"{path}, line {number}: no frame {row['frame']!r}; frames are {first} to {last}.")
        try:
            pixel = (float(row["u"]), float(row["v"]))
        except (TypeError, ValueError) as error:
            raise SettingsError(f"{path}, line {number}: u and v must be numbers of pixels ({error}).") from error
        if not all(map(math.isfinite, pixel)):
            raise SettingsError(f"{path}, line {number}: u and v are {pixel[0]} and {pixel[1]}. Give finite numbers.")
        points.append(ImagePoint(position[row["frame"]], row["camera"], row["arm"], row["landmark"], pixel))
    return points


def result_json(sequence: Sequence, points: Rows[ImagePoint], result: HandEyeResult) -> dict[str, Any]:
    """Points with their distances, poses with their standard deviations."""
    return {
        "error_px": result.error,
        "points": [
            {
                "frame": sequence.frame_ids[point.frame],
                "camera": point.camera,
                "arm": point.arm,
                "landmark": point.landmark,
                "pixel": list(point.pixel),
                "distance_px": float(distance),
                "contradicts": index in result.contradicting,
            }
            for index, (point, distance) in enumerate(zip(points, result.distances, strict=True))
        ],
        "poses": [
            {
                "arm": arm,
                "camera": camera,
                "T_camera_base": (
                    result.scene.camera(camera).T_camera_world @ result.scene.arm(arm).T_world_base
                ).tolist(),
                "deviation": {
                    "rotation_deg": deviation.rotation_deg,
                    "sideways_mm": deviation.sideways_mm,
                    "depth_mm": deviation.depth_mm,
                },
            }
            for (arm, camera), deviation in result.deviations.items()
        ],
        "focal_lengths": {
            camera: {
                "fx_fy": list(result.scene.camera(camera).intrinsics[:2]),
                "deviation_percent": 100 * deviation,
            }
            for camera, deviation in result.focal_deviation.items()
        },
    }
