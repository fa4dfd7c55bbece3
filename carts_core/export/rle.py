"""Masks as run lengths, which lose nothing."""

import numpy as np
from jaxtyping import Bool
from pycocotools import mask as coco_mask


def coco_rle(mask: Bool[np.ndarray, "height width"]) -> dict[str, object]:
    """COCO's compressed run lengths (column by column): `size` as [height, width], and `counts` as text."""
    counts = coco_mask.encode(np.asfortranarray(mask, dtype=np.uint8))["counts"]
    assert isinstance(counts, bytes)
    return {"size": list(mask.shape), "counts": counts.decode("ascii")}


def row_runs(mask: Bool[np.ndarray, "height width"]) -> list[int]:
    """Lengths of runs row by row, in turn outside and inside the mask; the first is outside and may be 0."""
    flat = mask.ravel()
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    lengths = np.diff(changes, prepend=0, append=flat.size).tolist()
    return [0, *lengths] if flat[0] else lengths


def bounding_box(mask: Bool[np.ndarray, "height width"]) -> tuple[int, int, int, int]:
    """Left, top, width and height [px] of a mask that is not empty."""
    columns, rows = np.flatnonzero(mask.any(0)), np.flatnonzero(mask.any(1))
    return int(columns[0]), int(rows[0]), int(columns[-1] - columns[0] + 1), int(rows[-1] - rows[0] + 1)
