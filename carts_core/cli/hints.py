"""What a command suggests after its results."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import Console

from ..optimization import BASE_FRAME_GAIN, Assessment, SequenceAssessment, StopReason, Verdict, fit_words
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
        f"{where}: the start was kept in {kept} of {counted(len(stopped), 'run')}: there it fits the image as well as "
        "the optimized values."
    )


def verdict_line(
    where: str, verdicts: Sequence[str | None], undetermined: Sequence[Sequence[str] | None]
) -> str | None:
    """Verdicts on masks, and how many joints the images leave open; None where nothing was assessed.

    Args:
        where: as below.
        verdicts: of each run, None where it was not assessed.
        undetermined: `ARM.JOINT` of the joints that each run leaves open, None where that is not known.
    """
    runs = [(verdict, joints) for verdict, joints in zip(verdicts, undetermined, strict=True) if verdict is not None]
    counts = Counter(
        fit_words(verdict, joints) for value in Verdict for verdict, joints in runs if verdict == value.value
    )
    said = "; ".join(f"{words} in {count} of {counted(len(runs), 'run')}" for words, count in counts.items())
    return f"{where}: {said}." if runs else None


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


def sequence_hint(where: str, found: SequenceAssessment | None) -> str | None:
    """Why a sequence as a whole is not to be relied on, or None if it is, or is not assessed."""
    if found is None or found.verdict is Verdict.GOOD:
        return None
    kept = " Its failed frames keep the measured values." if found.verdict is Verdict.FAILED else ""
    return f"{where}: the sequence is {found.verdict.value}.{kept} {found.reason} {found.remedy}"


def calibration_hint(found: Assessment | None, stopped: StopReason) -> str | None:
    """The verdict on a calibration; None if it was not assessed."""
    if found is None:
        return None
    kept = " The calibration is kept as it was." if stopped in (StopReason.FAILED, StopReason.START_KEPT) else ""
    return f"Verdict: {found.verdict.value}. {found.reason}{kept} {found.remedy}".rstrip()


def base_frame_hint(where: str, gains: Sequence[float | None]) -> str | None:
    """A suggestion, if on average over frames the base frames are probably wrong, else None.

    Args:
        where: camera, or what else tells people which frames are meant.
        gains: what free base frames would explain of each frame's remaining difference, None where that is not known.
    """
    known = [gain for gain in gains if gain is not None]
    if not known or np.mean(known) < BASE_FRAME_GAIN:
        return None
    return (
        f"{where}: base frames or the camera's pose are probably wrong. Free base frames would reduce the remaining "
        f"difference between image and rendering by {100 * np.mean(known):.0f} %, which joints cannot. Try "
        "`carts calibrate`, or add --base-frames."
    )
