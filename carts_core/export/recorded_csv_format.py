"""Copies of the recording's CSV tables with corrected columns beside the recorded ones, and masks.

In a table with a row per image, each row gets the positions of its frame. In a table with times, such as a dVRK log
with more rows than images, the corrections of consecutive frames are interpolated linearly.
"""

import csv
import io
from collections.abc import Mapping
from collections.abc import Sequence as Items
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from ..errors import SequenceError
from ..files import OutputPath, write_bytes, write_text
from ..files.reading import TABLE, read_text
from ..recording import Sequence
from ..recording.importing.columns import ColumnMeanings
from ..recording.importing.foreign_tables import DECIMAL_COMMAS, ForeignTable, delimiter_of, read_foreign_table
from ..recording.importing.found import Import
from ..recording.importing.row_matching import row_seconds
from ..recording.matching import at_times
from ..recording.sources.folder import tables_of
from ..settings.interchange import ImportOptions
from .dataset import Dataset, ExportFrame, ExportProgress
from .encodings import mask_png
from .recording_copy import below
from .source_tables import ColumnMaps, column_maps, column_meanings, frame_positions, source_of

_SUFFIXES = (".csv", ".tsv", ".txt")
_SAME_CLOCK = 1e-5
"""Maximum variation of the difference between the times of a table and those of the sequence [s]."""


@dataclass(frozen=True, eq=False)
class _RowResults:
    """Results in the rows of a table that belong to the sequence."""

    positions: Float[ndarray, "rows dofs"]
    """Joint positions [rad, m]."""
    changed: Bool[ndarray, " rows"]
    """Rows whose positions replace the recorded values."""
    std: Float[ndarray, "rows dofs"]
    """Standard deviations [rad, m]; NaN in rows without results."""
    frames: Int[ndarray, " rows"]
    """Index in the exported frames of the frame nearest in time; -1 in rows without results."""


def write_recorded_csv(dataset: Dataset, folder: OutputPath, progress: ExportProgress) -> None:
    """Write the tables of the recording that the sequence was imported from, with further columns, and masks.

    Raises:
        SequenceError: the recording is unknown or missing, or none of its CSV tables has the rows of the sequence.
    """
    path = source_of(dataset.recording, dataset.sequence)
    root = path if path.is_dir() else path.parent
    files = [file for file in (tables_of(path) if path.is_dir() else [path]) if file.suffix.lower() in _SUFFIXES]
    sequence = Sequence.open(dataset.sequence.path)
    found: dict[Path, str] = {}
    for file in files:
        try:
            table = read_foreign_table(file)
            columns = _new_columns(table, dataset, sequence)
        except SequenceError:
            continue  # A table with other content, which the import does not use either.
        if columns:
            found[file] = _extended(table, columns)
    if not found:
        names = ", ".join(file.name for file in files[:10])
        raise SequenceError(
            f"no CSV table of {path} has the joint positions or tip poses of {sequence.path} (tables: "
            f"{names or 'none'}). Give the table from which the sequence was imported: --recording FILE.csv."
        )
    for view in dataset.views(progress):
        png = mask_png(dataset.recorded_mask(view))
        write_bytes(folder / "carts_mask" / view.camera.name / f"{view.frame.frame_id}.png", png)
    for file, text in found.items():
        write_text(below(folder, root, file), text)


def _new_columns(table: ForeignTable, dataset: Dataset, sequence: Sequence) -> dict[str, list[str]]:
    """New columns of a table as text; empty if none of its rows are those of an arm of the sequence."""
    meanings = column_meanings(table, sequence)

    def rows_of(arm: str, names: Items[str]) -> tuple[Int[ndarray, " logged"], Float[ndarray, "logged dofs"]] | None:
        times, values = sequence.logged_rows(arm)
        rows = _rows(table, meanings, names, times, len(values), sequence)
        return None if rows is None else (rows, values)

    columns: dict[str, list[str]] = {}
    for arm, maps in column_maps(table, meanings, sequence, rows_of).items():
        times, values = sequence.logged_rows(arm)
        if times is None or _is_row_per_frame(times + sequence.arm_time_offsets[arm], sequence.timestamps):
            results = _by_row(dataset, arm)
        else:
            results = _by_time(dataset, arm, times, values)
        columns |= _texts(table, maps, results, dataset.frames)
    return columns


def _rows(
    table: ForeignTable,
    meanings: ColumnMeanings,
    names: Items[str],
    times: Float[ndarray, " logged"] | None,
    count: int,
    sequence: Sequence,
) -> Int[ndarray, " logged"] | None:
    """Row of the table for each logged row of the sequence, among rows with values in the named columns; None if they
    do not correspond."""
    numbers = np.stack([table.numbers(name).astype(np.float64) for name in names], 1)
    used = np.asarray(np.isfinite(numbers).all(1))
    if times is not None and meanings.time is not None:
        seconds = row_seconds(table, meanings.time, None, Import(ImportOptions()))
        assert seconds is not None
        own = np.flatnonzero(used & np.concatenate([[True], np.diff(seconds) > 0]))
        if len(own) == count and np.ptp(seconds[own] - times) <= _SAME_CLOCK:
            return own
    own = np.flatnonzero(used)
    if len(own) == count:
        return own
    if meanings.frame is not None and count == len(sequence):
        cells = [Path(str(cell)).stem for cell in table.columns[meanings.frame].tolist()]
        place = {cell: row for row, cell in reversed([*enumerate(cells)]) if used[row]}
        place |= {str(int(cell)): row for cell, row in [*place.items()] if cell.isdecimal()}
        keys = [
            frame if frame in place else str(int(frame)) if frame.isdecimal() else "" for frame in sequence.frame_ids
        ]
        if all(key in place for key in keys):
            return np.array([place[key] for key in keys])
    return None


def _is_row_per_frame(times: Float[ndarray, " rows"], timestamps: Float[ndarray, " frames"] | None) -> bool:
    """Whether rows have the times of the frames, as an import assigns them to a table with a row per image."""
    return timestamps is not None and len(times) == len(timestamps) and np.abs(times - timestamps).max() <= _SAME_CLOCK


def _by_row(dataset: Dataset, arm: str) -> _RowResults:
    """Results of a table with a row per frame."""
    positions, changed = frame_positions(dataset)
    std, frames = np.full(positions[arm].shape, np.nan), np.full(len(changed), -1)
    for number, frame in enumerate(dataset.frames):
        if frame.source != "measured":
            std[frame.index] = (frame.joint_std or {}).get(arm, np.nan)
            frames[frame.index] = number
    return _RowResults(positions[arm], changed, std, frames)


def _by_time(
    dataset: Dataset, arm: str, times: Float[ndarray, " rows"], values: Float[ndarray, "rows dofs"]
) -> _RowResults:
    """Results of a table with times: corrections are interpolated between consecutive corrected frames."""
    sequence, frames = dataset.sequence, dataset.frames
    timestamps = sequence.timestamps
    assert timestamps is not None
    own = [number for number, frame in enumerate(frames) if frame.source != "measured"]
    positions, std, nearest = values.copy(), np.full(values.shape, np.nan), np.full(len(values), -1)
    if not own:
        return _RowResults(positions, nearest >= 0, std, nearest)
    at = np.array([timestamps[frames[number].index] for number in own]) + sequence.checked_matching().time_offset
    # A frame shortly before the first row, or after the last one, has the values of that row.
    at = np.clip(at, times[0], times[-1])
    robot = sequence.scene.arm(arm).robot
    measured = at_times(at, times, np.where(robot.unlimited, np.unwrap(values, axis=0), values))
    corrections = robot.difference(np.stack([frames[number].joint_positions[arm] for number in own]), measured)
    deviations = np.stack([(frames[n].joint_std or {}).get(arm, np.full(values.shape[1], np.nan)) for n in own])
    indices = np.array([frames[number].index for number in own])
    after = np.clip(np.searchsorted(at, times - _SAME_CLOCK), 0, len(at) - 1)
    before = np.where((at[after] > times + _SAME_CLOCK) & (after > 0), after - 1, after)
    inside = (times >= at[0] - _SAME_CLOCK) & (times <= at[-1] + _SAME_CLOCK) & (indices[after] - indices[before] <= 1)
    span = np.maximum(at[after] - at[before], _SAME_CLOCK)
    share = np.clip(np.where(after == before, 0.0, (times - at[before]) / span), 0.0, 1.0)[:, None]
    interpolated = (1.0 - share) * corrections[before] + share * corrections[after]
    chosen = np.where(share[:, 0] <= 0.5, before, after)
    positions[inside] += interpolated[inside]
    std[inside] = deviations[chosen[inside]]
    nearest[inside] = np.array(own)[chosen[inside]]
    return _RowResults(positions, inside, std, nearest)


def _texts(
    table: ForeignTable, maps: ColumnMaps, results: _RowResults, frames: tuple[ExportFrame, ...]
) -> dict[str, list[str]]:
    """New columns as text; rows without results keep their recorded values."""
    columns: dict[str, Float[ndarray, " logged"]] = {}
    std = {joint.column: abs(joint.scale) * results.std[:, joint.index] for joint in maps.joints}
    for name, values in maps.columns(results.positions, table).items():
        columns[f"{name}.corrected"] = values
        columns |= {f"{name}.std": std[name]} if name in std else {}
    decimal, rows = "," if DECIMAL_COMMAS in table.remarks else ".", maps.rows.tolist()
    found = {}
    for name, values in columns.items():
        texts = [repr(float(value)) for value in _recorded(table, name.removesuffix(".corrected"))]
        for row, value, changed in zip(rows, values.tolist(), results.changed.tolist(), strict=True):
            texts[row] = repr(value) if changed else texts[row]
        found[name] = [text.replace(".", decimal) for text in texts]
    marks, verdicts = ["0"] * len(table), [""] * len(table)
    for row, number in zip(rows, results.frames.tolist(), strict=True):
        if number >= 0:
            marks[row], verdicts[row] = "1", frames[number].verdict or ""
    return {**found, f"{maps.arm}.corrected": marks, f"{maps.arm}.verdict": verdicts}


def _recorded(table: ForeignTable, column: str) -> Float[ndarray, " rows"]:
    """Recorded values of a column; NaN for a column of standard deviations."""
    return table.numbers(column).astype(np.float64) if column in table.columns else np.full(len(table), np.nan)


def _extended(table: ForeignTable, columns: Mapping[str, list[str]]) -> str:
    """Text of a table with further columns at the ends of its lines; other lines are unchanged.

    Raises:
        SequenceError: the table has no header, or already has one of the columns.
    """
    lines = read_text(table.path, TABLE).splitlines()
    filled = [number for number, line in enumerate(lines, start=1) if line.strip()]
    above = [number for number in filled if number < table.lines[0]]
    header = above[-2 if table.units else -1] if len(above) > bool(table.units) else 0
    delimiter = delimiter_of([lines[number - 1] for number in filled if number >= header][:50])
    names = _cells(lines[header - 1].lstrip("# "), delimiter) if header else []
    if names[: len(table.columns)] != list(table.columns) or set(names) & set(columns):
        raise SequenceError(f"table {table.path} has no header, or is an export itself. Give the recorded table.")
    lines[header - 1] = _longer(lines[header - 1], [*columns], delimiter, len(table.columns))
    if table.units:
        empty = [""] * len(columns)
        lines[above[-1] - 1] = _longer(lines[above[-1] - 1], empty, delimiter, len(table.columns))
    for number, cells in zip(table.lines, zip(*columns.values(), strict=True), strict=True):
        lines[number - 1] = _longer(lines[number - 1], list(cells), delimiter, len(table.columns))
    return "\n".join(lines) + "\n"


def _cells(line: str, delimiter: str | None) -> list[str]:
    cells = line.split() if delimiter is None else next(csv.reader([line], delimiter=delimiter), [])
    return [cell.strip() for cell in cells]


def _longer(line: str, cells: list[str], delimiter: str | None, count: int) -> str:
    """Line with further cells; a delimiter at its end is not repeated, and empty cells between blanks are `-`."""
    text = io.StringIO()
    cells = [cell or "-" for cell in cells] if delimiter is None else cells
    csv.writer(text, delimiter=delimiter or " ", lineterminator="").writerow(cells)
    joint = "" if delimiter is not None and len(_cells(line, delimiter)) > count else delimiter or " "
    return f"{line}{joint}{text.getvalue()}"
