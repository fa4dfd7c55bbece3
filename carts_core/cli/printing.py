"""Tables, verdicts and hints that commands print after their results."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from .. import recording
from ..evaluation import FrameScore, mean_score
from ..export.kinematics import KinematicsRow, joint_columns, joint_units, position_values
from ..optimization import BASE_FRAME_GAIN, Assessment, SequenceAssessment, StopReason, Verdict, fit_words
from ..wording import counted

_NAMED = 5
"""Number of frames named in a hint."""


def print_hints(console: Console, *hints: str | None) -> None:
    """Print the hints that are not None."""
    for hint in hints:
        if hint is not None:
            console.print(hint, style="yellow")


def blank_hint(where: str, frames: Sequence[int], seen: Sequence[int], *, carried: bool = False) -> str | None:
    """Hint on frames without an image; None if there are none.

    Args:
        frames, seen: all frames, and those with an image.
        carried: whether frames without an image are predicted from the others.
    """
    if len(seen) == len(frames):
        return None
    fate = "are predicted from the other frames, without a verdict" if carried else "are left out"
    return f"{where}: {len(frames) - len(seen)} of {counted(len(frames), 'frame')} have no image and {fate}."


def kept_start_hint(where: str, stopped: Sequence[str]) -> str | None:
    """Hint that estimates equal their initial values; None without such estimates."""
    kept = sum(reason == "start kept" for reason in stopped)
    if not kept:
        return None
    return (
        f"{where}: {kept} of {counted(len(stopped), 'run')} kept the initial values, because they fit the image as "
        "well as the optimized values."
    )


def verdict_line(
    where: str, verdicts: Sequence[str | None], undetermined: Sequence[Sequence[str] | None]
) -> str | None:
    """Summary of the mask verdicts and of the undetermined joints of runs (None if unknown); None if no run was
    assessed.
    """
    runs = [(verdict, joints) for verdict, joints in zip(verdicts, undetermined, strict=True) if verdict is not None]
    counts = Counter(
        fit_words(verdict, joints) for value in Verdict for verdict, joints in runs if verdict == value.value
    )
    said = "; ".join(f"{words} in {count} of {counted(len(runs), 'run')}" for words, count in counts.items())
    return f"{where}: {said}." if runs else None


def verdict_hints(where: str, assessed: Mapping[str, Assessment | None]) -> list[str]:
    """One line per reason why results are doubtful or failed."""
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
    """Reason why a sequence is doubtful or failed; None for a good or unassessed sequence."""
    if found is None or found.verdict is Verdict.GOOD:
        return None
    kept = " Failed frames keep the measured values." if found.verdict is Verdict.FAILED else ""
    return f"{where}: the sequence is {found.verdict.value}.{kept} {found.reason} {found.remedy}"


def calibration_hint(found: Assessment | None, stopped: StopReason) -> str | None:
    """Verdict on a calibration; None for an unassessed calibration."""
    if found is None:
        return None
    kept = " The calibration was not changed." if stopped in (StopReason.FAILED, StopReason.START_KEPT) else ""
    return f"Verdict: {found.verdict.value}. {found.reason}{kept} {found.remedy}".rstrip()


def base_frame_hint(where: str, gains: Sequence[float | None]) -> str | None:
    """Hint that base frames are probably wrong, from the mean share of the residual that free base frames would
    explain; None without an indication of wrong base frames.
    """
    known = [gain for gain in gains if gain is not None]
    if not known or np.mean(known) < BASE_FRAME_GAIN:
        return None
    return (
        f"{where}: base frames or the camera pose are probably wrong. Free base frames would reduce the remaining "
        f"difference between image and rendering, which joints cannot reduce, by {100 * np.mean(known):.0f} %. Run "
        "`carts calibrate`, or add --base-frames."
    )


_FRAMES = 4
"""Minimum number of frames for `constant_correction_hint`."""
_LARGE = 5.0
"""Threshold for constant corrections [deg, mm]; for angles, twice the default solver's prior standard deviation."""


def constant_correction_hint(where: str, sequence: recording.Sequence, rows: Sequence[KinematicsRow]) -> str | None:
    """Hint on large corrections that are nearly constant over the optimized frames; None without such corrections.

    A wrong focal length or base frame is compensated by the joints: the image fits, but the joints are wrong.
    """
    scene, position = sequence.scene, {frame_id: index for index, frame_id in enumerate(sequence.frame_ids)}
    rows = [row for row in rows if row.source == "optimized"]
    if len(rows) < _FRAMES:
        return None
    before = [
        np.concatenate([sequence.measured[arm.name][position[row.frame_id]] for arm in scene.arms]) for row in rows
    ]
    off = np.stack([position_values(scene, row) for row in rows]) - np.stack(before)
    prismatic = np.array([unit == "m" for unit in joint_units(scene)])
    shown = np.where(prismatic, 1e3 * off, np.degrees(off))
    typical = np.median(shown, axis=0)
    # In 80 % of the frames the correction differs from the median by at most half of the median.
    spread = np.quantile(np.abs(shown - typical), 0.8, axis=0)
    constant = np.flatnonzero((np.abs(typical) >= _LARGE) & (spread < np.abs(typical) / 2))
    if not constant.size:
        return None
    names, units = joint_columns(scene), np.where(prismatic, "mm", "deg")
    found = ", ".join(f"{names[joint]} {typical[joint]:+.1f} {units[joint]}" for joint in constant)
    return (
        f"{where}: corrections are large and nearly constant over the frames: {found}. Joint corrections also "
        "compensate for wrong intrinsics, base frames and joint zeros; check these before you rely on joint positions. "
        "Masks are unaffected."
    )


def score_table(scores: list[FrameScore], title: str) -> Table:
    """Table of means per domain and camera for `carts evaluate`."""
    table = Table(title=title, caption="MAE, std: over the measured revolute joints. s: wall time per frame.")
    for column in (
        "domain",
        "camera",
        "Dice\nbefore",
        "\nafter",
        "worst\nchange",
        "MAE [deg]\nbefore",
        "\nafter",
        "std",
        "steps",
        "s",
    ):
        table.add_column(column, justify="left" if column in ("domain", "camera") else "right")
    groups: dict[tuple[str, str], list[FrameScore]] = {}
    for score in scores:
        groups.setdefault((score.domain, score.camera), []).append(score)
    for (domain, camera), group in groups.items():
        mean = mean_score(group)
        change = [s.dice_after - s.dice_before for s in group if s.dice_after is not None and s.dice_before is not None]
        table.add_row(
            domain,
            camera,
            _number(mean["dice_before"], 4),
            _number(mean["dice_after"], 4),
            _number(min(change, default=None), 4),
            _number(mean["joint_mae_deg_before"], 2),
            _number(mean["joint_mae_deg_after"], 2),
            _number(mean["joint_std_deg"], 2),
            _number(mean["iterations"], 1),
            _number(mean["seconds"], 2),
        )
    return table


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
