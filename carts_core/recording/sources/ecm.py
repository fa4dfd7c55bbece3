"""Where the endoscope of a bag was, by the topics of the manipulator that holds it (ECM)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ...model.ecm_kinematics import JOINT_NAMES
from ..importing.endoscope import endoscope_motion
from ..importing.found import FoundMotion, Note
from ..importing.logs import track
from .bag_messages import messages, stamp_of, values_of

_POSES = ("local/measured_cp", "position_cartesian_local_current", "measured_cp", "position_cartesian_current")
_JOINTS = ("measured_js", "state_joint_current")


def read_endoscope(reader: Any, path: Path, start: float, note: Callable[[Note], None]) -> FoundMotion | None:
    """Where the endoscope was, if it moves.

    Args:
        reader: of the bag.
        path: of the bag, for errors.
        start: time of the first image [s].
        note: called with what was found.

    Raises:
        SequenceError: a message is damaged.
    """
    topics = {connection.topic: connection for connection in reader.connections}
    for role, names in (("poses", _POSES), ("joints", _JOINTS)):
        found = next((topic for name in names for topic in topics if _is_of_ecm(topic, name)), None)
        if found is None:
            continue
        rows = [
            (stamp_of(message, bag_time), *values)
            for _, bag_time, message in messages(reader, [topics[found]], path)
            if (values := values_of(message, role, JOINT_NAMES)) is not None
        ]
        logged = track(rows)
        return (
            endoscope_motion(logged, None, start, note)
            if role == "poses"
            else endoscope_motion(None, logged, start, note)
        )
    return None


def _is_of_ecm(topic: str, name: str) -> bool:
    return topic.casefold().endswith(f"/ecm/{name}") and "/suj/" not in topic.casefold()
