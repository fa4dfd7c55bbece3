"""Images and videos beside a bag that holds the kinematics alone."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ...errors import SequenceError
from ...settings.importing import ImportOptions
from ..importing.found import FoundArm, FoundCamera, Note
from ..importing.media import cameras_of, common_ids, find_images
from ..importing.row_matching import frame_times


@dataclass(frozen=True, eq=False)
class SeparateImages:
    """Cameras whose images lie in files, and the frames that all of them have."""

    cameras: tuple[FoundCamera, ...]
    ids: tuple[str, ...]
    times: Float[np.ndarray, " frames"]
    """[s], in a clock of their own."""

    def offset(self, arms: tuple[FoundArm, ...], notes: list[Note]) -> float:
        """Time in the kinematics minus time of the images [s], where nobody has said it: 0 in one clock, and else as
        if both had begun together."""
        begin = [float(arm.times[0]) for arm in arms if arm.times is not None]
        end = [float(arm.times[-1]) for arm in arms if arm.times is not None]
        apart = not begin or self.times[0] > max(end) or self.times[-1] < min(begin)
        offset = max(begin) - float(self.times[0]) if begin and apart else 0.0
        text = "the clocks do not overlap: images and kinematics are taken to begin together" if offset else "0 s"
        notes.append(Note("guessed", f"time offset: {text} (change: --time-offset)."))
        return offset


def separate_images(path: Path, topics: list[str], options: ImportOptions, notes: list[Note]) -> SeparateImages | None:
    """The images that were named as files or folders; None where they are topics of the bag, or nobody named any.

    Args:
        path: of the bag; names are relative to where the command is run, or to its folder.
        topics: of its images.
        options: with the names.
        notes: what was found is added.

    Raises:
        SequenceError: some are topics and some are files, they have no times, or cannot be read.
    """
    places = {name: _place(path, given) for name, given in options.images.items() if given not in topics}
    files: Mapping[str, Path] = {name: place for name, place in places.items() if place is not None}
    if not files:
        return None
    if len(files) < len(options.images):
        raise SequenceError("images are either all topics of the bag or all files beside it. Name one kind.")
    images = {name: find_images(place) for name, place in files.items()}
    ids = common_ids(list(images.values()))
    if not ids:
        raise SequenceError(f"{path}: no frame has an image of every camera. Number them alike, or import one camera.")
    first = next(iter(images.values()))
    times = frame_times(first, ids, options, notes.append).times
    if times is None:
        raise SequenceError(f"images in {first.path} have no times. Say how many there are a second: --frame-rate.")
    return SeparateImages(cameras_of(images, options, notes), ids, times)


def _place(path: Path, given: str) -> Path | None:
    return next((place for place in (Path(given), path.parent / given) if os.path.exists(place)), None)
