"""Messages of a bag, and the numbers in those of the dVRK."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SequenceError
from ...model.psm_kinematics import JOINT_NAMES
from ..importing.columns import order_of_names


def messages(reader: Any, connections: list[Any], path: Path) -> Iterator[tuple[Any, int, Any]]:
    """Decoded messages, with the times at which they were recorded [ns].

    Raises:
        SequenceError: the bag is damaged.
    """
    messages = reader.messages(connections)
    while True:
        try:
            entry = next(messages, None)
            if entry is None:
                return
            connection, time, raw = entry
            message = reader.deserialize(raw, connection.msgtype)
        except Exception as error:  # rosbags raises whatever its storage formats raise
            raise SequenceError(
                f"bag {path} is damaged or was cut off ({error}). Copy it again, or reindex it."
            ) from error
        yield connection, time, message


def raw_messages(reader: Any, connections: list[Any], path: Path) -> Iterator[tuple[Any, int, bytes]]:
    """Messages as they lie in the bag, with the times at which they were recorded [ns].

    Raises:
        SequenceError: the bag is damaged.
    """
    messages = reader.messages(connections)
    while True:
        try:
            entry = next(messages, None)
        except Exception as error:  # rosbags raises whatever its storage formats raise
            raise SequenceError(
                f"bag {path} is damaged or was cut off ({error}). Copy it again, or reindex it."
            ) from error
        if entry is None:
            return
        yield entry


def stamp_of(message: Any, bag_time: int) -> float:
    """The time in a message's header, or that at which it was recorded [s]."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    nanoseconds = bag_time if stamp is None or stamp.sec == 0 else stamp.sec * 10**9 + stamp.nanosec
    return nanoseconds * 1e-9


def values_of(message: Any, role: str, joints: Sequence[str] = JOINT_NAMES) -> tuple[float, ...] | None:
    """Joint positions, a jaw angle, or a pose (x y z, quaternion x y z w) of a message; None if it has none.

    Args:
        message: of a topic with this role.
        role: "joints", "jaw" or a pose.
        joints: names in the order of the result.

    Raises:
        SequenceError: some names are those of joints and others are not, so that the order is not known.
    """
    if role in ("joints", "jaw"):
        positions = np.asarray(message.position, np.float64)
        names = joints if role == "joints" else ("jaw",)
        if len(positions) < len(names):
            return None
        order = order_of_names(tuple(message.name), tuple(names)) if role == "joints" else None
        chosen = positions[: len(names)] if order is None else positions[list(order)]
        return tuple(chosen.tolist())
    pose = getattr(message, "pose", None) or getattr(message, "transform", None)
    if pose is None:
        return None
    p = getattr(pose, "position", None) or pose.translation
    q = getattr(pose, "orientation", None) or pose.rotation
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)


def header_time(raw: bytes, connection: Any, reader: Any, bag_time: int) -> int:
    """The stamp of a message that begins with a header, without decoding its pixels."""
    start = 4  # ROS 1 has the sequence number there, ROS 2 the encapsulation.
    seconds = int.from_bytes(raw[start : start + 4], "little")
    nanoseconds = int.from_bytes(raw[start + 4 : start + 8], "little")
    return seconds * 10**9 + nanoseconds if seconds and nanoseconds < 10**9 else bag_time
