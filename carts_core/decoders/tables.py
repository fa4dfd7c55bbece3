"""Tables and arrays from Parquet, NumPy and MATLAB files."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SequenceError
from ..files.reading import CALIBRATION, TABLE, read_bytes

MAX_CELLS, MAX_ROWS, MAX_COLUMNS = 10_000_000, 1_500_000, 10_000
"""Maximum number of values, rows and columns of a table."""
_MAX_VALUES = 50_000_000
"""Maximum number of values of a Parquet file; LeRobot v3.0 stores a million rows of 30 values in a file of 100 MB."""
LIBRARIES = {
    "read_parquet": ("pyarrow.parquet",),
    "extended_parquet": ("pyarrow.parquet",),
    "read_matlab": ("scipy.io",),
}
"""Function -> modules to import before the memory limit applies."""


def read_parquet(path: Path) -> dict[str, Any]:
    """Columns of a Parquet file by name: [rows], or [rows, values] for lists of numbers of equal length.

    Columns of strings, and of lists of different lengths, are Python lists. Fields of a struct are columns
    `struct.field`.

    Raises:
        OSError, ValueError: the file cannot be read.
        SequenceError: it has too many values, rows or columns.
    """
    import pyarrow  # noqa: PLC0415 - an extra
    import pyarrow.parquet  # noqa: PLC0415

    try:
        file = pyarrow.parquet.ParquetFile(io.BytesIO(read_bytes(path, TABLE)))
        groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
        # Runs of equal values take few bytes, so the file size does not limit the number of values.
        cells = sum(group.column(number).num_values for group in groups for number in range(group.num_columns))
        check_size(path, file.metadata.num_rows, file.metadata.num_columns, cells, _MAX_VALUES)
        table = file.read()
        while any(pyarrow.types.is_struct(column.type) for column in table.itercolumns()):
            table = table.flatten()
    except pyarrow.ArrowException as error:
        raise ValueError(str(error)) from error
    values = {}
    for name in table.column_names:
        column = table.column(name)
        kind = column.type
        nested = pyarrow.types.is_list(kind) or pyarrow.types.is_fixed_size_list(kind)
        values[name] = _matrix(column) if nested else column.to_numpy()
    return values


def extended_parquet(path: Path, columns: dict[str, list[Any]]) -> bytes:
    """Content of a Parquet file with further columns; other columns, row groups and metadata are kept.

    Args:
        path: the file.
        columns: name -> `["numbers", values]` with an array [rows] or [rows, values], or `["texts", texts, index]` or
            `["images", files, index]` with the distinct values and the index of each row's value [rows]. An image is a
            struct of `bytes` and `path`, as in the package `datasets`. Existing columns of the same names are replaced.

    Raises:
        OSError, ValueError: the file cannot be read, or has another number of rows.
        SequenceError: it has too many rows.
    """
    import pyarrow  # noqa: PLC0415 - an extra
    import pyarrow.parquet  # noqa: PLC0415

    try:
        file = pyarrow.parquet.ParquetFile(io.BytesIO(read_bytes(path, TABLE)))
        lengths = [file.metadata.row_group(number).num_rows for number in range(file.metadata.num_row_groups)]
        check_size(path, file.metadata.num_rows)
        table = file.read()
        described = json.loads((table.schema.metadata or {}).get(b"huggingface", b"{}"))
        features = described.get("info", {}).get("features", {})
        for name, (kind, values, *index) in columns.items():
            array = _arrow(kind, values, *index)
            place = table.schema.get_field_index(name)
            table = table.append_column(name, array) if place < 0 else table.set_column(place, name, array)
            if features:
                sequence = "List" if '"List"' in json.dumps(features) else "Sequence"
                features[name] = _feature(kind, values, sequence)
        if features:
            metadata = {**table.schema.metadata, b"huggingface": json.dumps(described).encode()}
            table = table.replace_schema_metadata(metadata)
        content = io.BytesIO()
        with pyarrow.parquet.ParquetWriter(content, table.schema) as writer:
            for start, length in zip(np.cumsum([0, *lengths]), lengths, strict=False):
                writer.write_table(table.slice(int(start), length), row_group_size=max(length, 1))
    except (pyarrow.ArrowException, AttributeError, TypeError, KeyError) as error:
        raise ValueError(str(error)) from error
    return content.getvalue()


def text_column(texts: np.ndarray) -> list[Any]:
    """Column of `extended_parquet` with texts [rows]."""
    distinct, index = np.unique(texts, return_inverse=True)
    return ["texts", distinct.tolist(), index.astype(np.int64)]


def _arrow(kind: str, values: Any, index: np.ndarray | None = None) -> Any:
    """Arrow array of a column of `extended_parquet`."""
    import pyarrow  # noqa: PLC0415 - an extra

    if kind == "numbers":
        flat = pyarrow.array(np.ascontiguousarray(values).reshape(-1))
        return flat if values.ndim == 1 else pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1])
    found = pyarrow.array(values, pyarrow.string() if kind == "texts" else pyarrow.binary()).take(pyarrow.array(index))
    if kind == "texts":
        return found
    paths = pyarrow.nulls(len(found), pyarrow.string())
    return pyarrow.StructArray.from_arrays([found, paths], ["bytes", "path"])


def _feature(kind: str, values: Any, sequence: str) -> dict[str, Any]:
    """Description of a column of `extended_parquet` in the metadata of the package `datasets`."""
    if kind != "numbers":
        return {"dtype": "string", "_type": "Value"} if kind == "texts" else {"_type": "Image"}
    value = {"dtype": str(values.dtype), "_type": "Value"}
    return value if values.ndim == 1 else {"feature": value, "length": int(values.shape[1]), "_type": sequence}


def _matrix(column: Any) -> Any:
    """Convert an Arrow column of lists of numbers to an array, with NaN for missing rows; returns Python lists if rows
    are not numeric or differ in length."""
    from pyarrow import compute, types  # noqa: PLC0415 - an extra

    lengths = compute.call_function("list_value_length", [column]).drop_null().unique().to_pylist()
    kind = column.type.value_type
    if len(lengths) != 1 or not (types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind)):
        return column.to_pylist()
    found, there = np.full((len(column), lengths[0]), np.nan), column.is_valid().to_numpy()
    found[there] = compute.call_function("list_flatten", [column]).to_numpy().reshape(there.sum(), lengths[0])
    return found


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Arrays of a .npz file by name, or the array of a .npy file under an empty name.

    Raises:
        OSError, ValueError: the file cannot be read, or contains Python objects.
    """
    content = io.BytesIO(read_bytes(path, TABLE))
    loaded = np.load(content, allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        return {"": loaded}
    with loaded:
        return {name: loaded[name] for name in loaded.files}


def read_matlab(path: Path) -> dict[str, Any]:
    """Variables of a MATLAB file (version 5) by name; structs are dictionaries.

    Raises:
        OSError: the file is missing, not a regular file, or too large for a calibration.
        ValueError: the file is damaged or of another version.
    """
    from scipy.io import loadmat  # noqa: PLC0415

    content = read_bytes(path, CALIBRATION)
    if content.startswith(b"MATLAB 7.3"):
        raise ValueError("it is a MATLAB 7.3 file; save it with save(FILE, NAME, '-v7')")
    try:
        variables = loadmat(io.BytesIO(content), simplify_cells=True)
    except MemoryError:
        raise
    except Exception as error:  # scipy's readers raise many types of exceptions
        raise ValueError(f"it is not a MATLAB 5 file ({error})") from error
    names = [_name_of_object(name, value) for name, value in variables.items()]
    if name := next(filter(None, names), ""):
        raise ValueError(
            f"{name} is a MATLAB object; convert it to a struct before saving: s = toStruct({name}); save(FILE, 's')"
        )
    return {name: value for name, value in variables.items() if not name.startswith("__")}


def _name_of_object(name: str, value: Any) -> str:
    """Name of a variable that is a MATLAB object (MCOS), whose content cannot be read; empty for other variables."""
    if getattr(value, "dtype", None) is not None and value.dtype.names and "s0" in value.dtype.names:
        found = value["s0"].reshape(-1)[0]
        return found.decode("ascii", "replace") if isinstance(found, bytes) else str(found)
    return "stereoParams" if name in ("None", "__function_workspace__") else ""


def check_size(
    path: Path, rows: int, columns: int = 1, values: int | None = None, most_values: int = MAX_CELLS
) -> None:
    """Check the number of rows, columns and values of a table; by default, each column has one value per row.

    Raises:
        SequenceError: there are too many rows, columns or values.
    """
    values = rows * columns if values is None else values
    limits = (values, most_values, "values"), (rows, MAX_ROWS, "rows"), (columns, MAX_COLUMNS, "columns")
    for count, most, what in limits:
        if count > most:
            raise SequenceError(
                f"table {path} has {count:,} {what}; at most {most:,} are read. Split it into several files, or remove "
                "rows or columns that are not needed."
            )
