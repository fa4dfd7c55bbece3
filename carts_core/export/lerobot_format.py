"""Copy of a LeRobot data set (v2.1 and v3.0) with the results of one episode as further features.

The tables in `data/` are copied with the new columns, `meta/info.json` and the statistics describe them, and videos are
linked or copied. Rows without results (of other episodes, or left out by the import) are marked. If the data set is
itself such a copy, results of other episodes are kept, so that episodes can be exported one after another.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from ..decoders import tables
from ..errors import SequenceError
from ..files import OutputPath, write_bytes, write_text
from ..files.decoding import Limits, called
from ..files.reading import VALUES, is_regular, parse_json, read_text
from ..package_imports import require_package
from ..recording.images import decode_image
from ..recording.importing.foreign_tables import ForeignTable, read_parquet
from ..recording.importing.found import Import, well_formed
from ..recording.sources.lerobot import (
    STATE,
    Episode,
    data_set_root,
    episode_times,
    parquet_files,
    read_episode,
    read_info,
    state_table,
)
from ..recording.video import Video
from ..settings.interchange import ImportOptions
from .dataset import Dataset, ExportProgress
from .encodings import image_png
from .kinematics import joint_columns, position_values, std_values
from .recording_copy import below, copy_files
from .source_tables import (
    ColumnMaps,
    as_imported,
    column_maps,
    column_meanings,
    frame_positions,
    rows_of_frames,
    source_of,
)

CORRECTED_STATE = "observation.state_corrected"
POSITIONS, STD = "carts.joint_positions", "carts.joint_std"
CORRECTED, SOURCE, VERDICT = "carts.corrected", "carts.source", "carts.verdict"
DESCRIPTION = "meta/carts.json"
_STATISTICS, _EPISODE_STATISTICS = "meta/stats.json", "meta/episodes_stats.jsonl"
_WHITE = 127
"""Value above which a pixel of a mask is in the arms."""
_MEMORY_PER_BYTE = 6
"""Memory of the decoder per byte of the new columns."""


@dataclass(eq=False)
class _Masks:
    """Masks of one camera, as a feature of images."""

    key: str
    """Name of the feature."""
    size: tuple[int, int]
    """Height and width [px]."""
    files: list[bytes]
    """PNG files; the first is an empty mask, for rows without results."""
    shares: list[float]
    """Share of the pixels in the mask, for each of `files`."""
    rows: dict[int, int] = field(default_factory=dict)
    """Row of the episode -> index in `files`."""


@dataclass(frozen=True, eq=False)
class _Results:
    """Results of the exported frames, and the rows of all frames in the episode."""

    dataset: Dataset
    episode: Episode
    rows: Int[ndarray, " frames"]
    state: ForeignTable
    """State of the episode by names."""
    state_type: str
    maps: dict[str, ColumnMaps]
    """Arm -> conversions to columns of the state."""
    masks: list[_Masks]

    @property
    def meanings(self) -> dict[str, str]:
        """Column of the state -> `ARM.JOINT`, or `ARM.tip.COMPONENT`."""
        return {column: meaning for maps in self.maps.values() for column, meaning in maps.meanings.items()}


def write_lerobot(dataset: Dataset, folder: OutputPath, progress: ExportProgress) -> None:
    """Write a copy of the LeRobot data set that the sequence was imported from, with results as features.

    Raises:
        SequenceError: the recording is unknown, missing, not a LeRobot data set, or not that of the sequence.
    """
    require_package("pyarrow", "import")
    path = source_of(dataset.recording, dataset.sequence)
    root = data_set_root(path)
    if not is_regular(root / "meta/info.json"):
        raise SequenceError(f"{path} is not a LeRobot data set: meta/info.json is missing. Choose another format.")
    info, features, rate = read_info(root)
    results = _results(dataset, root, path, info, features, rate)
    _collect_masks(results, progress)
    statistics: dict[str, _Sums] = {}
    by_episode: dict[int, dict[str, _Sums]] = {}
    files = parquet_files(root / "data")
    for file in files:
        content = _extended(file, results, statistics, by_episode)
        write_bytes(below(folder, root, file), content)
    replaced = {root / name for name in ("meta/info.json", _STATISTICS, _EPISODE_STATISTICS, DESCRIPTION)}
    parts, media = ("meta", "data", "videos", "images", "README.md"), ("videos", "images")
    copy_files(root, folder, dataset.images, parts=parts, media=media, skip={*files, *replaced})
    features |= _features(results)
    write_text(folder / "meta" / "info.json", json.dumps({**info, "features": features}, indent=4, ensure_ascii=False))
    _write_statistics(root, folder, statistics, by_episode)
    write_text(folder / "meta" / "carts.json", _description(results))


def _results(
    dataset: Dataset, root: Path, path: Path, info: dict[str, Any], features: dict[str, Any], rate: float
) -> _Results:
    """Match the frames with rows of the episode, and the state's columns with joints."""
    sequence = as_imported(dataset.sequence)
    episode = read_episode(path, info)
    where = f"episode {episode.index} of {root}"
    times = episode_times(episode, rate, Import(ImportOptions()))
    rows = rows_of_frames(sequence, len(episode.table), times, where)
    state = state_table(root, features, episode)
    meanings = column_meanings(state, sequence)
    maps = column_maps(state, meanings, sequence, lambda arm, _: (rows, sequence.measured[arm]))
    if meanings.arms and not maps:
        raise SequenceError(
            f"the joint positions of {sequence.path} are not those of {where}. Give the recording from which the "
            "sequence was imported: --recording PATH."
        )
    masks = []
    for camera in dataset.scene.cameras:
        size = camera.height, camera.width
        key = _video_feature(dataset, camera.name, episode) or f"observation.images.{camera.name}"
        masks.append(_Masks(f"{key}_mask", size, [_mask_file(np.zeros(size, bool))], [0.0]))
    kind = str(features[STATE].get("dtype", "float32"))
    kind = kind if kind in ("float32", "float64") else "float32"
    return _Results(dataset, episode, rows, state, kind, maps, masks)


def _video_feature(dataset: Dataset, camera: str, episode: Episode) -> str | None:
    """Feature whose folder has the video of a camera, also in a copy of the data set; None for other images."""
    source = dataset.sequence.image_source(camera)
    folders = source.path.parts if isinstance(source, Video) else ()
    return next((folder for folder in reversed(folders) if folder in episode.videos), None)


def _mask_file(mask: ndarray) -> bytes:
    """PNG of a mask with three equal channels, since LeRobot's images are RGB."""
    return image_png(np.repeat(mask.astype(np.uint8)[..., None] * 255, 3, axis=-1))


def _collect_masks(results: _Results, progress: ExportProgress) -> None:
    """Render the masks of all frames as files of the recorded images' size."""
    dataset = results.dataset
    masks = dict(zip((camera.name for camera in dataset.scene.cameras), results.masks, strict=True))
    for view in dataset.views(progress):
        mask, own = dataset.recorded_mask(view), masks[view.camera.name]
        own.rows[int(results.rows[view.frame.index])] = len(own.files)
        own.files.append(_mask_file(mask))
        own.shares.append(float(mask.mean()))


def _extended(
    file: Path, results: _Results, statistics: "dict[str, _Sums]", by_episode: "dict[int, dict[str, _Sums]]"
) -> bytes:
    """Content of a data file with the new columns; adds their values to the statistics."""
    with well_formed(f"table {file} cannot be read", "Copy the data set again."):
        recorded = read_parquet(file)
        episodes = np.asarray(recorded.get("episode_index", np.zeros(0)), int)
        if not len(episodes):
            raise ValueError("it has no column episode_index")
        own = np.flatnonzero(episodes == results.episode.index)
        if len(own) not in (0, len(results.episode.table)):
            raise ValueError(
                f"it has {len(own)} of {len(results.episode.table)} rows of episode {results.episode.index}"
            )
        columns = _columns(recorded, len(episodes), own, results)
        limits = Limits.of(file)
        size = sum(_size(column) for column in columns.values())
        limits = Limits(limits.seconds + size * 1e-6, limits.memory + _MEMORY_PER_BYTE * size, limits.written)
        content = called(tables.extended_parquet, file, columns, limits=limits)
    for episode in np.unique(episodes).tolist():
        rows = episodes == episode
        for name, column in columns.items():
            values = _statistics_of(name, column, results)
            if values is not None:
                for sums in (statistics, by_episode.setdefault(episode, {})):
                    sums.setdefault(name, _Sums()).add(values[rows], image=column[0] == "images")
    return content


def _size(column: list[Any]) -> int:
    """Size of an expanded column [bytes]."""
    if column[0] == "numbers":
        return column[1].nbytes
    lengths = np.array([len(value) for value in column[1]])
    return int(lengths[column[2]].sum()) + int(lengths.sum())


def _columns(
    recorded: Mapping[str, Any], rows: int, own: Int[ndarray, " episode_rows"], results: _Results
) -> dict[str, list[Any]]:
    """New columns of a data file, for `extended_parquet`; rows other than `own` keep earlier results."""
    dataset, scene = results.dataset, results.dataset.scene
    frames = dataset.frames if len(own) else ()
    width = len(joint_columns(scene))
    positions = _earlier(recorded, POSITIONS, (rows, width), np.nan, own)
    std = _earlier(recorded, STD, (rows, width), np.nan, own)
    corrected = _earlier(recorded, CORRECTED, (rows,), 0.0, own).astype(bool)
    sources, verdicts = (_earlier_texts(recorded, name, rows, own) for name in (SOURCE, VERDICT))
    for frame in frames:
        row = own[results.rows[frame.index]]
        positions[row], std[row] = position_values(scene, frame), std_values(scene, frame)
        corrected[row] = frame.source != "measured"
        sources[row], verdicts[row] = frame.source, frame.verdict or ""
    found: dict[str, list[Any]] = {}
    if results.maps:
        found[CORRECTED_STATE] = ["numbers", _state(recorded, own, results).astype(results.state_type)]
    found |= {POSITIONS: ["numbers", positions], STD: ["numbers", std], CORRECTED: ["numbers", corrected]}
    found |= {SOURCE: tables.text_column(sources), VERDICT: tables.text_column(verdicts)}
    for masks in results.masks:
        files, index = _earlier_masks(recorded, masks, rows, own)
        for number, row in masks.rows.items() if len(own) else ():
            index[own[number]] = len(files) + row
        found[masks.key] = ["images", [*files, *masks.files], index]
    return found


def _state(
    recorded: Mapping[str, Any], own: Int[ndarray, " episode_rows"], results: _Results
) -> Float[ndarray, "rows n"]:
    """Corrected state of all rows of a data file."""
    state = np.array(recorded[STATE], np.float64)
    found = np.array(recorded[CORRECTED_STATE], np.float64) if CORRECTED_STATE in recorded else state.copy()
    if found.shape != state.shape:
        raise ValueError(f"{CORRECTED_STATE} has the shape {found.shape}, and {STATE} {state.shape}")
    if len(own):
        found[own] = state[own]
        positions, changed = frame_positions(results.dataset)
        names = list(results.state.columns)
        for arm, maps in results.maps.items():
            rows = own[maps.rows[changed]]
            for name, values in maps.columns(positions[arm], results.state).items():
                found[rows, names.index(name)] = values[changed]
    return found


def _earlier(
    recorded: Mapping[str, Any], name: str, shape: tuple[int, ...], default: float, own: Int[ndarray, " episode_rows"]
) -> Float[ndarray, "rows ..."]:
    """Column of an earlier export, without the rows that are replaced; `default` in rows without results."""
    values = np.full(shape, default)
    if name in recorded:
        earlier = np.array(recorded[name], np.float64)
        if earlier.shape != shape:
            raise ValueError(
                f"its column {name} comes from an export with other joints: {earlier.shape} values instead of {shape}"
            )
        values = earlier
        values[own] = default
    return values


def _earlier_texts(recorded: Mapping[str, Any], name: str, rows: int, own: Int[ndarray, " episode_rows"]) -> ndarray:
    texts = np.array([str(text or "") for text in recorded.get(name, [""] * rows)], object)
    texts[own] = ""
    return texts


def _earlier_masks(
    recorded: Mapping[str, Any], masks: _Masks, rows: int, own: Int[ndarray, " episode_rows"]
) -> tuple[list[bytes], Int[ndarray, " rows"]]:
    """Distinct masks of an earlier export, and the index of each row's mask among these and `masks.files`."""
    earlier = list(recorded.get(f"{masks.key}.bytes", ()))
    for row in own.tolist() if earlier else ():
        earlier[row] = None
    files = list(dict.fromkeys(file for file in earlier if file))
    place = {file: number for number, file in enumerate(files)}
    return files, np.array([place.get(file, len(files)) for file in earlier or [None] * rows], np.int64)


def _statistics_of(name: str, column: list[Any], results: _Results) -> Float[ndarray, "rows n"] | None:
    """Values [rows, n] of a column with statistics: the state, and the share of arm pixels of masks."""
    if name == CORRECTED_STATE:
        return column[1].astype(np.float64)
    masks = next((masks for masks in results.masks if masks.key == name), None)
    if masks is None:
        return None
    earlier = column[1][: len(column[1]) - len(masks.files)]
    shares = [float((decode_image(file, f"a mask of {name}") > _WHITE).mean()) for file in earlier] + masks.shares
    return np.array(shares)[column[2]][:, None]


class _Sums:
    """Statistics of a feature in LeRobot's form."""

    def __init__(self) -> None:
        self._rows: list[Float[ndarray, "rows n"]] = []
        self._image = False

    def add(self, values: Float[ndarray, "rows n"], *, image: bool) -> None:
        """Add rows: values of the feature, or for masks the share of pixels in the arms."""
        self._rows.append(values)
        self._image = image

    def values(self) -> dict[str, list[Any]]:
        """Minimum, maximum, mean and standard deviation per component, or per colour channel in [0, 1]; and count."""
        rows = np.concatenate(self._rows)
        if not self._image:
            found = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
            return {**{name: values.tolist() for name, values in found.items()}, "count": [len(rows)]}
        share = float(rows.mean())
        std = float(np.sqrt(share * (1.0 - share)))
        channels = {"min": 0.0, "max": float(rows.max() > 0), "mean": share, "std": std}
        return {**{name: [[[value]]] * 3 for name, value in channels.items()}, "count": [len(rows)]}


def _write_statistics(
    root: Path, folder: OutputPath, statistics: dict[str, _Sums], by_episode: dict[int, dict[str, _Sums]]
) -> None:
    """Copy the files of statistics that the data set has, with those of the new features."""
    if is_regular(root / _STATISTICS):
        with well_formed(f"{root / _STATISTICS} does not map features to statistics"):
            content = {**parse_json(read_text(root / _STATISTICS, VALUES), finite=False)}
        content |= {name: sums.values() for name, sums in statistics.items()}
        write_text(folder / "meta" / "stats.json", json.dumps(content, indent=4))
    if is_regular(root / _EPISODE_STATISTICS):
        lines = []
        with well_formed(f"{root / _EPISODE_STATISTICS} does not have the statistics of an episode in every line"):
            for line in read_text(root / _EPISODE_STATISTICS, VALUES).splitlines():
                entry = parse_json(line, finite=False)
                own = by_episode.get(int(entry["episode_index"]), {})
                entry["stats"] = {**entry["stats"], **{name: sums.values() for name, sums in own.items()}}
                lines.append(json.dumps(entry) + "\n")
        write_text(folder / "meta" / "episodes_stats.jsonl", "".join(lines))


def _features(results: _Results) -> dict[str, dict[str, Any]]:
    """Descriptions of the new features for `meta/info.json`."""
    columns = joint_columns(results.dataset.scene)
    found: dict[str, dict[str, Any]] = {}
    if results.maps:
        names = list(results.state.columns)
        found[CORRECTED_STATE] = {"dtype": results.state_type, "shape": [len(names)], "names": names}
    for name in (POSITIONS, STD):
        found[name] = {"dtype": "float64", "shape": [len(columns)], "names": columns}
    found[CORRECTED] = {"dtype": "bool", "shape": [1], "names": None}
    for name in (SOURCE, VERDICT):
        found[name] = {"dtype": "string", "shape": [1], "names": None}
    for masks in results.masks:
        found[masks.key] = {"dtype": "image", "shape": [*masks.size, 3], "names": ["height", "width", "channels"]}
    return found


def _description(results: _Results) -> str:
    """Origin of the results and meaning of the state's columns, as JSON."""
    meanings = results.meanings
    content = {
        "sequence": results.dataset.sequence.name,
        "episode_index": results.episode.index,
        "corrected_columns": {name: meanings[name] for name in results.state.columns if name in meanings},
        "recorded_columns": [name for name in results.state.columns if name not in meanings],
    }
    return json.dumps(content, indent=1)
