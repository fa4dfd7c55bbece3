"""Files of hand-eye calibration (points and results), and handling of moving cameras."""

import csv
import io
import math
from collections.abc import Mapping
from collections.abc import Sequence as Rows
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ...errors import SettingsError
from ...files.reading import TABLE, VALUES, parse_json, read_bytes, read_text
from ...model.scene import Scene
from ...recording import Sequence
from .problem import ImagePoint
from .result import HandEyeResult

RESULT_FILE = "hand_eye.json"
"""Name of the result file beside the sequence file."""
COLUMNS = ("frame", "camera", "arm", "landmark", "u", "v")


def read_points(path: Path, sequence: Sequence) -> list[ImagePoint]:
    """Read points from a CSV file with the columns `frame` (its id), `camera`, `arm`, `landmark`, `u` and `v` [px].

    Raises:
        SettingsError: the file cannot be read, has no points, lacks a column, names a missing frame, or contains a
            position that is not a finite number.
    """
    try:
        text = read_text(path, TABLE)
        rows = list(csv.DictReader(io.StringIO(text)))
    except FileNotFoundError as error:
        raise SettingsError(f"{path} is missing. Give a CSV file with the columns {', '.join(COLUMNS)}.") from error
    except (OSError, ValueError, csv.Error) as error:
        raise SettingsError(f"{path} cannot be read ({error}). Give a CSV file in UTF-8.") from error
    if not rows:
        raise SettingsError(f"{path} has no points. Give one row per point, with {', '.join(COLUMNS)}.")
    if missing := [column for column in COLUMNS if column not in rows[0]]:
        raise SettingsError(f"{path} has no column {missing[0]!r}. Required: {', '.join(COLUMNS)}.")
    position = {name: index for index, name in enumerate(sequence.frame_ids)}
    points = []
    for number, row in enumerate(rows, start=2):
        if row["frame"] not in position:
            first, last = sequence.frame_ids[0], sequence.frame_ids[-1]
            raise SettingsError(
                f"{path}, line {number}: there is no frame {row['frame']!r}; frames are {first} to {last}."
            )
        try:
            pixel = (float(row["u"]), float(row["v"]))
        except (TypeError, ValueError) as error:
            raise SettingsError(f"{path}, line {number}: u and v must be numbers in pixels ({error}).") from error
        if not all(map(math.isfinite, pixel)):
            raise SettingsError(f"{path}, line {number}: u and v are {pixel[0]} and {pixel[1]}. Give finite numbers.")
        points.append(ImagePoint(position[row["frame"]], row["camera"], row["arm"], row["landmark"], pixel))
    return points


@dataclass(frozen=True)
class HandEyePrior:
    """Uncertainty of a hand-eye calibration, used as prior of a refinement."""

    base_covariances: Mapping[str, Float[np.ndarray, "6 6"]]
    """Arm -> covariance of its base frame; see `HandEyeResult`."""
    free_cameras: tuple[str, ...]
    """Cameras whose pose was unknown before the hand-eye calibration."""


def read_prior(sequence: Path, scene: Scene) -> HandEyePrior | None:
    """Read the uncertainty of the hand-eye calibration that wrote a sequence file; None without a hand-eye calibration
    or if base frames have changed since.

    Args:
        sequence: path of the sequence file.
        scene: scene with the current base frames.

    Raises:
        SettingsError: `hand_eye.json` beside the sequence file cannot be read.
    """
    path = sequence.parent / RESULT_FILE
    if not path.is_file():
        return None
    try:
        content = parse_json(read_bytes(path, VALUES))
        if "base_frames" not in content:
            return None
        known = {name: np.array(entry["T_world_base"], float) for name, entry in content["base_frames"].items()}
        covariances = {name: np.array(entry["covariance"], float) for name, entry in content["base_frames"].items()}
        free = tuple(str(camera) for camera in content["free_cameras"])
        fits = all(T.shape == (4, 4) and covariances[name].shape == (6, 6) for name, T in known.items())
        fits = fits and all(np.linalg.eigvalsh(covariance)[0] > 0 for covariance in covariances.values())
    except (OSError, ValueError, KeyError, TypeError, AttributeError, np.linalg.LinAlgError) as error:
        raise SettingsError(
            f"{path} cannot be read ({error}). Run carts hand-eye again, or remove the file."
        ) from error
    if not fits:
        raise SettingsError(
            f"{path} has no valid covariances of base frames. Run carts hand-eye again, or remove the file."
        )
    now = {arm.name: arm.T_world_base for arm in scene.arms}
    if not all(name in now and np.allclose(now[name], T, atol=1e-6) for name, T in known.items()):
        return None
    return HandEyePrior(covariances, free)


def result_json(
    sequence: Sequence, points: Rows[ImagePoint], result: HandEyeResult, free_cameras: Rows[str] = ()
) -> dict[str, Any]:
    """Hand-eye result as JSON: points with residual distances, poses with standard deviations, base frames with
    covariances."""
    return {
        "free_cameras": list(free_cameras),
        "base_frames": {
            arm: {"T_world_base": result.scene.arm(arm).T_world_base.tolist(), "covariance": covariance.tolist()}
            for arm, covariance in result.base_covariances.items()
        },
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


STATIONARY_TOLERANCE = 1e-3
"""Maximum difference between transforms of a mount that counts as stationary [rad, m]."""


def mounts_of_points(recording: Sequence, points: Rows[ImagePoint]) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Moving camera -> T_mount_world [m] in the frames of the points.

    Raises:
        SettingsError: a camera has different poses in these frames, or a point names a missing frame.
    """
    found: dict[str, tuple[int, np.ndarray]] = {}
    for point in points:
        if not 0 <= point.frame < len(recording):
            raise SettingsError(f"there is no frame {point.frame}; frames are 0 to {len(recording) - 1}.")
        for camera, T in recording.mounts(point.frame).items():
            frame, first = found.setdefault(camera, (point.frame, T))
            if not np.allclose(T, first, atol=STATIONARY_TOLERANCE):
                ids = recording.frame_ids
                raise SettingsError(
                    f"camera {camera!r} moves between frames {ids[frame]!r} and {ids[point.frame]!r}, both of which "
                    "have points. Click points in frames with a stationary camera, and refine with carts calibrate."
                )
    return {camera: T for camera, (_, T) in found.items()}


def moved_cameras(scene: Scene, mounts: Mapping[str, Float[np.ndarray, "4 4"]], *, back: bool = False) -> Scene:
    """Convert camera poses from mount to world coordinates, given camera -> T_mount_world [m]; the inverse if
    `back`."""
    steps = {camera: np.linalg.inv(T) if back else T for camera, T in mounts.items()}
    cameras = (
        replace(camera, T_camera_world=camera.T_camera_world @ steps.get(camera.name, np.eye(4)))
        for camera in scene.cameras
    )
    return replace(scene, cameras=tuple(cameras))
