"""Arms and cameras that belong together row by row: row n of a log is the n-th frame."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import SequenceError
from ...settings.importing import ImportOptions
from .cameras import calibration_of
from .found import FoundArm, FoundCamera, Note
from .media import Images


def by_rows(
    arms: Sequence[FoundArm], ids: Sequence[str], notes: list[Note]
) -> tuple[tuple[FoundArm, ...], tuple[str, ...], np.ndarray]:
    """Arms whose times are numbers of frames, without times, for the frames that all of them have.

    Args:
        arms: `times` are positions in `ids`.
        ids: of all frames.
        notes: what is left out is added.

    Returns:
        The arms, the ids that remain, and their positions in `ids`.

    Raises:
        SequenceError: no frame remains.
    """
    keep = np.ones(len(ids), bool)
    positions = {arm.name: np.asarray(arm.times, int) for arm in arms if arm.times is not None}
    for rows in positions.values():
        present = np.zeros(len(ids), bool)
        present[rows[rows < len(ids)]] = True
        keep &= present
    if not keep.any():
        raise SequenceError("no frame has joint positions of all arms. Leave an arm out: --arms.")
    if not keep.all():
        notes.append(Note("warning", f"{int((~keep).sum())} of {len(keep)} frames left out: no joint positions."))
    kept = np.flatnonzero(keep)
    result = []
    for arm in arms:
        if arm.times is None or arm.values is None:
            result.append(arm)
            continue
        row_of = {int(position): row for row, position in enumerate(positions[arm.name])}
        result.append(replace(arm, times=None, values=arm.values[[row_of[int(position)] for position in kept]]))
    return tuple(result), tuple(ids[int(position)] for position in kept), kept


def cameras_of(
    images: dict[str, Images], options: ImportOptions, notes: list[Note], calibrations: dict[str, Path] | None = None
) -> tuple[FoundCamera, ...]:
    """Cameras with their images, each with the calibration that was given or found for it.

    Raises:
        SequenceError: a calibration file is not usable.
    """
    known = {**(calibrations or {}), **options.calibration}
    chosen = replace(options, calibration=known)
    cameras = []
    for name, each in images.items():
        notes.append(
            Note("found", f"camera {name}: {each.path}, {len(each.ids)} images, {each.size[0]} x {each.size[1]}.")
        )
        camera = FoundCamera(name, each.size, each.path, each.pattern)
        cameras.append(calibration_of(camera, chosen, notes))
    return tuple(cameras)
