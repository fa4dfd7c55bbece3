"""The kinematics tables of a sequence, and how their rows become joint positions of its frames."""

from dataclasses import dataclass
from pathlib import Path

from ..errors import SequenceError
from ..wording import counted
from .frame_list import FrameList, FrameNames, list_of_rows, take_delimiter, take_frame_list, take_frame_names
from .joints import JointColumns
from .matching import JointSamples, RowTimes, TimeMatching, row_times, take_matching
from .table import Table, read_table
from .toml_table import TomlTable


@dataclass(frozen=True)
class Rows:
    """The tables of a sequence, as `[kinematics]` and `[frames]` describe them."""

    frames: FrameList
    matching: TimeMatching | None
    """How rows are matched with frames by time; None where every row is a frame."""
    table: Table
    """Measured joint positions."""
    truth: Path | None
    """Table of true joint positions."""
    delimiter: str
    names: FrameNames | None
    """Where tables have the frames' ids; None where rows are matched by time."""
    timestamp: str
    """Column with a row's time; empty without one."""

    def measured_of(self, arm: TomlTable, columns: JointColumns) -> JointSamples:
        """The measured joint positions of an arm, from its own `table` or that of the sequence.

        Raises:
            SequenceError: the table is missing, wrong, or has other frames.
        """
        own = arm.take("table", str, "")
        return self._samples(self.read(arm.path(own)) if own else self.table, columns)

    def truth_of(self, arm: TomlTable, columns: JointColumns) -> JointSamples | None:
        """The true joint positions of an arm, from its own `truth` or that of the sequence; None without either.

        Raises:
            SequenceError: the table is missing, wrong, or has other frames.
        """
        own = arm.take("truth", str, "")
        path = arm.path(own) if own else self.truth
        return None if path is None else self._samples(self.read(path), columns)

    def read(self, path: Path) -> Table:
        """Another table with the same frames, or of the same clock.

        Raises:
            SequenceError: the table is missing, wrong, or has other frames.
        """
        table = read_table(path, self.delimiter)
        if self.names is not None:
            _check_same_frames(table, self.names.of(table), self.frames.frame_ids)
        return table

    def times_of(self, table: Table) -> RowTimes:
        """When the rows of a table were logged.

        Raises:
            SequenceError: there is no such column, or the times do not increase.
        """
        times = None if self.matching is None else row_times(table, self.timestamp, "`timestamp` in [kinematics]")
        return RowTimes(table.path, table.lines, times)

    def _samples(self, table: Table, columns: JointColumns) -> JointSamples:
        return JointSamples(columns.read(table), self.times_of(table))


def take_rows(section: TomlTable, frames_section: TomlTable | None) -> Rows:
    """The rows that the `[kinematics]` table describes.

    Args:
        section: `[kinematics]`.
        frames_section: `[frames]`, whose times the rows are matched with; None where every row is a frame.

    Raises:
        SequenceError: a table is missing, or its frames, times or numbers are wrong.
    """
    delimiter = take_delimiter(section)
    table = read_table(section.path(section.take("table", str)), delimiter)
    timestamp, truth = section.take("timestamp", str, ""), section.take("truth", str, "")
    if frames_section is None:
        names, matching = take_frame_names(section), None
        frames = list_of_rows(
            table, names, timestamp, section, f"the kinematics table has {counted(len(table), 'row')}"
        )
    else:
        for key in ("frame", "frame_id", "video_frame"):
            if key in section:
                raise section.error(key, "describes frames, which [frames] does here. Move it there.")
        if not timestamp:
            raise section.error(
                "timestamp", "is missing: with [frames], rows are matched by time. Name the column with the time [s]."
            )
        names, matching = None, take_matching(frames_section)
        frames = take_frame_list(frames_section)
        frames_section.finish()
    section.finish()
    return Rows(frames, matching, table, section.path(truth) if truth else None, delimiter, names, timestamp)


def _check_same_frames(table: Table, ids: tuple[str, ...], wanted: tuple[str, ...]) -> None:
    if len(ids) != len(wanted):
        raise SequenceError(
            f"{table.path} has {counted(len(ids), 'row')}, but the kinematics table has {len(wanted)}. "
            "All tables of a sequence must have the same frames in the same order."
        )
    for given, expected, line in zip(ids, wanted, table.lines, strict=True):
        if given != expected:
            raise SequenceError(
                f"{table.path}, line {line} is frame {given!r}, but the kinematics table has frame {expected!r} there. "
                "All tables of a sequence must have the same frames in the same order."
            )
