"""Report on all jobs as an HTML page with plots and the worst frames, and as JSON."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..arrays import pose_distance
from ..errors import CartsError
from ..files import OutputPath, indented_json, write_bytes, write_text
from ..files.reading import IMAGE, read_bytes
from ..html import Table, render_page
from ..package_imports import gc_paused
from ..wording import counted, duration_text
from .cost import Cost
from .folder import ORDER, JointErrors, KnownJob, known_jobs, most_urgent_first
from .manifest import Job

_SHOWN = 24
"""Maximum number of worst frames on the page."""
_VERDICTS = ("good", "doubtful", "failed")
_TICKS = 8
"""Maximum number of intervals between the labels of a plot's axis."""


def write_batch_report(batch: OutputPath, title: str, jobs: Sequence[Job]) -> Path:
    """Write `report/report.html`, `report/report.json` and images; returns the page's path."""
    errors = JointErrors()
    folder, known = batch / "report", known_jobs(batch, jobs, joints=errors)
    with gc_paused():
        drifts, cost = _drifts(known), Cost.of(known)
        verdicts = {entry.job.name: _verdicts(entry) for entry in known}
        statistics, boxes = {}, {}
        for name, corrections, deviations in errors.joints():
            statistics[name], boxes[name] = _statistics(corrections, deviations), _box(corrections)
        page = render_page(
            "batch.html",
            title=title,
            sections={
                "Jobs": _job_table(known),
                "Verdicts": _verdict_table(verdicts),
                "Worst frames": _worst(batch, folder, known),
                "Base frames": _drift_table(drifts),
                "Joints": _joint_table(statistics),
                "Cost": _cost_table(cost),
            },
            plot=BoxPlot.of(boxes) if boxes else None,
        )
        document = {
            "format": "carts-batch-report/1",
            "jobs": {entry.job.name: {"status": entry.status, "error": entry.state.error} for entry in known},
            "verdicts": verdicts,
            "base_frames": drifts,
            "joints": statistics,
            "cost": {
                "frames": cost.frames,
                "core_hours": cost.core_hours,
                "all_core_hours": cost.all_core_hours,
                "workers": cost.estimates(),
            },
        }
        write_bytes(folder / "report.json", indented_json(document))
    write_text(folder / "report.html", page)
    return (folder / "report.html").path


def _job_table(known: Sequence[KnownJob]) -> Table | None:
    """Table of jobs, most urgent first."""
    counts = Counter(entry.status for entry in known)
    return Table.of(
        "Status of the jobs",
        ", ".join(f"{counts[status]} {status}" for status in ORDER if counts[status]),
        [
            {
                "job": entry.job.name,
                "recording": str(entry.job.recording),
                "status": entry.status,
                "seconds": f"{sum(step.seconds for step in entry.state.steps.values()):.1f}",
                "error": entry.error,
            }
            for entry in most_urgent_first(known)
        ],
    )


def _verdicts(entry: KnownJob) -> dict[str, int]:
    return {verdict: entry.results.verdicts.get(verdict, 0) if entry.results else 0 for verdict in _VERDICTS}


def _verdict_table(verdicts: Mapping[str, dict[str, int]]) -> Table | None:
    """Table of verdicts, sorted by the share of failed frames."""
    rows = [(name, counts) for name, counts in verdicts.items() if any(counts.values())]
    rows.sort(key=lambda row: (-row[1]["failed"] / sum(row[1].values()), -row[1]["doubtful"] / sum(row[1].values())))
    total = {verdict: sum(counts[verdict] for _, counts in rows) for verdict in _VERDICTS}
    return Table.of(
        "Reliability of the results",
        "Frames by verdict; verdicts use the images only, no ground truth.",
        [
            {
                "job": name,
                **{verdict: str(count) for verdict, count in counts.items()},
                "frames": str(sum(counts.values())),
            }
            for name, counts in [*([("all jobs", total)] if rows else []), *rows]
        ],
    )


def _worst(batch: OutputPath, folder: OutputPath, known: Sequence[KnownJob]) -> list[tuple[str, str]]:
    """Captions and images of the frames with the largest probability of a wrong mask, copied into the report."""
    frames = [(entry.job, frame) for entry in known for frame in (entry.results.pictured if entry.results else ())]
    frames.sort(key=lambda pair: -pair[1].probability)
    shown = []
    for number, (job, frame) in enumerate(frames[:_SHOWN], 1):
        try:
            picture = read_bytes((batch / "jobs" / job.name / frame.picture).path, IMAGE)
        except (OSError, CartsError):
            continue
        name = f"worst-{number:02d}.jpg"
        write_bytes(folder / name, picture)
        caption = (
            f"{job.name}, frame {frame.frame}, {frame.camera}: {frame.verdict}, probability of a wrong mask "
            f"{frame.probability:.2f}. {frame.reason}"
        )
        shown.append((caption, name))
    return shown


def _drifts(known: Sequence[KnownJob]) -> list[dict[str, object]]:
    """Change of each base frame since the previous job with this base frame, in the order of the manifest."""
    found: list[dict[str, object]] = [
        {"base_frame": name, "job": entry.job.name}
        for entry in known
        for name in (entry.results.base_frames if entry.results else ())
    ]
    poses: dict[str, list[list[list[float]]]] = {}
    for entry in known:
        for name, rows in (entry.results.base_frames if entry.results else {}).items():
            poses.setdefault(name, []).append(rows)
    changes = {}
    for name, rows in poses.items():
        Ts = np.array(rows, dtype=float)
        angles, distances = pose_distance(np.concatenate([Ts[:1], Ts[:-1]]), Ts)
        changes[name] = iter(zip(angles.tolist(), distances.tolist(), strict=True))
    for row in found:
        row["rotation_deg"], row["translation_mm"] = next(changes[str(row["base_frame"])])
    return found


def _drift_table(drifts: list[dict[str, object]]) -> Table | None:
    return Table.of(
        "Drift of base frames",
        "Change of each arm's base frame in a camera since the previous job of the manifest.",
        [
            {
                "base frame": str(row["base_frame"]),
                "job": str(row["job"]),
                "rotation [deg]": f"{row['rotation_deg']:.3f}",
                "translation [mm]": f"{row['translation_mm']:.2f}",
            }
            for row in sorted(drifts, key=lambda row: str(row["base_frame"]))
        ],
    )


def _statistics(corrections: np.ndarray, deviations: np.ndarray) -> dict[str, float | int | None]:
    sizes = np.abs(corrections)
    return {
        "frames": len(corrections),
        "mean": float(corrections.mean()),
        "deviation": float(corrections.std()),
        "median_size": float(np.median(sizes)),
        "largest_size": float(sizes.max()),
        "median_reported": float(np.median(deviations)) if len(deviations) else None,
    }


def _joint_table(statistics: Mapping[str, Mapping[str, float | int | None]]) -> Table | None:
    headings = {
        "mean": "mean",
        "deviation": "standard deviation",
        "median_size": "median absolute value",
        "largest_size": "largest absolute value",
        "median_reported": "median reported standard deviation",
    }
    rows = []
    for name, found in statistics.items():
        texts = {key: "–" if (number := found[key]) is None else f"{number:.3f}" for key in headings}
        rows.append(
            {"joint": name, "frames": str(found["frames"]), **{headings[key]: text for key, text in texts.items()}}
        )
    caption = "Corrected minus measured, over the frames of all jobs; degrees, or millimetres for prismatic joints."
    return Table.of("Error of measured joints", caption, rows)


def _cost_table(cost: Cost) -> Table | None:
    hours = "–" if cost.core_hours is None else f"{cost.core_hours:.3g}"
    estimated = "" if cost.all_core_hours is None or not cost.waiting else f" ({cost.all_core_hours:.3g} for all jobs)"
    caption = (
        f"{counted(cost.frames, 'frame')} of {counted(len(cost.done), 'finished job')}, {hours} core hours{estimated}. "
        "Estimates assume that the other jobs take as long as the finished jobs on average, and that the speed of a "
        "worker does not depend on the number of workers."
    )

    def duration(seconds: float | int | None) -> str:
        return "–" if seconds is None else duration_text(seconds)

    return Table.of(
        "Time for other numbers of workers",
        caption,
        [
            {
                "workers": str(row["workers"]),
                "frames/s": "–" if (rate := row["frames_per_second"]) is None else f"{rate:.3g}",
                "all jobs": duration(row["all_seconds"]),
                "remaining jobs": duration(row["remaining_seconds"]),
            }
            for row in cost.estimates()
        ],
    )


class Box(NamedTuple):
    """Box of a plot, from its top to its bottom; whiskers are at most 1.5 interquartile ranges long, and end at a
    value."""

    upper_whisker: float
    upper_quartile: float
    median: float
    lower_quartile: float
    lower_whisker: float


@dataclass(frozen=True)
class BoxPlot:
    """Box plot of the corrections of each joint, drawn by the page's template.

    Its values are heights relative to the plot, from 0 at its top to 1 at its bottom.
    """

    boxes: dict[str, Box]
    """Joint -> its box."""
    ticks: list[tuple[str, float]]
    """Labels [deg, mm] and heights of the axis."""

    @staticmethod
    def of(boxes: Mapping[str, Box]) -> "BoxPlot":
        """Plot of the boxes of all joints [deg, mm]."""
        lowest, highest = min(0.0, *(box[-1] for box in boxes.values())), max(0.0, *(box[0] for box in boxes.values()))
        size = max(highest - lowest, 1e-6)
        rough = size / _TICKS
        step = next(
            step for step in (unit * 10.0 ** np.floor(np.log10(rough)) for unit in (1, 2, 5, 10)) if step >= rough
        )
        top = highest + 0.05 * size
        marks = step * np.arange(np.ceil(lowest / step), np.floor(highest / step) + 1)

        def height(value: float) -> float:
            return round((top - value) / (1.1 * size), 4)

        digits = max(0, -int(np.floor(np.log10(step))))
        return BoxPlot(
            {name: Box(*map(height, box)) for name, box in boxes.items()},
            [(f"{mark + 0.0:.{digits}f}", height(mark)) for mark in marks],
        )


def _box(values: np.ndarray) -> Box:
    lower, median, upper = np.percentile(values, (25, 50, 75))
    reach = 1.5 * (upper - lower)
    top, bottom = values[values <= upper + reach].max(), values[values >= lower - reach].min()
    return Box(float(max(top, upper)), float(upper), float(median), float(lower), float(min(bottom, lower)))
