"""Base frames as the dVRK's console reads them.

The console's configuration (`console-*.json`) may give each entry of its list `arms` a fixed `base-frame`, made of
`reference-frame` (a name) and `transform` (4x4, metres). It is the arm's base seen from the camera, in the dVRK's own
camera frame: x left, y up, z away from the surgeon, so half a turn about z from OpenCV's.
Documented in the wiki of jhu-dvrk/sawIntuitiveResearchKit, pages "File Formats" and "Coordinate Systems".
"""

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..camera import Camera
from ..scene import Arm
from .dataset import Dataset
from .monitor import Monitor

T_DVRK_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])
"""From OpenCV's camera frame to the dVRK's."""


def base_frame_transform(arm: Arm, camera: Camera) -> Float[np.ndarray, "4 4"]:
    """T_camera_base [m] with the dVRK's axes of the camera."""
    return T_DVRK_OPENCV @ camera.T_camera_world @ arm.T_world_base


def write_dvrk(dataset: Dataset, path: Path, monitor: Monitor) -> None:
    """Base frames of all arms in the frame of the first exported camera, to be merged into a console's file."""
    camera = dataset.scene.cameras[0]
    arms = [
        {
            "name": arm.name,
            "base-frame": {
                "reference-frame": camera.name,
                "transform": base_frame_transform(arm, camera).tolist(),
            },
        }
        for arm in monitor.track(dataset.scene.arms)
    ]
    path.write_text(json.dumps({"arms": arms}, indent=1, ensure_ascii=False), encoding="utf-8")
