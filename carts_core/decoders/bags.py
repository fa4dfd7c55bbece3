"""ROS bags: topics, numeric data in dVRK messages, and single messages as plain values."""

from array import array
from dataclasses import fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..files.reading import BAG, GIB, check_regular

LIBRARIES = dict.fromkeys(("topics", "rows", "image_times", "message"), ("rosbags.highlevel", "rosbags.typesys"))
"""Function -> modules to import before the memory limit applies."""
_SAMPLED = 20
"""Number of image headers that are read from a large bag."""


def topics(path: Path) -> list[tuple[str, str]]:
    """Name and message type of each topic, in the order of the bag; repeated for topics with several publishers.

    Raises:
        ValueError: a file of the bag is not a regular file.
        Exception: the bag is damaged or of an unknown type; the class depends on the storage format.
    """
    return [(connection.topic, connection.msgtype) for connection in _opened(path).connections]


def rows(path: Path, wanted: dict[str, tuple[str, str]]) -> dict[str, Any]:
    """Read the data of several topics in one pass.

    Args:
        path: path of the bag.
        wanted: topic -> name of the result to which the topic contributes, and type of its messages: `joints`, `jaw`,
            `pose` or `text`.

    Returns:
        Result by name. For `text`, it is the last text. Otherwise, it is a list of pairs: a tuple of joint names (empty
        except for `joints`), and an array [messages, 1 + values] of times [s] and joint positions, a jaw angle, or a
        pose (x y z, quaternion x y z w).

    Raises:
        Exception: as `topics`.
    """
    reader = _opened(path)
    texts: dict[str, str] = {}
    found: dict[str, dict[tuple[tuple[str, ...], int], array[float]]] = {}
    connections = [connection for connection in reader.connections if connection.topic in wanted]
    for connection, time, raw in reader.messages(connections) if connections else ():
        decoded = reader.deserialize(raw, connection.msgtype)
        name, kind = wanted[connection.topic]
        if kind == "text":
            texts[name] = str(decoded.data)
            continue
        groups = found.setdefault(name, {})
        if values := _values(decoded, kind):
            key = tuple(decoded.name) if kind == "joints" else (), 1 + len(values)
            groups.setdefault(key, array("d")).extend((_stamp(decoded, time), *values))
    arrays = {
        name: [(joints, np.array(values).reshape(-1, width)) for (joints, width), values in groups.items()]
        for name, groups in found.items()
    }
    return {**texts, **arrays}


def image_times(path: Path, topic: str) -> tuple[np.ndarray, np.ndarray]:
    """Record times [ns] and header times [s] of a topic's images; of large bags with an index, few headers are read.

    Raises:
        Exception: as `topics`.
    """
    reader = _opened(path)
    connections = [connection for connection in reader.connections if connection.topic == topic]
    indexes = [getattr(one, "indexes", None) for one in reader.readers]
    size = sum(file.stat().st_size for file in ([path] if path.is_file() else path.rglob("*")) if file.is_file())
    record: list[int] = []
    late: list[int] = []
    # In bags of up to 1 GiB, the header time of every image is read.
    if size > GIB and all(indexes):
        record = sorted(
            entry.time for index in indexes if index for connection in connections for entry in index[connection.id]
        )
    for count, (_, time, raw) in enumerate(reader.messages(connections)):
        if record and count == _SAMPLED:
            break
        late.append(_header_time(raw, time) - time)
        if not record or count >= len(record):
            record.append(time)
    times = np.array(record, np.int64)
    each = np.array(late, np.int64) if len(late) == len(times) else np.int64(np.median(late)) if late else 0
    return times, (times + each) * 1e-9


def message(path: Path, topic: str, time: int | None = None) -> dict[str, Any] | None:
    """Fields of a message by name; None if there is no such message.

    Args:
        path: path of the bag.
        topic: topic of the message.
        time: record time [ns]; None for the first message.

    Raises:
        Exception: as `topics`.
    """
    reader = _opened(path)
    connections = [connection for connection in reader.connections if connection.topic == topic]
    limits = {} if time is None else {"start": time, "stop": time + 1}
    for connection, _, raw in reader.messages(connections, **limits) if connections else ():
        return _plain(reader.deserialize(raw, connection.msgtype))
    return None


@lru_cache(1)
def _opened(path: Path) -> Any:
    """Reader of a bag; the bag is kept open for later calls."""
    from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if not file.is_dir():
            try:
                check_regular(file, BAG)
            except (OSError, ValueError) as error:
                raise ValueError(f"{file.name} is not read: {error}") from error
    reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
    reader.open()
    return reader


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    return [_plain(entry) for entry in value] if isinstance(value, list) else value


def _stamp(decoded: Any, time: int) -> float:
    """Time in the header of a message [s]; the record time if there is no header or its time is not set."""
    stamp = getattr(getattr(decoded, "header", None), "stamp", None)
    nanoseconds = time if stamp is None or stamp.sec == 0 else stamp.sec * 10**9 + stamp.nanosec
    return nanoseconds * 1e-9


def _values(decoded: Any, kind: str) -> tuple[float, ...]:
    if kind in ("joints", "jaw"):
        positions = np.asarray(decoded.position, np.float64)
        return tuple(positions if kind == "joints" else positions[:1])
    pose = getattr(decoded, "pose", None) or getattr(decoded, "transform", None)
    if pose is None:
        return ()
    p = getattr(pose, "position", None) or pose.translation
    q = getattr(pose, "orientation", None) or pose.rotation
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)


def _header_time(raw: bytes, time: int) -> int:
    """Time stamp of a message that begins with a header [ns], read without decoding the message."""
    start = 4  # The time is preceded by the sequence number in ROS 1, and by the encapsulation header in ROS 2.
    seconds = int.from_bytes(raw[start : start + 4], "little")
    nanoseconds = int.from_bytes(raw[start + 4 : start + 8], "little")
    return seconds * 10**9 + nanoseconds if seconds and nanoseconds < 10**9 else time
