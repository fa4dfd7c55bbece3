"""A draft with its calibration as a sequence file that a person can read."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from carts_core.errors import SettingsError
from carts_core.files import name_fault
from carts_core.model.scene import Scene
from carts_core.recording.importing.found import FoundRecording, Note
from carts_core.recording.importing.writing import write_sequence
from carts_viewer.start.roots import Roots


def calibrated_recording(
    recording: FoundRecording, before: Scene, calibration: Mapping[str, Any], text: str
) -> FoundRecording:
    """The recording with a calibration filled in.

    Args:
        recording: as found, with stand-ins.
        before: the scene that it describes.
        calibration: `calibrating.as_plain`.
        text: where the calibration comes from, for people.

    Raises:
        SettingsError: the calibration is of other arms or cameras.
    """
    names = {arm.name for arm in recording.arms}, {camera.name for camera in recording.cameras}
    if (set(calibration["arms"]), set(calibration["cameras"])) != names:
        raise SettingsError("the calibration is of other arms or cameras. Calibrate again.")
    arms = tuple(
        replace(arm, T_world_base=np.array(calibration["arms"][arm.name]), base_from=text) for arm in recording.arms
    )
    cameras = []
    for camera in recording.cameras:
        found = tuple(float(value) for value in calibration["intrinsics"][camera.name])
        placed = replace(camera, T_camera_world=np.array(calibration["cameras"][camera.name]))
        if not np.allclose(found, before.camera(camera.name).intrinsics, rtol=1e-9, atol=0.0):
            placed = replace(placed, intrinsics=found, pixel_center=0.5)
        cameras.append(placed)
    stale = ("no base frame (hand-eye calibration)",)
    notes = [note for note in recording.notes if not any(words in note.text for words in stale)]
    return replace(recording, arms=arms, cameras=tuple(cameras), notes=(*notes, Note("found", f"calibration: {text}.")))


def target_folder(roots: Roots, source: Path, name: str) -> Path:
    """Where the sequence of a recording is written: beside it, or in it where it is an allowed folder itself.

    Raises:
        SettingsError: the name cannot be part of a path.
    """
    if (fault := name_fault(name)) is not None:
        raise SettingsError(f"the name {name!r} cannot be used, {fault}. Choose another.")
    parent = source.parent if source not in roots.folders else source
    folder = roots.checked(parent) / f"{name}_sequence"
    number = 2
    while folder.exists() or folder.is_symlink():
        folder = parent / f"{name}_sequence_{number}"
        number += 1
    return folder


def write_saved(recording: FoundRecording, folder: Path, name: str) -> Path:
    """Write the sequence file with its tables; gives the file.

    Raises:
        CartsError: it cannot be written; nothing is there then.
    """
    return write_sequence(replace(recording, name=name), folder)
