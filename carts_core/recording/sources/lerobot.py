"""LeRobot data sets, v2.1 and v3.0 (Open-H-Embodiment): Parquet tables and videos, without the package `lerobot`."""

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SequenceError
from ...files.reading import VALUES, parse_json, read_text
from ...package_imports import require_package
from ..importing.cameras import calibration_of, find_images, side_of
from ..importing.columns import arm_log, guess_columns, samples
from ..importing.foreign_tables import ForeignTable, read_parquet
from ..importing.found import FoundArm, FoundCamera, FoundRecording, Import, PartError, Source, well_formed
from ..importing.logs import arm_from_log, nearest
from ..importing.row_matching import by_rows

STATE = "observation.state"
_EPISODE = re.compile(r"episode_(\d+)\.parquet$")


@dataclass(frozen=True, eq=False)
class Episode:
    """Episode with its rows, and its location in the videos."""

    index: int
    table: ForeignTable
    """Rows of the episode."""
    videos: dict[str, tuple[Path, int]]
    """Feature -> video, and number of the episode's first frame in the video."""


def data_set_root(path: Path) -> Path:
    """Folder of the data set, given this folder or an episode file."""
    if path.is_file() and _EPISODE.search(path.name):
        return next((parent for parent in path.parents if (parent / "meta/info.json").is_file()), path)
    return path


def read_info(root: Path) -> tuple[dict[str, Any], dict[str, Any], float]:
    """Read `meta/info.json` of a data set: its content, the features by name, and the frame rate [1/s]."""
    with well_formed(f"{root / 'meta/info.json'} is not a LeRobot description with features and fps"):
        info = parse_json(read_text(root / "meta/info.json", VALUES))
        return info, dict(info["features"]), float(info["fps"])


def read_episode(path: Path, info: dict[str, Any]) -> Episode:
    """Read the episode of a data set's folder (its first one) or of an episode file."""
    root, wanted = data_set_root(path), _EPISODE.search(path.name)
    cameras = [
        key
        for key, value in dict(info["features"]).items()
        if isinstance(value, dict) and value.get("dtype") == "video"
    ]
    episode = _episode(root, info, cameras, int(wanted.group(1)) if wanted else 0)
    if not len(episode.table):
        raise SequenceError(f"{root}: episode {episode.index} has no rows. Give another one.")
    return episode


def _read(path: Path, job: Import) -> FoundRecording:
    require_package("pyarrow", "import")
    root = data_set_root(path)
    info, features, rate = read_info(root)
    episode = read_episode(path, info)
    rows = len(episode.table)
    if (total := info.get("total_episodes", 1)) != 1:
        job.found(f"episode {episode.index} of {total}; to import another one, give its .parquet file.")
    ids = tuple(f"{number:06d}" for number in range(rows))
    arms = _arms(root, features, episode, job)
    times = episode_times(episode, rate, job)
    arms, kept_ids, kept = by_rows(arms, ids, job, times)
    found = _cameras(root, episode, kept, times, job)
    kind = f"a LeRobot data set ({info.get('codebase_version', 'unknown version')})"
    return job.recording(kind, f"{root.name}-{episode.index:06d}", found, arms, kept_ids, times[kept])


def episode_times(episode: Episode, rate: float, job: Import) -> np.ndarray:
    """Times of an episode's rows, which are also those of its images [s]: from their column, else from the frame
    rate."""
    even = np.arange(len(episode.table)) / rate
    if "timestamp" not in episode.table.columns:
        return even
    times = episode.table.numbers("timestamp").astype(np.float64)
    if times.shape != even.shape or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        text = "the column timestamp does not increase and is not used; times are computed from the rate"
        job.warning(f"{text}, {rate:g} images/s.")
        return even
    times = times - times[0]
    if (late := np.abs(times - even).max()) > 0.5 / rate:
        job.warning(
            f"the column timestamp deviates by up to {late:.3f} s from a constant rate of {rate:g} images/s. It is "
            "still used; row n is assigned to image n of the episode."
        )
        return times
    # Single-precision times are not more accurate than the frame rate.
    return even


def _episode(root: Path, info: dict[str, Any], cameras: list[str], index: int) -> Episode:
    chunk = index // max(int(info.get("chunks_size", 1000)), 1)
    old = root / f"data/chunk-{chunk:03d}/episode_{index:06d}.parquet"
    if old.is_file():
        videos = {key: (root / f"videos/chunk-{chunk:03d}/{key}/episode_{index:06d}.mp4", 0) for key in cameras}
        return Episode(index, _parquet(old), videos)
    # v3.0: many episodes in one file; meta/episodes has their positions.
    for file in parquet_files(root / "meta/episodes"):
        columns = _parquet(file).columns
        for number in np.flatnonzero(columns.get("episode_index", np.empty(0)) == index)[:1]:
            row = {name: values[number] for name, values in columns.items()}
            return _v3(root, row, cameras, float(info["fps"]), index)
    raise SequenceError(
        f"{root} has no episode {index}: neither {old.relative_to(root)} nor a row of meta/episodes. Copy it again."
    )


def _v3(root: Path, row: dict[str, Any], cameras: list[str], rate: float, index: int) -> Episode:
    with well_formed(f"{root}: meta/episodes lacks values of episode {index}", "Copy the data set again."):
        chunk, file = int(row["data/chunk_index"]), int(row["data/file_index"])
        table = _parquet(root / f"data/chunk-{chunk:03d}/file-{file:03d}.parquet")
        own = table.columns["episode_index"] == index
        table = ForeignTable(table.path, {name: values[own] for name, values in table.columns.items()})
        videos = {}
        for key in cameras:
            place = (
                f"chunk-{int(row[f'videos/{key}/chunk_index']):03d}/file-{int(row[f'videos/{key}/file_index']):03d}.mp4"
            )
            videos[key] = (root / f"videos/{key}/{place}", round(float(row[f"videos/{key}/from_timestamp"]) * rate))
    return Episode(index, table, videos)


def _parquet(path: Path) -> ForeignTable:
    with well_formed(f"table {path} cannot be read"):
        return ForeignTable(path, read_parquet(path))


def parquet_files(folder: Path) -> list[Path]:
    """Parquet files below a folder by name, without hidden files (such as `._file-000.parquet` of macOS)."""
    return sorted(file for file in folder.rglob("*.parquet") if not file.name.startswith("."))


def feature_names(value: Any) -> list[str]:
    """Column names of a feature, which may be nested in lists or under keys; if they repeat under several keys, the key
    is prefixed, as in `psm1.yaw`."""
    if isinstance(value, str):
        return [value]
    if not isinstance(value, dict):
        return [name for entry in value or () for name in feature_names(entry)]
    keyed = [(key, name) for key, entry in value.items() for name in feature_names(entry)]
    names = [name for _, name in keyed]
    return names if len(set(names)) == len(names) else [f"{key}.{name}" for key, name in keyed]


def state_table(root: Path, features: dict[str, Any], episode: Episode) -> ForeignTable:
    """Columns of `observation.state` by their names; `SequenceError` if they are missing or inconsistent."""
    if STATE not in features or STATE not in episode.table.columns:
        raise SequenceError(f"{root} has no feature {STATE}. Its features are: {', '.join(features)}.")
    names = feature_names(features[STATE].get("names"))
    with well_formed(f"{root}: rows of {STATE} differ in length", "Copy the data set again."):
        values = np.array(episode.table.columns[STATE].tolist(), np.float64)
    if values.ndim != 2 or len(names) != values.shape[1]:
        raise SequenceError(
            f"{root}: {STATE} has {values.shape[-1]} columns and {len(names)} names in meta/info.json. Correct them."
        )
    if repeated := [name for name, count in Counter(names).items() if count > 1]:
        raise SequenceError(
            f"{root}: {STATE} has several columns with the same name in meta/info.json: {', '.join(repeated)}. Rename "
            "them, such as psm1_yaw and psm2_yaw."
        )
    return ForeignTable(root / "meta/info.json", {name: values[:, index] for index, name in enumerate(names)})


def _arms(root: Path, features: dict[str, Any], episode: Episode, job: Import) -> tuple[FoundArm, ...]:
    table = state_table(root, features, episode)
    meanings = guess_columns(table, job.options)
    if not meanings.arms:
        raise PartError(
            "columns",
            f"{root}: {STATE} has the columns {samples(table)}, among which neither six joints of a PSM nor a tip "
            "pose are recognized.",
            "Give them: --columns yaw COLUMN ..., or give the robot: --robot NAME FILE.urdf.",
        )
    times = np.arange(len(table), dtype=float)
    arms = []
    for recorded, columns in meanings.arms.items():
        if (name := job.arm_name(recorded)) is not None:
            log = arm_log(table, name or "PSM1", columns, times, job, meanings.stated)
            arms.append(arm_from_log(log, job))
    return tuple(arms)


def _cameras(root: Path, episode: Episode, kept: np.ndarray, times: np.ndarray, job: Import) -> tuple[FoundCamera, ...]:
    rows = len(times)
    cameras = []
    named = {side_of(key) or key.rsplit(".", 1)[-1]: key for key in episode.videos}
    for name, key in sorted((job.options.images or named).items()):
        if key not in episode.videos:
            raise SequenceError(f"{root} has no video {key!r}. It has: {', '.join(episode.videos) or 'none'}.")
        video, start = episode.videos[key]
        if not video.is_file():
            raise SequenceError(f"video {video} is missing. Copy the whole data set again.")
        images = find_images(video)
        if len(images.ids) < start + rows:
            raise SequenceError(
                f"video {video} has {len(images.ids)} frames, but episode {episode.index} consists of frames {start} "
                f"to {start + rows - 1}. Copy it again."
            )
        job.found(f"{key}, {images.size[0]} x {images.size[1]}.", name)
        numbers = start + kept
        if start == 0 and len(images.ids) > rows and images.times is not None:
            # The video contains only this episode, with images that have no row.
            numbers = nearest(times, images.times - images.times[0])[kept]
            job.warning(f"{video.name} has {len(images.ids)} images for {rows} rows, which are matched by time.")
        camera = FoundCamera(name, images.size, video, numbers=numbers)
        cameras.append(calibration_of(camera, job))
    return tuple(cameras)


SOURCE = Source(
    "lerobot",
    "a LeRobot data set, v2.1 or v3.0",
    "a folder with meta/info.json, or an episode's .parquet file in one",
    lambda path: (data_set_root(path) / "meta/info.json").is_file(),
    ("images", "columns", "time_offset"),
    _read,
)
