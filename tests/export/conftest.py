"""Three awkward frames: rendered, empty, and repaired by hand."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from awkward import ARMS, CAMERA, SOURCES, awkward

from carts_core.export import Dataset, ExportFrame, ExportProgress, measured_frames
from carts_core.recording import Sequence

OPTIONS = {"masks": False, "truth": False, "width": 161, "height": 127, "edit": awkward}


@pytest.fixture(scope="module")
def sequence(shared_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(shared_sequence(**OPTIONS))


@pytest.fixture(scope="module")
def dataset(sequence: Sequence) -> Dataset:
    return _edited(sequence)


@pytest.fixture
def own_dataset(tiny_sequence: Callable[..., Path]) -> Dataset:
    """One whose files a test may change."""
    return _edited(Sequence.open(tiny_sequence(**OPTIONS)))


def _edited(sequence: Sequence) -> Dataset:
    """Frame 0 as rendered, frame 1 with an empty mask, frame 2 with a hole, a stroke and a single pixel."""
    frames = measured_frames(sequence, range(3))
    plain = Dataset(sequence, tuple(frames), sequence.scene, "regular")
    (*_, last) = plain.views(ExportProgress())
    repaired = last.link_ids >= 0
    rows, columns = np.nonzero(repaired)
    middle = int(np.median(rows)), int(np.median(columns[rows == int(np.median(rows))]))
    repaired[middle[0] - 2 : middle[0] + 3, middle[1] - 3 : middle[1] + 2] = False
    repaired[5:9, 3:30] = True
    repaired[120, 2] = True
    std = {ARMS[0]: np.array([1e-3, 2e-3, 1e-4, np.nan, 5e-3, 6e-3, 7e-3])}
    masks = (None, np.zeros_like(repaired), repaired)
    edited: list[ExportFrame] = [
        replace(frame, source=source, masks={} if mask is None else {CAMERA: mask})
        for frame, source, mask in zip(frames, SOURCES, masks, strict=True)
    ]
    edited[2] = replace(edited[2], joint_std=std)
    return replace(plain, frames=tuple(edited))
