"""Frames of a sequence: ids, times and file names by pattern (`left/{frame}.jpg`, `{domain}/{index:06d}.png`,
`left/*.jpg`).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from string import Formatter

import numpy as np
from jaxtyping import Float

from ..errors import SequenceError
from ..files import allowed_names, name_fault
from ..files.reading import MAX_NAME_LENGTH, check_path, is_regular
from ..wording import closest, counted, shown
from .kinematics_table import Table, read_table
from .toml_table import TomlTable, check_file_name

_WIDTH_DIGITS = 6
_PLACEHOLDERS = ("frame", "index", "domain", "camera")
EXAMPLES = '"left/{frame}.jpg", "left/{frame:06d}.png", "{domain}/{index:04d}.jpg"'


class FrameId(str):
    """Frame id for use in patterns: `{frame}` is its text, `{frame:03d}` its padded number."""

    def __format__(self, spec: str) -> str:
        return format(int(self), spec) if spec.endswith("d") else format(str(self), spec)


def expand(pattern: str, key: str, **values: object) -> str:
    """Fill in the {placeholders} of a pattern."""
    try:
        _check_format(pattern)
        filled = pattern.format(**values)
        check_path(filled)
    except KeyError as error:
        raise SequenceError(
            f"{key}: {shown(pattern)} has the unknown placeholder {error}.{closest(str(error.args[0]), _PLACEHOLDERS)} "
            f"Examples: {EXAMPLES}."
        ) from error
    except ValueError as error:
        raise SequenceError(
            f"{key}: {shown(pattern)} cannot be filled in with {shown(values)}: {error}. Examples: {EXAMPLES}."
        ) from error
    return filled


def escaped(path: Path | str) -> str:
    """Path as part of a pattern, with its braces doubled."""
    return str(path).replace("{", "{{").replace("}", "}}")


@lru_cache(maxsize=64)
def _check_format(pattern: str) -> None:
    """Check a pattern; `KeyError` for unknown placeholders, `ValueError` for malformed or too wide placeholders."""
    for _, name, form, conversion in Formatter().parse(pattern):
        if name is None:
            continue
        if name not in _PLACEHOLDERS:
            raise KeyError(name)
        if conversion or "{" in (form or ""):
            raise ValueError("a placeholder may only have a width, such as 06d")
        if any(
            len(width) > _WIDTH_DIGITS or int(width) > MAX_NAME_LENGTH for width in re.findall(r"[0-9]+", form or "")
        ):
            raise ValueError(f"a name is longer than {MAX_NAME_LENGTH} characters")


def is_per_frame(pattern: str) -> bool:
    """Whether the pattern contains the id or index of the frame."""
    return re.search(r"\{(frame|index)\b", pattern) is not None


def is_glob(pattern: str) -> bool:
    """Whether the pattern has wildcards; the matching files are used in sorted order."""
    return "*" in pattern or "?" in pattern


_FRAME_ALONE = "{frame}"
"""Pattern with which ids equal the cells of their column."""
_SHORT = 50
"""Number of digits up to which an id is never too long for a file name."""
MAX_FRAMES = 1_000_000
"""Maximum number of frames of a sequence; nine hours at 30 frames per second."""


@dataclass(frozen=True)
class FrameList:
    """The frames of a sequence, in order."""

    frame_ids: tuple[str, ...]
    timestamps: Float[np.ndarray, " frames"] | None
    """Acquisition time of each image [s]."""
    video_frames: tuple[int, ...]
    """Number of each frame in its video, from 0."""
    counted: str
    """Number of frames, as a clause for errors, such as "the kinematics table has 3 rows"."""
    table: Table | None = None
    """Table with one row per frame; None for all frames of a video, and for a selection of frames."""

    def __post_init__(self) -> None:
        if len(self.frame_ids) > MAX_FRAMES:
            raise SequenceError(
                f"{self.counted}; a sequence may have at most {MAX_FRAMES:,} frames. Divide the recording."
            )

    def select(self, kept: Sequence[int]) -> "FrameList":
        """Frames of these indices, without their table."""
        times = None if self.timestamps is None else self.timestamps[list(kept)]
        ids, numbers = [self.frame_ids[index] for index in kept], [self.video_frames[index] for index in kept]
        return FrameList(tuple(ids), times, tuple(numbers), self.counted)


@dataclass(frozen=True)
class FrameNames:
    """Column of frame ids in a table, and pattern of the ids."""

    column: str
    pattern: str
    """Pattern that converts a cell of the column to an id."""
    key: str
    """Key that names the column, for errors."""

    def of(self, table: Table) -> tuple[str, ...]:
        """Frame ids of all rows."""
        key = f"{table.path}, column {self.column!r}"
        cells = table.text(self.column, self.key)
        if self.pattern == _FRAME_ALONE:
            ids = tuple(cells)
        else:
            ids = tuple(expand(self.pattern, key, frame=FrameId(cell)) for cell in cells)
        if all(map(str.isdecimal, ids)) and max(map(len, ids)) <= _SHORT and len(set(ids)) == len(ids):
            return ids  # Fast path, since an hour has 100,000 frames: whole numbers are invalid only if repeated.
        lines: dict[str, int] = {}
        for row, (frame_id, line) in enumerate(zip(ids, table.lines, strict=True)):
            if not frame_id:
                raise table.error(f", column {self.column!r}: the frame has no id. Add one.", row)
            if frame_id in lines:
                text = f"frame {frame_id!r} is already in line {lines[frame_id]}. Remove it, or renumber the frames."
                raise table.error(f", column {self.column!r}: {text}", row)
            if fault := name_fault(frame_id):
                text = f"the frame id is {frame_id!r}, {fault}. {allowed_names()}."
                raise table.error(f", column {self.column!r}: {text}", row)
            lines[frame_id] = line
        return ids


def take_frame_names(section: TomlTable) -> FrameNames:
    """Read the keys `frame` and `frame_id`."""
    return FrameNames(section.take("frame", str, "frame"), _take_pattern(section), f"`frame` in {section.where}")


def take_frame_list(section: TomlTable) -> FrameList:
    """Read the frames described by `[frames]`: the rows of a table, or all frames of a video."""
    if "video" in section:
        return _frames_of_video(section)
    if "table" not in section:
        raise section.error(
            "table", "is missing. Give a CSV file with the time of every frame, or a `video` with frame times."
        )
    table = read_table(section.path(section.take("table", str)), take_delimiter(section), "table of frames")
    timestamp = section.take("timestamp", str, "timestamp")
    if not timestamp:
        raise section.error("timestamp", "is empty. Name the column with the time of every frame [s].")
    return list_of_rows(
        table, take_frame_names(section), timestamp, section, f"{table.path} has {counted(len(table), 'row')}"
    )


def list_of_rows(table: Table, names: FrameNames, timestamp: str, section: TomlTable, counted: str) -> FrameList:
    """Create frames from the rows of a table and the key `video_frame` of its section.

    Args:
        timestamp: name of the column with times [s]; empty for frames without times.
        counted: number of frames, as a clause for errors.
    """
    frame_ids = names.of(table)
    times = table.numbers(timestamp, section.name("timestamp")) if timestamp else None
    column = section.take("video_frame", str, "")
    video_frames = numbers_of_frames(table, column, section.name("video_frame")) if column else tuple(range(len(table)))
    return FrameList(frame_ids, times, video_frames, counted, table)


def take_delimiter(section: TomlTable) -> str:
    """Read the key `delimiter`."""
    delimiter = section.take("delimiter", str, ",")
    if len(delimiter) != 1:
        raise section.error("delimiter", f"is {delimiter!r}, but must be one character.")
    return delimiter


def _frames_of_video(section: TomlTable) -> FrameList:
    path = section.path(section.take("video", str))
    for key in ("table", "frame", "timestamp", "video_frame", "delimiter"):
        if key in section:
            raise section.error(
                key, "cannot be combined with `video`, since all frames of the video are used. Remove one."
            )
    pattern = _take_pattern(section)
    from .video import index_video  # noqa: PLC0415  It imports PyAV.

    index = index_video(path)
    if index.timestamps is None:
        raise section.error(
            "video", f"is {path}, whose frames have no times. Give a `table` with the time of every frame instead."
        )
    numbers = tuple(range(index.count))
    ids = tuple(expand(pattern, section.name("frame_id"), frame=FrameId(number)) for number in numbers)
    for frame_id in ids:
        check_file_name(section, "frame_id", "gives", frame_id)
    return FrameList(ids, index.timestamps, numbers, f"{path} has {counted(index.count, 'frame')}")


def _take_pattern(section: TomlTable) -> str:
    pattern = section.take("frame_id", str, _FRAME_ALONE)
    if "{frame" not in pattern:
        raise section.error("frame_id", f'is {pattern!r}, but must contain {{frame}}, such as "{{frame:03d}}".')
    return pattern


def numbers_of_frames(table: Table, column: str, key: str) -> tuple[int, ...]:
    """Read the video frame numbers of the rows from a column of a table."""
    numbers = table.numbers(column, key)
    if (wrong := np.flatnonzero((numbers < 0) | (numbers != np.round(numbers)))).size:
        text = f", column {column!r}: {numbers[wrong[0]]:g} is not a frame number. Frame numbers of a video start at 0."
        raise table.error(text, wrong[0])
    return tuple(int(number) for number in numbers)


_SHOWN_MISSING = 3
_MAX_WILD_PARTS = 2


def frame_files(
    folder: Path, pattern: str, key: str, frames: FrameList, *, domain: str, camera: str
) -> tuple[Path, ...]:
    """File of each frame, in the order of the frames; the files need not exist."""
    if is_per_frame(pattern):
        return tuple(
            folder / expand(pattern, key, frame=FrameId(frame_id), index=row, domain=domain, camera=camera)
            for row, frame_id in enumerate(frames.frame_ids)
        )
    filled = expand(pattern, key, domain=domain, camera=camera)
    fixed, found = _matching(folder / filled, key)
    if len(found) != len(frames.frame_ids):
        raise SequenceError(
            f"{key}: {filled!r} matches {counted(len(found), 'file')} in {fixed}, but {frames.counted}. "
            f"The numbers must be equal, since the n-th file belongs to the n-th frame. Or name the files by frame, as "
            f"in {EXAMPLES}."
        )
    return tuple(found)


def _matching(base: Path, key: str) -> tuple[Path, list[Path]]:
    """Folder above the first wildcard, and the matching files in it, in natural order."""
    fixed = next(parent for parent in base.parents if not is_glob(str(parent)))
    wild = base.relative_to(fixed)
    if "**" in wild.parts or len(wild.parts) > _MAX_WILD_PARTS:
        raise SequenceError(
            f"{key}: {str(wild)!r} has ** or wildcards before the last {_MAX_WILD_PARTS} parts of the path, which is "
            "not allowed. Name the folder."
        )

    def natural(path: Path) -> list[list[tuple[int, str]]]:
        # `part2/frame9` comes before `part2/frame10`, and this before `part10/frame1`.
        return [
            [(int(text), "") if text.isdecimal() else (-1, text) for text in re.split(r"(\d+)", part)]
            for part in path.relative_to(fixed).parts
        ]

    try:
        return fixed, sorted(filter(is_regular, fixed.glob(str(wild))), key=natural)
    except (ValueError, OSError) as error:
        raise SequenceError(f"{key}: {str(wild)!r} cannot be searched for: {error}. Examples: {EXAMPLES}.") from error


def check_present(key: str, files: tuple[Path, ...], frames: FrameList, hint: str = "") -> None:
    """Check that the file of every frame exists."""
    missing = [(file, frame_id) for file, frame_id in zip(files, frames.frame_ids, strict=True) if not is_regular(file)]
    if missing:
        shown = ", ".join(f"{file} (frame {frame_id})" for file, frame_id in missing[:_SHOWN_MISSING])
        rest = f" and {len(missing) - _SHOWN_MISSING} more" if len(missing) > _SHOWN_MISSING else ""
        raise SequenceError(
            f"{key}: {len(missing)} of {counted(len(files), 'file')} {'is' if len(missing) == 1 else 'are'} missing: "
            f"{shown}{rest}. Each frame needs a file ({frames.counted}). Restore the files, correct the pattern, or "
            f"remove the rows.{hint}"
        )
