"""What a command suggests after its results."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import Console

from ..optimization import BASE_FRAME_GAIN, Assessment, Verdict
from ..wording import counted

_NAMED = 5
"""Frames that a hint names."""


def print_hints(console: Console, *hints: str | None) -> None:
    """Print those that there are."""
    for hint in hints:
        if hint is not None:
            console.print(hint, style="yellow")


def kept_start_hint(where: str, stopped: Sequence[str]) -> str | None:
    """Why some estimates are nothing but the start, or None if none is.

    Args:
        where: as below.
        stopped: why each optimization ended.
    """
    kept = sum(reason == "start kept" for reason in stopped)
    if not kept:
        return None
    return (
        f"{where}: the start was kept in {kept} of {counted(len(stopped), 'run')}, as the image hardly speaks against "
        "it there."
    )


def verdict_hints(where: str, assessed: Mapping[str, Assessment | None]) -> list[str]:
    """A line for each reason why results are not to be relied on, or only in part.

    Args:
        where: as below.
        assessed: id of each frame -> how far its result can be relied on.
    """
    frames: dict[tuple[str, str, str], list[str]] = {}
    for frame_id, found in assessed.items():
        if found is not None and found.verdict is not Verdict.GOOD:
            frames.setdefault((found.verdict.value, found.reason, found.remedy), []).append(frame_id)
    return [
        f"{where}: {verdict} in {len(ids)} of {counted(len(assessed), 'frame')} ({', '.join(ids[:_NAMED])}"
        f"{', ...' if len(ids) > _NAMED else ''}). {reason} {remedy}"
        for (verdict, reason, remedy), ids in frames.items()
    ]


def base_frame_hint(where: str, gains: Sequence[float | None]) -> str | None:
    """A suggestion, if on average over frames the base frames look wrong, else None.

    Args:
        where: camera, or what else tells people which frames are meant.
        gains: what free base frames would explain of each frame's remaining difference, None where that is not known.
    """
    known = [gain for gain in gains if gain is not None]
    if not known or np.mean(known) < BASE_FRAME_GAIN:
        return None
    return (
        f"{where}: base frames or the camera's pose look wrong. Joints cannot explain what is left of the difference, "
        f"and free base frames would take {100 * np.mean(known):.0f} % off it. Try `carts calibrate`, or add "
        "--base-frames."
    )
