"""Report on all jobs as an HTML page with plots and the worst frames, and as JSON."""

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ..errors import CartsError
from ..evaluation.calibration import pose_distance
from ..files import OutputPath, output_stream, write_bytes, write_text
from ..files.reading import IMAGE, read_bytes
from ..html import Table, render_page
from .folder import ORDER, JointErrors, KnownJob, known_jobs, most_urgent_first
from .manifest import Job

matplotlib.use("Agg")
matplotlib.rcParams["text.parse_math"] = False

_SHOWN = 24
"""Maximum number of worst frames on the page."""
_VERDICTS = ("good", "doubtful", "failed")


def write_batch_report(batch: OutputPath, title: str, jobs: Sequence[Job]) -> Path:
    """Write `report/report.html`, `report/report.json` and images; returns the page's path."""
    joints: JointErrors = {}
    folder, known = batch / "report", known_jobs(batch, jobs, joints=joints)
    drifts = _drifts(known)
    page = render_page(
        "batch.html",
        title=title,
        sections={
            "Jobs": _job_table(known),
            "Verdicts": _verdict_table(known),
            "Worst frames": _worst(batch, folder, known),
            "Base frames": _drift_table(drifts),
            "Joints": _joint_table(joints),
        },
        plot=_joint_figure(folder, joints),
    )
    document = {
        "format": "carts-batch-report/1",
        "jobs": {entry.job.name: {"status": entry.status, "error": entry.state.error} for entry in known},
        "verdicts": {entry.job.name: _verdicts(entry) for entry in known},
        "base_frames": drifts,
        "joints": {name: _statistics(*values) for name, values in joints.items()},
    }
    write_text(folder / "report.json", json.dumps(document, indent=1))
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
    counts = Counter(frame.verdict for frame in (entry.findings.frames if entry.findings else ()))
    return {verdict: counts[verdict] for verdict in _VERDICTS}


def _verdict_table(known: Sequence[KnownJob]) -> Table | None:
    """Table of verdicts, sorted by the share of failed frames."""
    rows = [(entry.job.name, counts) for entry in known if sum((counts := _verdicts(entry)).values())]
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
    frames = [
        (entry.job, frame)
        for entry in known
        for frame in (entry.findings.frames if entry.findings else ())
        if frame.picture
    ]
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
    found, before = [], {}
    for entry in known:
        for name, rows in (entry.findings.base_frames if entry.findings else {}).items():
            present = np.array(rows)
            angle, distance = pose_distance(before.get(name, present), present)
            found.append({"base_frame": name, "job": entry.job.name, "rotation_deg": angle, "translation_mm": distance})
            before[name] = present
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


def _statistics(corrections: Sequence[float], deviations: Sequence[float]) -> dict[str, float | int | None]:
    values = np.asarray(corrections)
    return {
        "frames": len(values),
        "mean": float(values.mean()),
        "deviation": float(values.std()),
        "median_size": float(np.median(np.abs(values))),
        "largest_size": float(np.abs(values).max()),
        "median_reported": float(np.median(deviations)) if len(deviations) else None,
    }


def _joint_table(joints: JointErrors) -> Table | None:
    headings = {
        "mean": "mean",
        "deviation": "standard deviation",
        "median_size": "median absolute value",
        "largest_size": "largest absolute value",
        "median_reported": "median reported standard deviation",
    }
    rows = []
    for name, values in joints.items():
        found = _statistics(*values)
        texts = {key: "–" if (number := found[key]) is None else f"{number:.3f}" for key in headings}
        rows.append(
            {"joint": name, "frames": str(found["frames"]), **{headings[key]: text for key, text in texts.items()}}
        )
    caption = "Corrected minus measured, over the frames of all jobs; degrees, or millimetres for prismatic joints."
    return Table.of("Error of measured joints", caption, rows)


def _joint_figure(folder: OutputPath, joints: JointErrors) -> tuple[str, str] | None:
    """Draw the plot of corrections and standard deviations; returns its caption and file."""
    if not joints:
        return None
    figure = Figure(figsize=(max(5.0, 1.5 + 0.5 * len(joints)), 5.0), layout="constrained")
    axes = figure.subplots()
    axes.boxplot([corrections for corrections, _ in joints.values()], widths=0.6, showfliers=False)
    axes.set_xticks(range(1, len(joints) + 1), list(joints), fontsize=8, rotation=90)
    axes.axhline(0.0, color="gray", linewidth=0.8)
    axes.set_ylabel("corrected minus measured [deg, mm]")
    axes.grid(axis="y", alpha=0.3)
    with output_stream(folder / "joints.png") as stream:
        figure.savefig(stream, format="png", dpi=110)
    return "Corrections of each joint: median, quartiles, and whiskers at 1.5 interquartile ranges.", "joints.png"
