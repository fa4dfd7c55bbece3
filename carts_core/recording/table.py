"""Kinematics tables: CSV files with a header, a row per frame and columns called by name."""

import csv
import io
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..errors import SequenceError
from ..files.reading import TABLE, open_regular
from ..wording import closest, listed, shown

MOST_CELLS = 10_000_000
"""Largest table; an hour at 100 rows per second has room for 27 columns."""


@dataclass(frozen=True)
class Table:
    """A CSV file as text; only cells of a column that is asked for are looked at."""

    path: Path
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    """Line of the file in which each row ends, counted from 1."""

    def __len__(self) -> int:
        return len(self.rows)

    def text(self, column: str, asked_by: str) -> list[str]:
        """The cells of a column.

        Args:
            column: its name in the header.
            asked_by: the key that names the column, for errors.

        Raises:
            SequenceError: there is no such column.
        """
        return [cell.strip() for cell in self._cells(column, asked_by)]

    def numbers(self, column: str, asked_by: str) -> Float[np.ndarray, " rows"]:
        """The values of a column.

        Raises:
            SequenceError: there is no such column, or a cell is not a finite number.
        """
        try:
            values = np.fromiter(map(float, self._cells(column, asked_by)), np.float64, len(self))
        except ValueError:
            # Some cell is no number; this way, which is slower, says which.
            values = np.fromiter(map(_number, self._cells(column, asked_by)), np.float64, len(self))
        if (wrong := np.flatnonzero(~np.isfinite(values))).size:
            row, cells = wrong[0], self.text(column, asked_by)
            raise SequenceError(
                f"{self.path}, line {self.lines[row]}, column {column!r}: {shown(cells[row])} is not a finite number. "
                "Correct the cell, or leave the whole row out (and, where images are numbered by row, its image)."
            )
        return values

    def _cells(self, column: str, asked_by: str) -> Iterator[str]:
        """The cells of a column as they stand in the file."""
        if column not in self.header:
            raise SequenceError(
                f"{self.path} has no column {column!r}, which {asked_by} names.{closest(column, self.header)} "
                f"Its columns are: {listed(self.header)}."
            )
        return map(itemgetter(self.header.index(column)), self.rows)


def read_table(path: Path, delimiter: str = ",", what: str = "kinematics table") -> Table:
    """Read a CSV file, which errors call `what`; blank lines are skipped.

    Raises:
        SequenceError: missing, empty, not text, columns with the same name, or a row of another length.
    """
    try:
        with io.TextIOWrapper(open_regular(path, TABLE), encoding="utf-8-sig", newline="") as handle:
            reader = csv.reader(handle, delimiter=delimiter, skipinitialspace=True)
            rows, lines = _filled_rows(reader, path, what)
    except (FileNotFoundError, IsADirectoryError) as error:
        raise SequenceError(f"{what} {path} is missing. Correct the path in the sequence file.") from error
    except (OSError, ValueError, csv.Error) as error:
        raise SequenceError(f"{what} {path} is not a readable CSV file: {error}.") from error
    if len(rows) < 2:
        raise SequenceError(f"{what} {path} has no rows. It needs a header and one row per frame.")
    header = tuple(name.strip() for name in rows[0])
    if len(header) == 1 and (found := next((mark for mark in ";\t," if mark in header[0]), None)):
        raise SequenceError(
            f"{path} is not separated by {delimiter!r} but, it seems, by {found!r}. "
            f"Set `delimiter = {found!r}` in [kinematics] (decimal points are points)."
        )
    repeated = sorted(name for name, count in Counter(header).items() if name and count > 1)
    if repeated:
        raise SequenceError(f"{path} has several columns called {listed(map(repr, repeated))}. Rename all but one.")
    if set(map(len, rows)) != {len(header)}:
        line, row = next((line, row) for line, row in zip(lines, rows, strict=True) if len(row) != len(header))
        raise SequenceError(
            f"{path}, line {line} has {len(row)} cells, but the header has {len(header)}. Complete the row."
        )
    return Table(path, header, tuple(rows[1:]), tuple(lines[1:]))


def _filled_rows(reader: Any, path: Path, what: str) -> tuple[list[tuple[str, ...]], list[int]]:
    """Cells, and number of the last line, of every row that is not empty."""
    rows: list[tuple[str, ...]] = []
    lines: list[int] = []
    cells = 0
    for row in reader:
        if any(row):
            rows.append(tuple(row))  # Which Python's collector looks at once, and at a list again and again.
            lines.append(reader.line_num)
            cells += len(row)
            if cells > MOST_CELLS:
                raise SequenceError(f"{what} {path} has more than {MOST_CELLS:,} cells. Divide the recording.")
    return rows, lines


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan
