"""Two logs of the same motion whose rows have times of their own."""

import numpy as np
from jaxtyping import Float, Int

SAME_CYCLE = 2e-3
"""[s] Rows of two topics this near to each other were written in the same cycle of a controller."""


def clock_offset(times: Float[np.ndarray, " rows"], other: Float[np.ndarray, " other_rows"]) -> float:
    """By how much rows of `times` are stamped later than the rows of `other` of the same cycle [s].

    Topics of one cycle are stamped one after the other, so their stamps differ by a constant, which is not motion. It
    is the median over rows that are within `SAME_CYCLE` of each other; 0 where fewer than half are, as between topics
    of different rates.
    """
    difference = times - other[nearest(times, other)]
    same = np.abs(difference) <= SAME_CYCLE
    return float(np.median(difference[same])) if 2 * same.sum() >= len(times) else 0.0


def at_times(
    wanted: Float[np.ndarray, " wanted"], times: Float[np.ndarray, " rows"], values: Float[np.ndarray, "rows columns"]
) -> Float[np.ndarray, "wanted columns"]:
    """Values at other times, linear between the rows before and after; NaN before the first and after the last row."""
    columns = [np.interp(wanted, times, column, left=np.nan, right=np.nan) for column in values.T]
    return np.stack(columns, axis=1)


def nearest(times: Float[np.ndarray, " rows"], other: Float[np.ndarray, " other_rows"]) -> Int[np.ndarray, " rows"]:
    """For each of `times`, the row of `other` (increasing) that is nearest to it."""
    after = np.searchsorted(other, times).clip(1, max(len(other) - 1, 1))
    before = after - 1
    after = after.clip(0, len(other) - 1)
    return np.where(np.abs(times - other[before]) <= np.abs(times - other[after]), before, after)
