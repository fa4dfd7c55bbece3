"""Base frames as the dVRK reads them.

The system's configuration (`system-*.json`; until 2.3 the console's, `console-*.json`) may give each entry of its list
`arms` a fixed `base_frame`, made of `reference_frame` (a name) and `transform` (4x4, metres). Until 2.3 the keys had
hyphens. Where set-up joints (SUJ) are simulated as fixed, their file gives each arm a `measured_cp` instead. All of
them are the arm's base seen from the camera, in the dVRK's own camera frame: x left, y up, z away from the surgeon, so
half a turn about z from OpenCV's. The keys are those of jhu-dvrk/sawIntuitiveResearchKit:
share/schemas/dvrk-system-arm.schema.json and share/suj-fixed.json.
"""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from ..errors import CartsError
from ..files import OutputPath, write_text
from ..model.camera import T_DVRK_OPENCV, Camera
from ..model.scene import Arm
from .dataset import Dataset
from .monitor import Monitor


def base_frame_transform(arm: Arm, camera: Camera) -> Float[np.ndarray, "4 4"]:
    """T_camera_base [m] with the dVRK's axes of the camera."""
    return T_DVRK_OPENCV @ camera.T_camera_world @ arm.T_world_base


def write_dvrk(dataset: Dataset, path: OutputPath, monitor: Monitor) -> None:
    """Base frames of all arms in the frame of the first exported camera, to be merged into a system's file (2.4)."""
    _write(dataset, path, monitor, lambda name, T: {"base_frame": {"reference_frame": name, "transform": T}})


def write_dvrk_2_3(dataset: Dataset, path: OutputPath, monitor: Monitor) -> None:
    """The same for a console's file of 2.3 and earlier."""
    _write(dataset, path, monitor, lambda name, T: {"base-frame": {"reference-frame": name, "transform": T}})


def write_dvrk_suj(dataset: Dataset, path: OutputPath, monitor: Monitor) -> None:
    """The same as a file of fixed set-up joints."""
    _write(dataset, path, monitor, lambda _, T: {"measured_cp": T})


def _write(
    dataset: Dataset, path: OutputPath, monitor: Monitor, entry: Callable[[str, list[list[float]]], dict[str, Any]]
) -> None:
    camera = dataset.scene.cameras[0]
    if camera.name in dataset.sequence.moving_cameras:
        raise CartsError(
            f"camera {camera.name!r} moves, and a base frame of the dVRK holds for one place of it. Export the base "
            "frames of a recording in which the endoscope stands still."
        )
    arms = [
        {"name": arm.name, **entry(camera.name, base_frame_transform(arm, camera).tolist())}
        for arm in monitor.track(dataset.scene.arms)
    ]
    write_text(path, json.dumps({"arms": arms}, indent=1, ensure_ascii=False))
