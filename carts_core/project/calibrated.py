"""Recordings with the corrections of a project applied: joint positions and calibration."""

from dataclasses import replace

import numpy as np

from ..model.scene import Scene, SceneState
from ..recording import Frame, Sequence
from .state import ProjectState
from .values import Key, Source

_SOURCE_ORDER = (Source.HAND, Source.PROPAGATED, Source.OPTIMIZER, Source.MEASURED)
"""Precedence of sources for a frame whose arms have different sources."""


def corrected_sequence(sequence: Sequence, project: ProjectState) -> Sequence:
    """Recording with the project's time offset, calibration and joints; `SequenceError` if no table row matches a
    frame."""
    offset = project.get(Key.time_offset())
    if offset is not None and sequence.matching is not None and offset.seconds != sequence.matching.time_offset:
        sequence = sequence.with_time_offset(offset.seconds)
    measured = {name: rows.copy() for name, rows in sequence.measured.items()}
    for index in project.records.keys() & set(range(len(sequence))):
        for name, found in project.joints(index).items():
            measured[name][index] = found.joint_positions
    return sequence.corrected(calibrated_scene(sequence.scene, project), measured)


def calibrated_scene(scene: Scene, project: ProjectState) -> Scene:
    """Scene with the project's corrected base frames, extrinsics and intrinsics."""
    arms, cameras = [], []
    for arm in scene.arms:
        base = project.get(Key.base_frame(arm.name))
        arms.append(arm if base is None else replace(arm, T_world_base=np.array(base.transform)))
    for camera in scene.cameras:
        extrinsics, intrinsics = project.get(Key.extrinsics(camera.name)), project.get(Key.intrinsics(camera.name))
        moved = camera if extrinsics is None else replace(camera, T_camera_world=np.array(extrinsics.transform))
        cameras.append(moved if intrinsics is None else replace(moved, intrinsics=intrinsics.intrinsics))
    return replace(scene, arms=tuple(arms), cameras=tuple(cameras))


def source_of(project: ProjectState, frame: int) -> Source:
    """Source of the joint positions of a frame."""
    sources = {correction.provenance.source for correction in project.joints(frame).values()}
    return next((source for source in _SOURCE_ORDER if source in sources), Source.MEASURED)


def corrected_state(scene: Scene, frame: Frame, project: ProjectState) -> SceneState:
    """State of a frame under the project's calibration, with corrected joint positions where available, else measured
    ones."""
    measured = {name: frame.measured[name] for name in project.identity.arms}
    corrected = {name: found.joint_positions for name, found in project.joints(frame.index).items()}
    return calibrated_scene(scene, project).state({**measured, **corrected}, mounts=frame.mounts)
