"""In which order, and at what distances in time, the frames of a sequence are visited."""

from collections.abc import Mapping
from itertools import pairwise

from ..errors import SettingsError
from ..settings import SequenceSettings


def visiting_gaps(times: Mapping[int, float | None], model: SequenceSettings) -> dict[int, float]:
    """Position -> seconds from the frame visited before it, in the order of the visits; 0 for the first one.

    Args:
        times: position -> time [s], or None where times are not known.
        model: direction, and the time between frames whose times are not known.

    Raises:
        SettingsError: there are no frames, some have times and others none, or times do not increase.
    """
    if not times:
        raise SettingsError("there are no frames to correct. Choose at least one.")
    without = [index for index, seconds in sorted(times.items()) if seconds is None]
    if 0 < len(without) < len(times):
        raise SettingsError(
            f"{len(without)} of {len(times)} frames have no time; the first is frame {without[0]}. Give all frames "
            "times, or none."
        )
    known = {
        index: index * model.frame_seconds if seconds is None else seconds for index, seconds in sorted(times.items())
    }
    for (a, before), (b, after) in pairwise(known.items()):
        if not before < after:
            raise SettingsError(
                f"frame {b} was taken at {after:g} s and frame {a} at {before:g} s. Times must increase; correct them "
                "in the sequence."
            )
    order = list(known) if model.direction == "forward" else list(reversed(known))
    return {index: abs(known[index] - known[previous]) for previous, index in pairwise([order[0], *order])}
