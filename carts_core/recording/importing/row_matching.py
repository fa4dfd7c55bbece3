"""Matching of log rows with images: by times, frame rate, file names, numbers or order.

The methods are, in order of precedence: a given column of images, times or given rates of images and rows, a column
with the images' file names or numbers, and the order of rows if the numbers of rows and images are equal. Without a
given rate or time offset, one row per image takes precedence over times if the clocks do not overlap, or if the times
of the images only reflect the nominal rate of a video. A note reports the method and omissions.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PureWindowsPath

import numpy as np
from jaxtyping import Float, Int

from ...settings.interchange import SECONDS, Clock
from ...wording import counted
from .cameras import Images
from .columns import ColumnMeanings
from .foreign_tables import ForeignTable
from .found import FoundArm, Import, PartError

_STAMPED_DIGITS = 13
"""Minimum number of digits at which numbers in image names are considered times."""
_LONGEST = 1e6
"""Maximum duration of a recording [s]."""
_LEAST: Mapping[Clock, tuple[float, float]] = {"ns": (1e17, 9e5), "us": (1e14, 9e2), "ms": (1e11, 0.9), "s": (1e8, 0.0)}
"""Unit -> minimum time since 1970, and minimum spacing of rows, in that unit."""
_FEW = 0.1
"""Maximum share of rows without an image for a column of image numbers."""
_INDEX = ("index", "id", "", "unnamed 0", "row", "seq", "sequence")
"""Names of columns that may contain row numbers instead of image numbers."""


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """Frames of a recording and their times."""

    ids: tuple[str, ...]
    stems: tuple[str, ...]
    """File names without suffix; for a video, the ids."""
    times: Float[np.ndarray, " frames"] | None
    """Time of each frame [s]; None if unknown."""
    source: str
    """Source of the times, for the report."""
    nominal: bool = False
    """Whether the times are those of a video's constant rate."""
    given: bool = False
    """Whether the times are computed from the given frame rate."""
    counted: bool = False
    """Whether the ids count from 0, as in a video, instead of being read from names."""


@dataclass(frozen=True, eq=False)
class RowMatch:
    """Result of matching rows with images."""

    rows: Float[np.ndarray, " rows"]
    """Time of each row [s]; with `by_image`, index of the row's image, NaN without an image."""
    by_image: bool
    frame_times: Float[np.ndarray, " frames"] | None
    """Time of each frame [s]; None if rows are images and have no times."""
    time_offset: float = 0.0
    """Log time minus image time [s]."""


def frame_times(images: Images, ids: tuple[str, ...], job: Import) -> FrameTimes:
    """Determine the times of the frames `ids` of a camera from image names, the given frame rate, or a video."""
    rate = job.options.frame_rate
    stems = tuple(
        PureWindowsPath(images.pattern.format(frame=frame, domain="")).stem if images.pattern else frame
        for frame in ids
    )
    found = FrameTimes(ids, stems, None, "", counted=not images.pattern)
    if images.pattern and all(len(frame) >= _STAMPED_DIGITS for frame in ids):
        numbers = np.array([int(frame) for frame in ids], np.float64)
        clock = guess_clock(numbers)
        job.guessed(f"image names are times in {clock}.")
        return _without_rate(replace(found, times=numbers * SECONDS[clock], source="the images' names"), job)
    name, video = images.path.name, None
    if images.times is not None:
        position = {frame: index for index, frame in enumerate(images.ids)}
        video = images.times[[position[frame] for frame in ids]]
        spacing = np.diff(video)
        if len(spacing) and np.ptp(spacing) > 0.1 * np.median(spacing):
            job.found(f"image times are taken from {name}.")
            return _without_rate(replace(found, times=video, source=name), job)
    if rate is not None:
        times = _numbered(ids, job) / rate
        if video is not None and len(video) > 1:
            own = (len(video) - 1) / (video[-1] - video[0])
            if abs(own / rate - 1) > 0.01:
                job.warning(f"{name} has {own:.4g} images/s; the given frame rate of {rate:g} images/s is used.")
        job.found(f"image times are computed from {rate:g} images/s.")
        return replace(found, times=times, source="the given frame rate", given=True)
    if video is not None:
        job.found(f"image times are taken from {name}.")
        return replace(found, times=video, source=name, nominal=True)
    return found


def _without_rate(found: FrameTimes, job: Import) -> FrameTimes:
    """Return the times, and warn if a given frame rate is ignored."""
    if job.options.frame_rate is not None:
        job.warning(f"the given frame rate is not used, since the images have times ({found.source}).")
    return found


def _numbered(ids: tuple[str, ...], job: Import) -> np.ndarray:
    """Image numbers from 0, with gaps where single numbers are missing from the image names."""
    numbers = np.array([int(frame) for frame in ids], np.float64)
    steps = np.diff(numbers)
    step = float(np.median(steps)) if len(steps) else 1.0
    places = (numbers - numbers[0]) / step if step > 0 else np.arange(len(ids), dtype=float)
    if not np.array_equal(places, np.round(places)) or np.any(np.diff(places) <= 0):
        return np.arange(len(ids), dtype=float)
    if places[-1] != len(ids) - 1:
        missing = int(places[-1]) + 1 - len(ids)
        job.guessed(
            f"{counted(missing, 'number')} missing from the image names; the remaining images keep their times."
        )
    return places


def guess_clock(values: np.ndarray, span: float | None = None) -> Clock:
    """Guess the unit of times: from their magnitude for times since 1970, else from their spacing and the images'
    duration `span` [s]."""
    values = np.asarray(values, np.float64)
    values = values[np.isfinite(values)]
    largest = float(np.max(np.abs(values))) if len(values) else 0.0
    lasts = float(np.ptp(values)) if len(values) else 0.0
    for unit in _LEAST:
        # A log that would last longer than `_LONGEST` in this unit has relative times in a smaller unit.
        if largest >= _LEAST[unit][0] and lasts * SECONDS[unit] < _LONGEST:
            return unit
    step = float(np.median(np.diff(values))) if len(values) > 1 else 0.0
    guess: Clock = "s"
    for unit in _LEAST:
        guess = unit if step >= _LEAST[unit][1] and SECONDS[unit] <= SECONDS[guess] else guess
    if span is not None and span > 0 and len(values) > 1 and values[-1] > values[0]:
        shares = {unit: (values[-1] - values[0]) * factor / span for unit, factor in SECONDS.items()}
        if not 0.2 <= shares[guess] <= 50.0:
            best: Clock = min(SECONDS, key=lambda unit: abs(np.log(shares[unit])))
            if 0.2 <= shares[best] <= 50.0:
                return best
    return guess


def row_seconds(
    table: ForeignTable, column: str | None, clock: Clock | None, job: Import, span: float | None = None
) -> Float[np.ndarray, " rows"] | None:
    """Times of rows [s] from a column of a table; the unit is guessed if not given."""
    if column is None:
        return None
    values = table.numbers(column)
    if clock is None:
        clock = guess_clock(values, span)
        job.guessed(f"{table.path.name}: times of column {column!r} are in {clock}.", option="--clock")
    steps = np.diff(values.astype(np.float64))
    if (steps < 0).any():
        row = int(np.flatnonzero(steps < 0)[0]) + 1
        raise PartError(
            "columns",
            f"{table.path.name}, column {column!r}: times decrease from {values[row - 1]} to {values[row]} in row "
            f"{row + 1}. Sort the rows, or choose another column.",
            "Use --columns time COLUMN.",
        )
    if repeated := int((steps == 0).sum()):
        text = f"{counted(repeated, 'row')} with the time of the previous row; the first of each is used"
        job.warning(f"{table.path.name}: {text}.")
    return np.asarray(values, np.float64) * SECONDS[clock]


def match_rows(frames: FrameTimes, table: ForeignTable, meanings: ColumnMeanings, job: Import) -> RowMatch:
    """Match the rows of a table with images."""
    options, column = job.options, meanings.frame
    explicit = "frame" in options.columns
    named = None if column is None else _named(frames, table, column, job)
    if explicit and named is None:
        raise PartError(
            "columns",
            f"{table.path.name}: column {column!r} does not contain the image names, which range from "
            f"{frames.stems[0]} to {frames.stems[-1]}. Choose another column.",
            "Use --columns frame COLUMN.",
        )
    span = None if frames.times is None or len(frames.times) < 2 else float(frames.times[-1] - frames.times[0])
    times, source = row_seconds(table, meanings.time, options.clock, job, span), f"column {meanings.time!r}"
    if options.row_rate is not None and times is None:
        times, source = np.arange(len(table)) / options.row_rate, f"{options.row_rate:g} rows/s"
    elif options.row_rate is not None:
        job.warning(f"{table.path.name}: the given rate of rows is not used, since the rows have times ({source}).")
    one_each = None
    if named is not None and (named < 0).mean() <= _FEW:
        known = named[named >= 0]
        one_each = named if len(np.unique(known)) == len(known) >= 0.5 * len(frames.ids) else None
    in_order = one_each is None and named is None and len(table) == len(frames.ids)
    if in_order:
        one_each = np.arange(len(table))
    if times is not None and frames.times is not None and not explicit:
        apart = bool(frames.times[0] > times[-1] or frames.times[-1] < times[0])
        stated = frames.given or options.row_rate is not None
        own_clock = options.time_offset is None and not stated and (apart or frames.nominal)
        if not (own_clock and one_each is not None):
            return _by_time(frames, meanings, times, source, apart, named is not None, job)
    if explicit or named is not None:
        assert named is not None and column is not None
        general = column.strip().lower().replace("_", " ").replace(":", "") in _INDEX
        counts_rows = general and table.columns[column].dtype.kind in "iuf" and (named < 0).mean() > _FEW
        if not explicit and one_each is None and counts_rows:
            raise PartError(
                "columns",
                f"{table.path.name}: column {column!r} counts {len(table)} rows and there are "
                f"{counted(len(frames.ids), 'image')}, so it cannot assign rows to images. Give the frame rate of "
                "the images, or confirm the column.",
                f"Use --frame-rate or --columns frame {column!r}.",
            )
        return _by_image(frames, table, named, times, f"column {column!r}", job, stated=explicit)
    if in_order:
        return _by_image(frames, table, np.arange(len(table)), times, "the order of rows and images", job, stated=False)
    lacking = {
        "the table has no times": ("the rate of the rows", "--row-rate", times),
        "the images have no times": ("the frame rate of the images", "--frame-rate", frames.times),
    }
    unknown = {text: remedy for text, (*remedy, known) in lacking.items() if known is None}
    rates, flags = (" and ".join(parts) for parts in zip(*unknown.values(), strict=True))
    raise PartError(
        "columns",
        f"the recording has {counted(len(frames.ids), 'image')} and {table.path.name} has "
        f"{counted(len(table), 'row')}, and {' and '.join(unknown)}. Make the numbers equal, choose the column of "
        f"times or of image names, or give {rates}.",
        f"Use --columns time COLUMN, --columns frame COLUMN or {flags}.",
    )


def _by_time(
    frames: FrameTimes, meanings: ColumnMeanings, times: np.ndarray, source: str, apart: bool, named: bool, job: Import
) -> RowMatch:
    assert frames.times is not None
    dropped = f"; column {meanings.frame!r} is not used" if named else ""
    text = f"rows are matched with images by time: {source} and {frames.source}{dropped}."
    option = "--columns frame COLUMN" if named else ""
    job.found(text, option=option, given="time" in job.options.columns)
    offset = job.options.time_offset
    if offset is None:
        offset = float(times[0] - frames.times[0]) if apart else 0.0
        text = "the clocks do not overlap; the first row is assigned to the first image" if apart else "0 s"
        job.guessed(f"time offset: {text}.", option="--time-offset")
    return RowMatch(times, False, frames.times, float(offset))


def _by_image(
    frames: FrameTimes,
    table: ForeignTable,
    positions: np.ndarray,
    times: np.ndarray | None,
    how: str,
    job: Import,
    *,
    stated: bool,
) -> RowMatch:
    text = f"each row belongs to one image, by {how}."
    job.found(text, option="--columns frame COLUMN, --frame-rate", given=stated)
    if unnamed := int((positions < 0).sum()):
        job.warning(f"{table.path.name}: {unnamed} of {counted(len(positions), 'row')} belong to no image.")
    known = positions[positions >= 0]
    if repeated := len(known) - len(np.unique(known)):
        text = f"{table.path.name}: {counted(repeated, 'row')} of an image that already has a row; the first is used."
        job.warning(text)
    taken = frames.times
    if times is not None and not frames.given:
        own = np.full(len(frames.ids), np.nan)
        own[known[::-1]] = times[positions >= 0][::-1]
        finite = own[np.isfinite(own)]
        if len(finite) and (np.diff(finite) > 0).all():
            taken = own
            if frames.times is not None:
                job.found(f"image times are taken from their rows instead of {frames.source}.")
    return RowMatch(np.where(positions >= 0, positions.astype(float), np.nan), True, taken)


def _named(frames: FrameTimes, table: ForeignTable, column: str, job: Import) -> Int[np.ndarray, " rows"] | None:
    """Index of each row's image, -1 without an image; None if the matched rows are fewer than half of the rows and
    fewer than half of the images."""
    by_stem, cells = {stem: index for index, stem in enumerate(frames.stems)}, table.columns[column].tolist()
    exact = [by_stem.get(_stem(cell), -1) if isinstance(cell, str) else -1 for cell in cells]
    if max(exact, default=-1) < 0:
        where = f"{table.path.name}: column {column!r}"
        exact = _numbers_to_positions([_number(cell) for cell in cells], frames, where, job)
    named = np.array(exact)
    enough = 2 * (named >= 0).sum() >= min(len(frames.ids), len(named))
    return named if enough else None


def _stem(cell: str) -> str:
    return PureWindowsPath(cell.strip()).stem


def _number(cell: object) -> int | None:
    """Parse a whole number, or the last number in a file name."""
    if isinstance(cell, str):
        found = re.findall(r"\d+", _stem(cell))
        return int(found[-1]) if found else None
    return int(cell) if isinstance(cell, int | float) and np.isfinite(cell) and cell == int(cell) else None


def _numbers_to_positions(numbers: list[int | None], frames: FrameTimes, column: str, job: Import) -> list[int]:
    ids = [int(frame) for frame in frames.ids]
    position = {number: index for index, number in enumerate(ids)}
    known = [number for number in numbers if number is not None]
    best, shift = sum(number in position for number in known), 0
    for other in (-1, 1):
        hits = sum(number + other in position for number in known)
        # If only a shift by one gives every row an image, the column counts from 0 instead of 1, or vice versa.
        if hits > best and hits == len(known) and min(known) + other == ids[0]:
            best, shift = hits, other
    if shift and frames.counted:
        job.found(f"{column} counts from {1 if shift < 0 else 0}.")
    elif shift:
        job.warning(
            f"{column} counts from {min(known)} and the images from {ids[0]}; its first row is assumed to be the first "
            f"image. Otherwise, rename the images so that they begin with {min(known)}."
        )
    return [-1 if number is None else position.get(number + shift, -1) for number in numbers]


def by_rows(
    arms: Sequence[FoundArm], ids: Sequence[str], job: Import, times: Float[np.ndarray, " frames"] | None = None
) -> tuple[tuple[FoundArm, ...], tuple[str, ...], np.ndarray]:
    """Restrict arms, whose times are indices into `ids`, to the frames with rows of all arms.

    Args:
        times: times of the frames [s], assigned to the rows so that a delay can be estimated later.

    Returns:
        The arms, the remaining ids, and their indices in `ids`.
    """
    positions = {arm.name: np.asarray(arm.times, int) for arm in arms if arm.times is not None}
    keep = np.all([np.isin(np.arange(len(ids)), rows) for rows in positions.values()], axis=0) & np.ones(len(ids), bool)
    if not keep.any():
        problem = "no frame has joint positions of all arms."
        raise PartError("recording", problem, "Import fewer arms: --arms.")
    if not keep.all():
        job.warning(f"left out {int((~keep).sum())} of {len(keep)} frames: no joint positions.")
    kept = np.flatnonzero(keep)
    timed = times is not None and bool(np.isfinite(times[kept]).all() and (np.diff(times[kept]) > 0).all())
    result = []
    for arm in arms:
        if arm.times is None or arm.values is None:
            result.append(arm)
            continue
        row_of = {int(position): row for row, position in enumerate(positions[arm.name])}
        values = arm.values[[row_of[int(position)] for position in kept]]
        result.append(replace(arm, times=times[kept] if timed and times is not None else None, values=values))
    return tuple(result), tuple(ids[int(position)] for position in kept), kept
