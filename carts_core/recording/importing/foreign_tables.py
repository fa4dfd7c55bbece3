"""Tables of other programs: CSV, Parquet and NumPy files as named columns of numbers."""

import csv
import io
import math
import tokenize
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SequenceError
from ...extras import needs_extra
from ...files.reading import MIB, TABLE, read_bytes, read_text

_MOST_CELLS = 10_000_000
"""Most values of a table."""
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
    except (OSError, ValueError, csv.Error, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
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
        return _array(read_bytes(path, TABLE))
    except (OSError, ValueError, EOFError) as error:
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
    _check_cells(len(lines) * (lines[0].count(delimiter) + 1))
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


def read_parquet(path: Path) -> Any:
    """The table in a Parquet file, as pyarrow has it.

    Raises:
        OSError, ValueError: it cannot be read, or is too large.
    """
    needs_extra("pyarrow", "import")
    import pyarrow  # noqa: PLC0415
    import pyarrow.parquet  # noqa: PLC0415

    try:
        file = pyarrow.parquet.ParquetFile(io.BytesIO(read_bytes(path, TABLE)))
        groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
        chunks = [group.column(number) for group in groups for number in range(group.num_columns)]
        # A run of equal values takes some bytes, however long it is.
        _check_cells(sum(chunk.num_values for chunk in chunks))
        _check_bytes(sum(chunk.total_uncompressed_size for chunk in chunks))
        return file.read()
    except pyarrow.ArrowException as error:
        raise ValueError(str(error)) from error


def _parquet(path: Path) -> dict[str, np.ndarray]:
    table = read_parquet(path)
    import pyarrow  # noqa: PLC0415

    columns: dict[str, np.ndarray] = {}
    for name in table.column_names:
        column = table.column(name)
        if pyarrow.types.is_list(column.type) or pyarrow.types.is_fixed_size_list(column.type):
            rows = column.to_pylist()
            lengths = {len(row) for row in rows if row is not None}
            if len(lengths) == 1 and (length := lengths.pop()):
                values = np.array([[np.nan] * length if row is None else row for row in rows])
                columns.update({f"{name}.{index}": values[:, index] for index in range(values.shape[1])})
        else:
            columns[name] = column.to_numpy()
    return columns


def _array(content: bytes) -> np.ndarray:
    """The array in the content of a .npy file, which must be as long as its header says, before any of it is made."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    try:
        shape, _, kind = header(stream)
    except (SyntaxError, tokenize.TokenError) as error:  # NumPy reads headers as Python's literals.
        raise ValueError(f"its header is damaged ({error})") from error
    if kind.itemsize * math.prod(shape) > len(content):
        raise ValueError(f"its header says {shape}, and it has {len(content)} bytes")
    stream.seek(0)
    return np.load(stream)


def _arrays(content: bytes) -> dict[str, np.ndarray]:
    if not zipfile.is_zipfile(io.BytesIO(content)):
        return {"column": _array(content)}
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
        _check_bytes(sum(member.file_size for member in members))
        return {member.filename.removesuffix(".npy"): _array(archive.read(member)) for member in members}


def _check_cells(count: int) -> None:
    if count > _MOST_CELLS:
        raise ValueError(f"it has {count:,} values; at most {_MOST_CELLS:,} are read")


def _check_bytes(count: int) -> None:
    if count > TABLE.limit:
        raise ValueError(f"it expands to {count // MIB} MiB; a {TABLE.name} may have {TABLE.limit // MIB} MiB at most")


def _numpy(path: Path) -> dict[str, np.ndarray]:
    arrays = _arrays(read_bytes(path, TABLE))
    columns: dict[str, np.ndarray] = {}
    for name, values in arrays.items():
        if values.ndim == 1:
            columns[name] = values
        elif values.ndim >= 2:
            # Position, velocity and effort of a joint state lie one after the other; positions come first.
            flat = values[:, 0] if values.ndim == 3 else values
            columns.update({f"{name}_{index + 1}": flat[:, index] for index in range(flat.shape[1])})
    return columns
