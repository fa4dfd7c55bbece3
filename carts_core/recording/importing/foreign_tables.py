"""Tables of other programs: CSV, Parquet and NumPy files as named columns of numbers."""

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...decoders import tables
from ...errors import SequenceError
from ...extras import needs_extra
from ...files.decoding import decoded
from ...files.reading import TABLE, read_text

TABLE_SUFFIXES = (".csv", ".txt", ".tsv", ".parquet", ".npy", ".npz")


@dataclass(frozen=True, eq=False)
class ForeignTable:
    """Named columns of equal length; texts that are no numbers are kept as texts."""

    path: Path
    columns: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()))) if self.columns else 0

    def numbers(self, column: str) -> np.ndarray:
        """A column as numbers [rows]; whole numbers stay exact.

        Raises:
            SequenceError: there is no such column, or a cell is no number.
        """
        if column not in self.columns:
            raise SequenceError(f"{self.path} has no column {column!r}. It has: {', '.join(self.columns)}.")
        values = self.columns[column]
        if values.dtype.kind in "iuf":
            return values
        try:
            return values.astype(np.float64)
        except (TypeError, ValueError) as error:
            raise SequenceError(
                f"{self.path}, column {column!r} has cells that are no numbers ({error}). Correct them."
            ) from error


def read_foreign_table(path: Path) -> ForeignTable:
    """A table of any known kind.

    Raises:
        SequenceError: it is missing, damaged, has no rows, or is of another kind.
    """
    readers: dict[str, Callable[[Path], dict[str, np.ndarray]]] = {
        ".parquet": _parquet,
        ".npy": _numpy,
        ".npz": _numpy,
    }
    try:
        columns = readers.get(path.suffix.lower(), _csv)(path)
    except FileNotFoundError as error:
        raise SequenceError(f"table {path} is missing. Correct the path.") from error
    except (OSError, ValueError, csv.Error) as error:
        kinds = ", ".join(TABLE_SUFFIXES)
        raise SequenceError(f"table {path} cannot be read ({error}). Known are {kinds}. Export it again.") from error
    table = ForeignTable(path, columns)
    if not len(table):
        raise SequenceError(f"table {path} has no rows. Export it again.")
    return table


def read_array(path: Path) -> np.ndarray:
    """The array of a .npy file.

    Raises:
        SequenceError: it is missing, damaged, or holds objects.
    """
    try:
        return decoded(tables.read_arrays, path)[""]
    except (OSError, ValueError, KeyError) as error:
        raise SequenceError(f"array {path} cannot be read ({error}). Copy it again.") from error


def _csv(path: Path) -> dict[str, np.ndarray]:
    lines = [line for line in read_text(path, TABLE).splitlines() if line.strip()]
    # Extracted dVRK topics begin with their name and type behind a mark.
    while lines and lines[0].lstrip().startswith("#") and len(lines) > 1 and not lines[1].lstrip()[0:1].isdigit():
        lines = lines[1:]
    if lines and lines[0].startswith("#"):
        lines[0] = lines[0].lstrip("# ")
    if not lines:
        return {}
    delimiter = max(",;\t", key=lines[0].count)
    spaced = not lines[0].count(delimiter)
    tables.check_cells(len(lines) * (lines[0].count(delimiter) + 1))
    rows = [line.split() for line in lines] if spaced else list(csv.reader(lines, delimiter=delimiter))
    width = len(rows[0])
    for number, row in enumerate(rows, start=1):
        if len(row) != width:
            raise ValueError(f"its line {number} has {len(row)} cells, the first has {width}")
    first = [cell.strip() for cell in rows[0]]
    named = not all(_is_number(cell) for cell in first)
    header = first if named else [f"column_{index}" for index in range(1, width + 1)]
    if len(set(header)) < len(header):
        raise ValueError("two of its columns have the same name")
    body = rows[1:] if named else rows
    return {name: _typed([row[index].strip() for row in body]) for index, name in enumerate(header)}


def _typed(cells: list[str]) -> np.ndarray:
    for kind in (np.int64, np.float64):
        try:
            return np.array(cells, dtype=str).astype(kind) if cells else np.empty(0, kind)
        except (ValueError, OverflowError):
            continue
    return np.array(cells)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def read_parquet(path: Path) -> dict[str, np.ndarray]:
    """Columns of a Parquet file by name [rows]; [rows, values] where each row holds as many numbers.

    Raises:
        CartsError: the package that reads it is not installed.
        OSError, ValueError: it cannot be read, or is too large.
    """
    needs_extra("pyarrow", "import")
    columns = decoded(tables.read_parquet, path)
    for name, values in columns.items():
        if isinstance(values, list):
            columns[name] = np.empty(len(values), object)
            columns[name][:] = values
    return columns


def _parquet(path: Path) -> dict[str, np.ndarray]:
    columns: dict[str, np.ndarray] = {}
    for name, values in read_parquet(path).items():
        if values.ndim == 2:
            columns.update({f"{name}.{index}": values[:, index] for index in range(values.shape[1])})
        elif not len(values) or not isinstance(values[0], list):
            columns[name] = values
    return columns


def _numpy(path: Path) -> dict[str, np.ndarray]:
    arrays = decoded(tables.read_arrays, path)
    columns: dict[str, np.ndarray] = {}
    for name, values in ((name or "column", values) for name, values in arrays.items()):
        if values.ndim == 1:
            columns[name] = values
        elif values.ndim >= 2:
            # Position, velocity and effort of a joint state lie one after the other; positions come first.
            flat = values[:, 0] if values.ndim == 3 else values
            columns.update({f"{name}_{index + 1}": flat[:, index] for index in range(flat.shape[1])})
    return columns
