"""A scene with a calibration that a draft keeps."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from carts_core.errors import SettingsError
from carts_core.model.scene import Scene


def calibrated_scene(scene: Scene, calibration: Mapping[str, Any]) -> Scene:
    """The scene with base frames, camera poses and intrinsics filled in.

    Raises:
        SettingsError: the calibration is of other arms or cameras.
    """
    try:
        arms = tuple(replace(arm, T_world_base=np.array(calibration["arms"][arm.name])) for arm in scene.arms)
        cameras = tuple(
            replace(
                camera,
                T_camera_world=np.array(calibration["cameras"][camera.name]),
                intrinsics=tuple(float(value) for value in calibration["intrinsics"][camera.name]),
            )
            for camera in scene.cameras
        )
    except (KeyError, TypeError, ValueError) as error:
        raise SettingsError("the calibration is of other arms or cameras. Calibrate again.") from error
    return replace(scene, arms=arms, cameras=cameras)
