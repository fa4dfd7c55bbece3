"""Hand-eye calibration of a camera that moves, from points in frames in which it stands still."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ...errors import SettingsError
from ...model.scene import Scene
from ...recording import Sequence as Recording
from .points import ImagePoint

_STANDS = 1e-3
"""Mounts whose transforms differ by less are at the same place [rad, m]."""


def mounts_of_points(recording: Recording, points: Sequence[ImagePoint]) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Camera -> T_mount_world [m] in the frames of points, of the cameras that move.

    Raises:
        SettingsError: a camera stands at different places in these frames, or a point names a missing frame.
    """
    found: dict[str, tuple[int, np.ndarray]] = {}
    for point in points:
        if not 0 <= point.frame < len(recording):
            raise SettingsError(f"there is no frame {point.frame}; frames are 0 to {len(recording) - 1}.")
        for camera, T in recording.mounts(point.frame).items():
            frame, first = found.setdefault(camera, (point.frame, T))
            if not np.allclose(T, first, atol=_STANDS):
                ids = recording.frame_ids
                raise SettingsError(
                    f"camera {camera!r} moves between frames {ids[frame]!r} and {ids[point.frame]!r}, which have "
                    "points. Click in frames in which it stands still, and refine with carts calibrate."
                )
    return {camera: T for camera, (_, T) in found.items()}


def moved_cameras(scene: Scene, mounts: Mapping[str, Float[np.ndarray, "4 4"]], *, back: bool = False) -> Scene:
    """The scene with its cameras where their mounts take them, or, of such a scene, with cameras on their mounts.

    Args:
        scene: arms and cameras.
        mounts: camera -> T_mount_world [m], of the cameras that move.
        back: from the world to the mounts.
    """
    steps = {camera: np.linalg.inv(T) if back else T for camera, T in mounts.items()}
    cameras = (
        replace(camera, T_camera_world=camera.T_camera_world @ steps.get(camera.name, np.eye(4)))
        for camera in scene.cameras
    )
    return replace(scene, cameras=tuple(cameras))
