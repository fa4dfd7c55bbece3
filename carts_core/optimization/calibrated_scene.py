"""The scene that the unknowns of a calibration stand for."""

from dataclasses import replace

import numpy as np
import torch

from ..model.scene import Scene, SceneState
from .variables import Variables


def calibrated_scene(whole: Scene, part: Scene, variables: Variables, offsets: torch.Tensor) -> Scene:
    """A scene with the calibration of its calibrated part; what did not move keeps its exact value.

    Args:
        whole: the scene.
        part: the same arms with the cameras that take part.
        variables: the unknowns of `part`.
        offsets: where they are now, from their start.
    """
    start, state = variables.start, variables.state(offsets)
    arms = tuple(
        replace(arm, T_world_base=_moved(arm.T_world_base, start, state, "T_world_base", index))
        for index, arm in enumerate(whole.arms)
    )
    indices = {camera.name: index for index, camera in enumerate(part.cameras)}
    cameras = []
    for camera in whole.cameras:
        if (index := indices.get(camera.name)) is not None:
            T_camera_world = _moved(camera.T_camera_world, start, state, "T_camera_world", index)
            before, after = start.intrinsics[index], state.intrinsics[index]
            fx, fy, cx, cy = camera.intrinsics if torch.equal(before, after) else after.tolist()
            cameras.append(replace(camera, T_camera_world=T_camera_world, intrinsics=(fx, fy, cx, cy)))
        else:
            cameras.append(camera)
    return replace(whole, arms=arms, cameras=tuple(cameras))


def _moved(given: np.ndarray, start: SceneState, state: SceneState, name: str, index: int) -> np.ndarray:
    before, after = getattr(start, name)[index], getattr(state, name)[index]
    if torch.equal(before, after):
        return given
    import roma  # noqa: PLC0415 -- it loads the compiler of torch, which takes a second

    result = after.cpu().double()
    result[:3, :3] = roma.special_procrustes(result[:3, :3])
    return result.numpy()
