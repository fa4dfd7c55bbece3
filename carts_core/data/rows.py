"""The rows of a sequence: which frames there are, when, and which tables tell about them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..errors import SequenceError
from .patterns import FrameId, expand
from .table import Table, read_table
from .toml_table import TomlTable


@dataclass(frozen=True)
class Rows:
    """The rows of a sequence, as the `[kinematics]` table gives them."""

    table: Table
    """Measured joint positions."""
    truth: Path | None
    """Table of true joint positions."""
    frame_column: str
    frame_pattern: str
    """How a frame is called, from its cell in that column."""
    delimiter: str
    frame_ids: tuple[str, ...]
    timestamps: Float[np.ndarray, " frames"] | None
    """[s]"""
    video_frames: tuple[int, ...]
    """Number of every frame in its video, from 0."""

    def table_of(self, arm: TomlTable) -> Table:
        """The measured joint positions of an arm: its own `table`, or that of the sequence.

        Raises:
            SequenceError: it is missing or has other frames.
        """
        own = arm.take("table", str, "")
        return self._read(arm.path(own)) if own else self.table

    def truth_of(self, arm: TomlTable) -> Table | None:
        """The true joint positions of an arm: its own `truth`, or that of the sequence, or None.

        Raises:
            SequenceError: it is missing or has other frames.
        """
        own = arm.take("truth", str, "")
        path = arm.path(own) if own else self.truth
        return None if path is None else self._read(path)

    def _read(self, path: Path) -> Table:
        table = read_table(path, self.delimiter)
        _check_same_frames(table, _frame_ids(table, self.frame_column, self.frame_pattern), self.frame_ids)
        return table


def take_rows(section: TomlTable) -> Rows:
    """The rows that the `[kinematics]` table describes.

    Raises:
        SequenceError: the table is missing, or its frames, times or numbers are wrong.
    """
    delimiter = section.take("delimiter", str, ",")
    if len(delimiter) != 1:
        raise section.error("delimiter", f"is {delimiter!r}, but must be one character.")
    table = read_table(section.path(section.take("table", str)), delimiter)
    frame_column = section.take("frame", str, "frame")
    frame_pattern = section.take("frame_id", str, "{frame}")
    if "{frame" not in frame_pattern:
        raise section.error("frame_id", f'is {frame_pattern!r}. It must contain {{frame}}, say "{{frame:03d}}".')
    timestamp, video_frame = section.take("timestamp", str, ""), section.take("video_frame", str, "")
    truth = section.take("truth", str, "")
    section.finish()
    return Rows(
        table=table,
        truth=section.path(truth) if truth else None,
        frame_column=frame_column,
        frame_pattern=frame_pattern,
        delimiter=delimiter,
        frame_ids=_frame_ids(table, frame_column, frame_pattern),
        timestamps=table.numbers(timestamp, section.name("timestamp")) if timestamp else None,
        video_frames=_video_frames(table, video_frame, section) if video_frame else tuple(range(len(table))),
    )


def _video_frames(table: Table, column: str, section: TomlTable) -> tuple[int, ...]:
    numbers = table.numbers(column, section.name("video_frame"))
    if (wrong := np.flatnonzero((numbers < 0) | (numbers != np.round(numbers)))).size:
        raise SequenceError(
            f"{table.path}, line {table.lines[wrong[0]]}, column {column!r}: {numbers[wrong[0]]:g} is not a frame "
            "number. Frames of a video are counted 0, 1, 2, ..."
        )
    return tuple(int(number) for number in numbers)


def _frame_ids(table: Table, column: str, pattern: str) -> tuple[str, ...]:
    key = f"{table.path}, column {column!r}"
    ids = tuple(expand(pattern, key, frame=FrameId(cell)) for cell in table.text(column, "`frame` in [kinematics]"))
    lines: dict[str, int] = {}
    for frame_id, line in zip(ids, table.lines, strict=True):
        if not frame_id:
            raise SequenceError(f"{key}, line {line}: the frame has no id. Fill it in.")
        if frame_id in lines:
            raise SequenceError(
                f"{key}: frame {frame_id!r} is in line {lines[frame_id]} and again in line {line}. "
                "Remove one of them, or number the frames anew."
            )
        lines[frame_id] = line
    return ids


def _check_same_frames(table: Table, ids: tuple[str, ...], wanted: tuple[str, ...]) -> None:
    if len(ids) != len(wanted):
        raise SequenceError(
            f"{table.path} has {len(ids)} rows, but the kinematics table has {len(wanted)}. "
            "All tables of a sequence must have the same frames in the same order."
        )
    for given, expected, line in zip(ids, wanted, table.lines, strict=True):
        if given != expected:
            raise SequenceError(
                f"{table.path}, line {line} is frame {given!r}, but the kinematics table has frame {expected!r} there. "
                "All tables of a sequence must have the same frames in the same order."
            )
