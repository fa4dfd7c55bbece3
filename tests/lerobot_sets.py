"""LeRobot data sets of both versions, written with pyarrow and PyAV in their official layouts."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet
from recordings import image, jaw_at, joints_at, pose_of
from videos import write_video

from carts_core.model.psm_kinematics import JOINT_NAMES, forward

FRAMES = 6
LENGTHS = (4, FRAMES)
CAMERAS = {"observation.images.endoscope.left": "left", "observation.images.endoscope.right": "right"}
POSES = [
    *(f"psm1_pose.position.{axis}" for axis in "xyz"),
    *(f"psm1_pose.orientation.{axis}" for axis in "xyzw"),
    "psm1_jaw",
]
JOINTS = [*(f"PSM2_joint_{n}" for n in range(1, 7)), "PSM2_jaw", *(f"PSM2_ee_{a}" for a in "xyz")]
JOINTS += ["PSM2_roll", "PSM2_pitch", "PSM2_yaw"]
PATHS = {
    "v2.1": {
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    },
    "v3.0": {
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    },
}
STATISTICS = {"min": [0.0], "max": [1.0], "mean": [0.5], "std": [0.1], "count": [4]}


def states(names: list[str], start: int, count: int) -> list[list[float]]:
    times = np.arange(start, start + count) / 30
    if names is POSES:
        return [[*pose_of(forward(joints_at(time))), float(jaw_at(time))] for time in times]
    return [[*joints_at(time), float(jaw_at(time)), 0, 0, 0, 9, 9, 9] for time in times]


def write_parquet(path: Path, columns: dict) -> None:
    """Table as written by the package `datasets`, with its description of the columns in the metadata."""
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pyarrow.table(columns)
    features: dict[str, Any] = {}
    for field in table.schema:
        values = columns[field.name]
        one = field.type.value_type if (listed := pyarrow.types.is_list(field.type)) else field.type
        feature = {"dtype": {"float": "float32", "double": "float64"}.get(str(one), str(one)), "_type": "Value"}
        length = len(values[0]) if listed and len(values) else -1
        features[field.name] = {"feature": feature, "length": length, "_type": "Sequence"} if listed else feature
    described = json.dumps({"info": {"features": features}})
    pyarrow.parquet.write_table(table.replace_schema_metadata({"huggingface": described}), path)


def write_meta(folder: Path, version: str) -> None:
    """Tasks, statistics and, in v2.1, lengths of the episodes."""
    one: dict[str, Any] = {"observation.state": STATISTICS}
    if version == "v2.1":
        numbers = range(len(LENGTHS))
        write_lines(folder / "meta/episodes_stats.jsonl", [{"episode_index": n, "stats": one} for n in numbers])
        write_lines(folder / "meta/tasks.jsonl", [{"task_index": 0, "task": "suture"}])
        write_lines(
            folder / "meta/episodes.jsonl",
            [{"episode_index": n, "tasks": ["suture"], "length": LENGTHS[n]} for n in numbers],
        )
        return
    (folder / "meta/stats.json").write_text(json.dumps(one))
    table = pyarrow.table({"task_index": [0], "task": ["suture"]})
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    index = json.dumps({"index_columns": ["task"], "column_indexes": [], "columns": columns})
    pyarrow.parquet.write_table(table.replace_schema_metadata({"pandas": index}), folder / "meta/tasks.parquet")


def write_lines(path: Path, entries: list[dict]) -> None:
    path.write_text("".join(json.dumps(entry) + "\n" for entry in entries))


def dataset(folder: Path, version: str = "v2.1", names: list[str] = POSES, kind: str = "float64") -> Path:
    """Two episodes with consecutive times."""
    video = {"dtype": "video", "shape": [72, 96, 3], "names": ["height", "width", "channel"]}
    state = {"dtype": kind, "shape": [len(names)], "names": [names] if version == "v2.1" else names}
    indices = dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")
    added = {
        name: {"dtype": kind, "shape": [1], "names": None} for name, kind in {"timestamp": "float32", **indices}.items()
    }
    info = {
        "codebase_version": version,
        "robot_type": None,
        "fps": 30,
        "total_episodes": len(LENGTHS),
        "total_frames": sum(LENGTHS),
        "total_tasks": 1,
        "chunks_size": 1000,
        "splits": {"train": f"0:{len(LENGTHS)}"},
        **PATHS[version],
        "features": {"observation.state": state, **dict.fromkeys(CAMERAS, video), **added},
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps(info))
    write_meta(folder, version)
    starts = np.concatenate([[0], np.cumsum(LENGTHS)]).tolist()
    tables = [
        {
            "observation.state": np.array(states(names, starts[episode], count), kind).tolist(),
            "timestamp": (np.arange(count) / 30).astype("float32"),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, episode),
            "index": starts[episode] + np.arange(count),
            "task_index": np.zeros(count, int),
        }
        for episode, count in enumerate(LENGTHS)
    ]
    for key, camera in CAMERAS.items():
        pictures = [[image(starts[e] + n, camera) for n in range(count)] for e, count in enumerate(LENGTHS)]
        if version == "v2.1":
            for episode, part in enumerate(pictures):
                write_video(folder / f"videos/chunk-000/{key}/episode_{episode:06d}.mp4", part, 30)
        else:
            write_video(folder / f"videos/{key}/chunk-000/file-000.mp4", [p for part in pictures for p in part], 30)
    if version == "v2.1":
        for episode, table in enumerate(tables):
            write_parquet(folder / f"data/chunk-000/episode_{episode:06d}.parquet", table)
        return folder
    write_parquet(
        folder / "data/chunk-000/file-000.parquet", {key: [*tables[0][key], *tables[1][key]] for key in tables[0]}
    )
    episodes: dict[str, list] = {"episode_index": [0, 1], "tasks": [["suture"]] * 2, "length": list(LENGTHS)}
    episodes |= {"dataset_from_index": starts[:2], "dataset_to_index": starts[1:]}
    for key in ("data", "meta/episodes"):
        episodes |= {f"{key}/chunk_index": [0, 0], f"{key}/file_index": [0, 0]}
    for key in CAMERAS:
        episodes |= {f"videos/{key}/chunk_index": [0, 0], f"videos/{key}/file_index": [0, 0]}
        episodes[f"videos/{key}/from_timestamp"] = [start / 30 for start in starts[:2]]
        episodes[f"videos/{key}/to_timestamp"] = [end / 30 for end in starts[1:]]
    write_parquet(folder / "meta/episodes/chunk-000/file-000.parquet", episodes)
    return folder


def with_states(folder: Path, names: object, rows: list[list[float]]) -> Path:
    """The data set (v2.1) with other states of its first episode."""
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"]["observation.state"] |= {"shape": [len(rows[0])], "names": names}
    (folder / "meta/info.json").write_text(json.dumps(info))
    file = folder / "data/chunk-000/episode_000000.parquet"
    table = pyarrow.parquet.read_table(file).drop_columns(["observation.state"])
    write_parquet(file, {"observation.state": rows, **table.to_pydict()})
    return folder


def two_arms(folder: Path) -> Path:
    """A data set (v2.1) whose state has the same joint names under the keys of two arms."""
    joints = [*JOINT_NAMES, "jaw"]
    rows = [[*joints_at(n / 30), 0.1, *joints_at(1 + n / 30), 0.2] for n in range(LENGTHS[0])]
    return with_states(dataset(folder), {"psm1": joints, "psm2": joints}, rows)
