"""Sessions of the dVRK recorder: index.json, videos with JSON sidecars, and a ROS 2 bag or extracted CSV files.

The time of a frame is the camera's time (mono, else the mean of left and right, else left, else right), else the time
of reception. Frames are identified by number, never by time. The estimated latency of a sidecar is not applied to these
times; its negative is proposed as the time offset.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SequenceError
from ..image_sources import VIDEO_SUFFIXES, Bag
from ..importing.cameras import calibration_of, files_with, find_images, side_of
from ..importing.columns import order_of_names
from ..importing.foreign_tables import read_foreign_table
from ..importing.found import FoundCamera, FoundRecording, Import, Source, Track, read_json, well_formed
from ..importing.logs import ArmLog, arm_from_log, nearest, track
from .bag import read_arm_logs, read_endoscope

_SIDES = {"LR": ("left", "right"), "RL": ("right", "left")}
_OLD_UNITS = {"timestamps_ns": 1e-9, "timestamps_ms": 1e-3, "timestamps": 1.0}
_FAR = 0.02
"""Time between images of two cameras above which a warning is given [s]."""
_JOINT_COLUMNS = tuple(f"position.{index}" for index in range(6))
_POSE_COLUMNS = (*(f"pose.position.{axis}" for axis in "xyz"), *(f"pose.orientation.{axis}" for axis in "xyzw"))


@dataclass(frozen=True, eq=False)
class _Stream:
    """Video and the times of its frames."""

    video: Path
    name: str
    numbers: np.ndarray
    """Number of each frame in the video, from 0."""
    times: np.ndarray
    """Time of each frame [s]."""
    side_by_side: str
    latency: float
    """Estimated latency of the images [s]."""


def _detect(path: Path) -> bool:
    if not path.is_dir():
        return False
    if (path / "index.json").is_file():
        return True
    return any(_is_sidecar(video.with_suffix(".json")) for video in files_with(path, VIDEO_SUFFIXES))


def _is_sidecar(file: Path) -> bool:
    """Whether a file exists and is not another JSON file of the camera, such as its calibration."""
    if not file.is_file():
        return False
    try:
        content = read_json(file)
    except SequenceError:
        return True  # Its error is reported when the session is read.
    return isinstance(content, dict) and any(name.startswith(("frames", "timestamps")) for name in content)


def _streams(path: Path, job: Import) -> list[_Stream]:
    videos = files_with(path, VIDEO_SUFFIXES)
    if (path / "index.json").is_file():
        index = read_json(path / "index.json")
        listed = index.get("videos") if isinstance(index, dict) else None
        if not isinstance(listed, list) or not all(isinstance(entry, dict) and "file" in entry for entry in listed):
            raise SequenceError(f'{path / "index.json"} has no list "videos" of entries with "file". Copy it again.')
        videos = [path / Path(str(entry["file"])).name for entry in listed]
    streams = []
    for video in videos:
        if not video.is_file():
            raise SequenceError(f"video {video} is missing. Copy the whole session again.")
        sidecar = video.with_suffix(".json")
        if not sidecar.is_file():
            raise SequenceError(f"{sidecar} with the frame times of {video.name} is missing. Also copy the sidecar.")
        streams.append(_stream(video, sidecar, job))
    return streams


def _stream(video: Path, sidecar: Path, job: Import) -> _Stream:
    content = read_json(sidecar)
    if not isinstance(content, dict):
        raise SequenceError(f"sidecar {sidecar} is not a JSON object. Copy it again.")
    name = str(content.get("stream_name") or video.stem)
    for key, unit in _OLD_UNITS.items():
        if isinstance(stamps := content.get(key), list) and stamps:
            with well_formed(f"sidecar {sidecar}: times are not numbers"):
                times = np.array(stamps, np.float64) * unit
            return _checked(_Stream(video, name, np.arange(len(times)), times, "undefined", 0.0), sidecar, job)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise SequenceError(f'sidecar {sidecar} has neither "frames" nor "timestamps_ns". Copy it again.')
    with well_formed(f"sidecar {sidecar}: a frame has no frame_index or no cpu.realtime times"):
        numbers = np.array([int(frame["frame_index"]) for frame in frames])
        times = np.array([_frame_time(frame) for frame in frames])
    layout = str(content.get("side_by_side") or "undefined")
    if layout not in ("undefined", *_SIDES):
        raise SequenceError(f"sidecar {sidecar}: side_by_side is {layout!r}; allowed: undefined, LR and RL.")
    latency = content.get("estimated_latency_ms")
    latency = float(latency) * 1e-3 if isinstance(latency, int | float) else 0.0
    if (dropped := content.get("frames_dropped")) not in (0, None):
        job.warning(f"{video.name}: the recorder dropped {dropped} frames.")
    return _checked(_Stream(video, name, numbers, times, layout, latency), sidecar, job)


def _frame_time(frame: dict[str, Any]) -> float:
    """Time of a frame, as documented for the recorder [s]."""
    real = frame["cpu"]["realtime"]

    def known(key: str) -> int | None:
        value = real.get(f"{key}_ns")
        return int(value) if isinstance(value, int | float) and value > 0 else None

    left, right = known("left_source"), known("right_source")
    both = None if left is None or right is None else (left + right) / 2
    for value in (known("mono_source"), both, left, right, known("recorder_reception")):
        if value is not None:
            return value * 1e-9
    raise KeyError("cpu.realtime")


def _checked(stream: _Stream, sidecar: Path, job: Import) -> _Stream:
    """Stream sorted by time, without frames that are missing in the video."""
    count = len(find_images(stream.video).ids)
    if stream.numbers.max() >= count or len(stream.numbers) < count:
        job.warning(
            f"{stream.video.name} has {count} frames and its sidecar {len(stream.numbers)}; the common frames are used."
        )
    good = (stream.numbers >= 0) & (stream.numbers < count) & np.isfinite(stream.times)
    if not good.any():
        raise SequenceError(
            f"sidecar {sidecar} belongs to another video: {stream.video} has none of its frames. Copy both again."
        )
    numbers, times = stream.numbers[good], stream.times[good]
    order = np.argsort(times, kind="stable")
    increasing = np.concatenate([[True], np.diff(times[order]) > 0])
    return replace(stream, numbers=numbers[order][increasing], times=times[order][increasing])


def _cameras(streams: list[_Stream], job: Import) -> tuple[tuple[FoundCamera, ...], np.ndarray]:
    parts: dict[str, tuple[_Stream, tuple[int, int, int, int] | None, tuple[int, int]]] = {}
    for stream in streams:
        width, height = find_images(stream.video).size
        layout = stream.side_by_side
        if layout == "undefined" and width >= 3 * height:
            layout = "LR"
            text = f"{stream.video.name} is {width} x {height}: side-by-side stereo, the left camera on the left"
            job.guessed(f"{text} (the sidecar does not state it).")
        if layout in _SIDES:
            half = width // 2
            for position, side in enumerate(_SIDES[layout]):
                parts[side] = (stream, (position * half, 0, half, height), (half, height))
        else:
            parts[side_of(stream.name) or side_of(stream.video.stem) or stream.name] = (stream, None, (width, height))
    order = sorted(parts, key=lambda name: (name != "left", name))
    leader = parts[order[0]][0]
    cameras = []
    for name in order:
        stream, crop, size = parts[name]
        rows = nearest(leader.times, stream.times)
        if (late := np.abs(stream.times[rows] - leader.times).max()) > _FAR:
            job.warning(f"times of images differ by up to {late:.3f} s from those of {order[0]}.", name)
        camera = FoundCamera(name, size, stream.video, crop=crop, numbers=stream.numbers[rows])
        cameras.append(calibration_of(camera, job))
        where = "" if crop is None else f" from column {crop[0]}"
        job.found(f"{stream.video.name}{where}, {len(stream.times)} frames.", name)
    return tuple(cameras), leader.times


def _logs(path: Path, start: float, job: Import) -> tuple[list[ArmLog], Track | None]:
    bags = [each for each in sorted(path.iterdir()) if (each / "metadata.yaml").is_file()]
    bags += sorted(path.glob("*.mcap"))
    if bags:
        with Bag(bags[0]) as bag:
            motion = read_endoscope(bag, start, job)
            return read_arm_logs(bag, job), motion
    roles = {
        "jaw_measured_js": "jaw",
        "local_measured_cp": "local_poses",
        "measured_js": "joints",
        "measured_cp": "poses",
    }
    found: dict[str, dict[str, Any]] = {}
    # CSV files are named after their topic, such as `_PSM1_measured_js.csv`.
    for file in sorted(path.glob("*.csv")):
        recorded, _, topic = file.stem.strip("_").partition("_")
        if recorded.startswith("PSM") and topic in roles and (arm := job.arm_name(recorded)) is not None:
            found.setdefault(arm, {})[roles[topic]] = _extracted_track(file, roles[topic])
    return [ArmLog(arm, **tracks) for arm, tracks in found.items()], None


def _extracted_track(file: Path, role: str) -> Track | None:
    table = read_foreign_table(file)
    columns = {"joints": _JOINT_COLUMNS, "jaw": _JOINT_COLUMNS[:1]}.get(role, _POSE_COLUMNS)
    if role == "joints":
        names = tuple(str(table.columns[f"name.{n}"][0]) for n in range(6) if f"name.{n}" in table.columns)
        order = order_of_names(names) if len(names) == len(columns) else None
        columns = columns if order is None else tuple(columns[index] for index in order)
    values = np.column_stack([table.numbers(column).astype(np.float64) for column in columns])
    return track(table.numbers("timestamp").astype(np.float64) * 1e-9, values)


def _read(path: Path, job: Import) -> FoundRecording:
    streams = _streams(path, job)
    if not streams:
        raise SequenceError(f"{path} has no videos with sidecars. Record a stream, or copy the whole session again.")
    cameras, times = _cameras(streams, job)
    logs, motion = _logs(path, float(times[0]), job)
    if not logs:
        raise SequenceError(
            f"{path} has no kinematics: neither a bag with /PSM1/measured_cp or measured_js nor CSV files extracted "
            "from one (_PSM1_measured_js.csv). Also copy the folder of the bag."
        )
    arms = [arm_from_log(log, job, float(times[0]), motion) for log in logs]
    latency, offset = max(stream.latency for stream in streams), job.options.time_offset
    if offset is None:
        offset = -latency
        if latency:
            job.guessed(f"time offset: {offset:.4f} s, from the recorder's estimated latency.", option="--time-offset")
    ids = tuple(f"{number:06d}" for number in range(len(times)))
    kind = "a session of the dVRK's recorder"
    return job.recording(kind, path.name, cameras, arms, ids, times, time_offset=offset, motion=motion)


SOURCE = Source(
    "dvrk",
    "a session of the dVRK's recorder",
    "a folder with index.json, or videos each with a .json beside it",
    _detect,
    ("time_offset",),
    _read,
)
