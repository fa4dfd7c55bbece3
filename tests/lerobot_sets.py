"""LeRobot data sets of both versions, written with pyarrow and PyAV in the layouts of their owners."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet
from recordings import image, jaw_at, joints_at, pose_of
from videos import write_video

from carts_core.model.psm_kinematics import forward

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


def states(names: list[str], start: int, count: int) -> list[list[float]]:
    times = np.arange(start, start + count) / 30
    if names is POSES:
        return [[*pose_of(forward(joints_at(time))), float(jaw_at(time))] for time in times]
    return [[*joints_at(time), float(jaw_at(time)), 0, 0, 0, 9, 9, 9] for time in times]


def write_parquet(path: Path, columns: dict) -> None:
    """As the package `datasets` writes it, with its description of the columns in the metadata."""
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pyarrow.table(columns)
    features = {
        name: {"feature": {"dtype": "float32", "_type": "Value"}, "length": len(values[0]), "_type": "Sequence"}
        if isinstance(values[0], list)
        else {"dtype": "int64", "_type": "Value"}
        for name, values in columns.items()
        if len(values)
    }
    described = json.dumps({"info": {"features": features}})
    pyarrow.parquet.write_table(table.replace_schema_metadata({"huggingface": described}), path)


def write_meta(folder: Path, version: str) -> None:
    """Tasks and statistics, as the version stores them."""
    one: dict[str, Any] = {"observation.state": {"mean": [0.5], "count": [4]}}
    if version == "v2.1":
        entries = [{"episode_index": number, "stats": one} for number in range(len(LENGTHS))]
        (folder / "meta/episodes_stats.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in entries))
        (folder / "meta/tasks.jsonl").write_text('{"task_index": 0, "task": "suture"}\n')
    else:
        (folder / "meta/stats.json").write_text(json.dumps(one))
        write_parquet(folder / "meta/tasks.parquet", {"task_index": [0]})


def dataset(folder: Path, version: str = "v2.1", names: list[str] = POSES, kind: str = "float64") -> Path:
    """Two episodes; the second one's times go on where the first one's end."""
    video = {"dtype": "video", "shape": [72, 96, 3], "names": ["height", "width", "channel"]}
    state = {"dtype": kind, "shape": [len(names)], "names": [names] if version == "v2.1" else names}
    features = {"observation.state": state, **dict.fromkeys(CAMERAS, video)}
    info = {"codebase_version": version, "fps": 30, "total_episodes": 2, "chunks_size": 1000, "features": features}
    (folder / "meta").mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps(info))
    write_meta(folder, version)
    starts = np.concatenate([[0], np.cumsum(LENGTHS)]).tolist()
    tables = [
        {
            "observation.state": np.array(states(names, starts[episode], count), kind).tolist(),
            "episode_index": [episode] * count,
            "frame_index": list(range(count)),
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
        folder / "data/chunk-000/file-000.parquet", {key: tables[0][key] + tables[1][key] for key in tables[0]}
    )
    episodes: dict[str, list] = {"episode_index": [0, 1], "data/chunk_index": [0, 0], "data/file_index": [0, 0]}
    for key in CAMERAS:
        episodes |= {f"videos/{key}/chunk_index": [0, 0], f"videos/{key}/file_index": [0, 0]}
        episodes[f"videos/{key}/from_timestamp"] = [0.0, LENGTHS[0] / 30]
    write_parquet(folder / "meta/episodes/chunk-000/file-000.parquet", episodes)
    return folder
