"""Where the endoscope of a bag was, by the topics of the manipulator that holds it (ECM)."""

from collections.abc import Callable

from ...model.ecm_kinematics import JOINT_NAMES
from ..image_sources import Bag
from ..importing.columns import rows_of
from ..importing.endoscope import endoscope_motion
from ..importing.found import FoundMotion, Note
from ..importing.logs import track

_POSES = ("local/measured_cp", "position_cartesian_local_current", "measured_cp", "position_cartesian_current")
_JOINTS = ("measured_js", "state_joint_current")


def read_endoscope(bag: Bag, start: float, note: Callable[[Note], None]) -> FoundMotion | None:
    """Where the endoscope was, if it moves.

    Args:
        bag: the recording.
        start: time of the first image [s].
        note: called with what was found.

    Raises:
        SequenceError: a message is damaged.
    """
    for role, names in (("poses", _POSES), ("joints", _JOINTS)):
        found = next((topic for name in names for topic, _ in bag.topics if _is_of_ecm(topic, name)), None)
        if found is None:
            continue
        logged = track(rows_of(bag.rows({found: ("ecm", role)}).get("ecm", []), role, JOINT_NAMES))
        return (
            endoscope_motion(logged, None, start, note)
            if role == "poses"
            else endoscope_motion(None, logged, start, note)
        )
    return None


def _is_of_ecm(topic: str, name: str) -> bool:
    return topic.casefold().endswith(f"/ecm/{name}") and "/suj/" not in topic.casefold()
