"""The pose of a frame as a project says: joints as corrected or measured, in the corrected calibration."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..model.scene import Scene, SceneState
from ..recording import Frame
from .keys import Key
from .state import ProjectState


def corrected_state(scene: Scene, frame: Frame, project: ProjectState) -> SceneState:
    """The state of a frame: joint positions as corrected, of other arms as measured, in the project's calibration."""
    measured = {name: frame.measured[name] for name in project.identity.arms}
    corrected = {name: found.joint_positions for name, found in project.joints(frame.index).items()}
    return calibrated(scene, scene.state({**measured, **corrected}, mounts=frame.mounts), project)


def calibrated(scene: Scene, state: SceneState, project: ProjectState) -> SceneState:
    """The state with base frames, extrinsics and intrinsics as the project corrects them."""

    def corrected(stack: Tensor, values: list[Any]) -> Tensor:
        rows = [
            old if new is None else torch.tensor(new, dtype=old.dtype) for old, new in zip(stack, values, strict=True)
        ]
        return torch.stack(rows)

    bases = [project.get(Key.base_frame(arm.name)) for arm in scene.arms]
    extrinsics = [project.get(Key.extrinsics(camera.name)) for camera in scene.cameras]
    intrinsics = [project.get(Key.intrinsics(camera.name)) for camera in scene.cameras]
    return replace(
        state,
        T_world_base=corrected(state.T_world_base, [value and value.transform for value in bases]),
        T_camera_world=corrected(state.T_camera_world, [value and value.transform for value in extrinsics]),
        intrinsics=corrected(state.intrinsics, [value and value.intrinsics for value in intrinsics]),
    )
