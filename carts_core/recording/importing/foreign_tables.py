"""Tables of other programs (CSV, Parquet, NumPy), read as named columns of numbers."""

import csv
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from ...decoders import tables
from ...files.decoding import decoded
from ...files.reading import TABLE, read_text
from ...package_imports import require_package
from ...wording import shown
from .found import PartError, well_formed

_MAX_UNIT_LENGTH = 12
"""Maximum length of a unit [characters]."""
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d([.,]\d+)?(Z|[+-]\d\d:?\d\d)?")
_MAX_NUMBER_LENGTH = 100
"""Maximum length of a numeric cell [characters]; string arrays allocate the maximum length for each cell."""
DECIMAL_COMMAS = "decimal commas are read as decimal points"
"""Remark on a table with decimal commas."""
TABLE_SUFFIXES = (".csv", ".txt", ".tsv", ".parquet", ".npy", ".npz")


@dataclass(frozen=True, eq=False)
class ForeignTable:
    """Named columns of equal length; columns with non-numeric cells remain text."""

    path: Path
    columns: dict[str, np.ndarray]
    units: Mapping[str, str] = field(default_factory=dict)
    """Column -> unit, from a row of units."""
    dates: tuple[str, ...] = ()
    """Columns of dates, converted to nanoseconds since 1970."""
    remarks: tuple[str, ...] = ()
    """Remarks on unusual content and its interpretation."""
    lines: tuple[int, ...] = ()
    """Line of each row in the file, from 1; empty for binary files."""

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()))) if self.columns else 0

    def numbers(self, column: str) -> np.ndarray:
        """Column as numbers [rows]; integers stay exact."""
        if column not in self.columns:
            raise PartError("columns", f"{self.path} has no column {column!r}. It has: {', '.join(self.columns)}.")
        values = self.columns[column]
        if values.dtype.kind in "iuf":
            return values
        try:
            return values.astype(np.float64)
        except (TypeError, ValueError) as error:
            wrong = [row for row, cell in enumerate(values) if not _is_number(str(cell))]
            row = wrong[0] if wrong else 0
            where = f"line {self.lines[row]}" if self.lines else f"row {row + 1}"
            raise PartError(
                "columns",
                f"{self.path}, column {column!r} has cells that are not numbers: {len(wrong)} of {len(values)}, the "
                f"first in {where}: {shown(str(values[row]))}. Correct them, or choose another column.",
                "Use --columns.",
            ) from error


def read_foreign_table(path: Path) -> ForeignTable:
    """Read a table of any supported format."""
    readers: dict[str, Callable[[Path], ForeignTable | dict[str, np.ndarray]]] = {
        ".parquet": _parquet,
        ".npy": _numpy,
        ".npz": _numpy,
    }
    try:
        columns = readers.get(path.suffix.lower(), _csv)(path)
    except FileNotFoundError as error:
        raise PartError("kinematics", f"table {path} is missing. Correct the path.") from error
    except (OSError, ValueError, csv.Error) as error:
        kinds = ", ".join(TABLE_SUFFIXES)
        raise PartError(
            "kinematics", f"table {path} cannot be read ({error}). Supported formats: {kinds}. Export it again."
        ) from error
    table = columns if isinstance(columns, ForeignTable) else ForeignTable(path, columns)
    if not len(table):
        raise PartError("kinematics", f"table {path} has no rows. Export it again.")
    return table


def read_array(path: Path) -> np.ndarray:
    """The array of a .npy file."""
    with well_formed(f"array {path} cannot be read"):
        return decoded(tables.read_arrays, path)[""]


def _csv(path: Path) -> ForeignTable:
    text = read_text(path, TABLE).removeprefix("\ufeff")
    lines = text.splitlines()
    numbers = [number for number, line in enumerate(lines, start=1) if line.strip()]
    lines = [lines[number - 1] for number in numbers]
    # Extracted dVRK topics begin with a marker, their name and their type.
    begin = 0
    while begin + 1 < len(lines) and re.match(r"\s*#", lines[begin]) and not re.match(r"\s*\d", lines[begin + 1]):
        begin += 1
    numbers, lines = numbers[begin:], lines[begin:]
    if not lines:
        return ForeignTable(path, {})
    if lines[0].startswith("#"):
        lines[0] = lines[0].lstrip("# ")
    delimiter = delimiter_of(lines[:50])
    tables.check_size(path, len(lines), lines[0].count(delimiter or " ") + 1)
    cells = map(str.split, lines) if delimiter is None else csv.reader(lines, delimiter=delimiter)
    rows, remarks = _even([[cell.strip() for cell in row] for row in cells], numbers)
    first, width = rows[0], len(rows[0])
    commas = delimiter != ","
    named = not all(_is_number(cell, commas) for cell in first)
    header = first if named else [f"column_{index}" for index in range(1, width + 1)]
    if len(set(header)) < len(header):
        raise ValueError("two of its columns have the same name")
    body, numbers = (rows[1:], numbers[1:]) if named else (rows, numbers)
    units: dict[str, str] = {}
    if named and len(body) > 1 and _is_row_of_units(body[0], body[1], commas):
        units = {name: unit for name, unit in zip(header, body[0], strict=True) if unit}
        remarks.append(f"line {numbers[0]} has units: {', '.join(f'{name} {unit}' for name, unit in units.items())}")
        body, numbers = body[1:], numbers[1:]
    columns = {name: _typed([row[index] for row in body], commas) for index, name in enumerate(header)}
    if any("," in cell for row in body[:5] for cell in row) and commas:
        remarks.append(DECIMAL_COMMAS)
    dates = tuple(
        name for index, name in enumerate(header) if body and all(_DATE.fullmatch(row[index]) for row in body)
    )
    if empty := sum(not cell for row in body for cell in row):
        remarks.append(f"{empty} empty cells; rows with a missing joint value are skipped")
    return ForeignTable(path, columns, units, dates, tuple(remarks), tuple(numbers))


def delimiter_of(lines: list[str]) -> str | None:
    """Separator of cells; None for blanks. Semicolons and tabs take precedence over commas, which may be decimal
    commas."""
    for mark in ";\t":
        if all(mark in line for line in lines):
            return mark
    return "," if "," in lines[0] else None


def _even(rows: list[list[str]], numbers: list[int]) -> tuple[list[list[str]], list[str]]:
    """Remove a trailing empty cell from rows and return them with remarks; `ValueError` if their lengths differ."""
    width, remarks = len(rows[0]), []
    if width > 1 and not rows[0][-1] and all(len(row) == width and not row[-1] for row in rows):
        rows, width = [row[:-1] for row in rows], width - 1
    elif any(len(row) == width + 1 and not row[-1] for row in rows):
        rows = [row[:-1] if len(row) == width + 1 and not row[-1] else row for row in rows]
        remarks.append("an empty cell at the end of its rows is ignored")
    for number, row in zip(numbers, rows, strict=True):
        if len(row) != width:
            raise ValueError(f"line {number} has {len(row)} cells, but the first line has {width}")
    return rows, remarks


def _is_row_of_units(row: list[str], after: list[str], commas: bool) -> bool:
    """Whether a row below the header contains units: words above numbers."""
    numeric = [index for index, cell in enumerate(after) if cell and _is_number(cell, commas)]
    return (
        len(numeric) >= 0.5 * len(after)
        and all(not _is_number(row[index], commas) for index in numeric if row[index])
        and all(len(cell) <= _MAX_UNIT_LENGTH for cell in row)
        and any(row[index] for index in numeric)
    )


def _typed(cells: list[str], commas: bool = False) -> np.ndarray:
    if not cells:
        return np.empty(0)
    if max(map(len, cells)) > _MAX_NUMBER_LENGTH:
        return np.array(cells, object)
    for kind in (np.int64, np.float64):
        try:
            return np.array(cells, dtype=str).astype(kind)
        except (ValueError, OverflowError):
            continue
    if all(_DATE.fullmatch(cell) for cell in cells):
        return _nanoseconds(cells)
    filled = [cell or "nan" for cell in cells]
    if any(cells) and all(_is_number(cell, commas) for cell in filled):
        return np.array([float(cell.replace(",", ".") if commas else cell) for cell in filled])
    return np.array(cells)


def _nanoseconds(cells: list[str]) -> np.ndarray:
    """Convert dates to nanoseconds since 1970; dates without a time zone are in UTC."""
    times = []
    for cell in cells:
        whole, _, rest = cell.replace("Z", "+00:00").replace(",", ".").partition(".")
        fraction = re.match(r"\d*", rest)
        digits, zone = (fraction[0], rest[fraction.end() :]) if fraction else ("", "")
        moment = datetime.fromisoformat(whole + zone)
        moment = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
        times.append(round(moment.timestamp()) * 10**9 + int((digits + "0" * 9)[:9]))
    return np.array(times, np.int64)


def _is_number(cell: str, commas: bool = False) -> bool:
    try:
        float(cell.replace(",", ".", 1) if commas else cell)
    except ValueError:
        return False
    return True


def read_parquet(path: Path) -> dict[str, np.ndarray]:
    """Columns of a Parquet file by name: [rows], or [rows, values] if all rows have the same number of values."""
    require_package("pyarrow", "import")
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
            # Position, velocity and effort of a joint state are stacked along the second axis, positions first.
            flat = values[:, 0] if values.ndim == 3 else values
            columns.update({f"{name}_{index + 1}": flat[:, index] for index in range(flat.shape[1])})
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        known = ", ".join(f"{name} {count}" for name, count in list(lengths.items())[:8])
        raise ValueError(f"its arrays have different numbers of rows ({known}); store them in separate files")
    return columns
