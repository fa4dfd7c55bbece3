"""Pixels of masks that are written as run lengths or polygons."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

_BITS, _MORE, _SIGN, _FIRST = 5, 0x20, 0x10, 48
"""Of COCO's text: five bits a character, from "0" on."""


def runs_of_text(text: str) -> list[int]:
    """COCO's compressed run lengths as numbers.

    Raises:
        ValueError: the text is none.
    """
    runs: list[int] = []
    value = place = 0
    for character in text:
        code = ord(character) - _FIRST
        if not 0 <= code < 2 * _MORE or place > 40:
            raise ValueError(f"the character {character!r} is no part of run lengths")
        value |= (code & (_MORE - 1)) << place
        place += _BITS
        if not code & _MORE:
            if code & _SIGN:
                value -= 1 << place
            runs.append(value + (runs[-2] if len(runs) > 2 else 0))
            value = place = 0
    if place:
        raise ValueError("the run lengths end within a number")
    return runs


def mask_of_runs(runs: Sequence[int], height: int, width: int, *, by_columns: bool) -> Bool[np.ndarray, "height width"]:
    """A mask of run lengths, in turn outside and inside; the first is outside.

    Raises:
        ValueError: they are not as many pixels as the mask has.
    """
    lengths = np.asarray(runs, np.int64)
    if lengths.ndim != 1 or (lengths < 0).any() or (lengths > height * width).any() or lengths.sum() != height * width:
        raise ValueError(f"the run lengths do not make {width} x {height} pixels")
    flat = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
    return flat.reshape(width, height).T if by_columns else flat.reshape(height, width)


def mask_of_polygon(
    points: Float[np.ndarray, "corners 2"], height: int, width: int
) -> Bool[np.ndarray, "height width"]:
    """Pixels whose centres are inside a polygon, by the even-odd rule; corners from the upper left corner [px]."""
    flips = np.zeros((height, width + 1), np.int32)
    ends = np.roll(points, -1, axis=0)
    for (x0, y0), (x1, y1) in zip(points, ends, strict=True):
        low, high = min(y0, y1), max(y0, y1)
        rows = np.arange(max(0, int(np.ceil(low - 0.5))), min(height, int(np.ceil(high - 0.5))))
        if len(rows):
            # Where the edge crosses the middle of the row; from the next centre on one is on its other side.
            crossing = x0 + (rows + 0.5 - y0) * (x1 - x0) / (y1 - y0)
            np.add.at(flips, (rows, np.clip(np.ceil(crossing - 0.5), 0, width).astype(int)), 1)
    return np.cumsum(flips, axis=1)[:, :width] % 2 == 1
