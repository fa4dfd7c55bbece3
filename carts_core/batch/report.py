"""Report over all jobs as an HTML page with plots and the worst frames, and as JSON."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path, PurePath
from string import Template

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ..errors import CartsError
from ..evaluation.calibration import pose_distance
from ..files import OutputPath, output_stream, write_bytes, write_text
from ..files.reading import IMAGE, read_bytes
from ..html import STYLE, Cell, Table, anchor, figure_html, section_html, table_html
from .folder import ORDER, FrameFinding, KnownJob, known_jobs, most_urgent_first
from .manifest import Job

matplotlib.use("Agg")
matplotlib.rcParams["text.parse_math"] = False

_SHOWN = 24
"""Number of worst frames on the page."""
_PAGE = Template("""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title><style>$style
.gallery { display: grid; grid-template-columns: repeat(auto-fill, minmax(20rem, 1fr)); gap: 1rem; }
.gallery figure { margin: 0; }
</style></head><body><h1>$title</h1><nav>$contents</nav>$sections</body></html>
""")
_VERDICTS = ("good", "doubtful", "failed")


def write_batch_report(batch: OutputPath, title: str, jobs: Sequence[Job]) -> Path:
    """Write `report/report.html`, `report/report.json` and the pictures; returns the page's path.

    Args:
        batch: its folder.
        title: of the page.
        jobs: all of the manifest.
    """
    folder, known = batch / "report", known_jobs(batch, jobs)
    drifts, joints = _drifts(known), _joints(known)
    sections = {
        "Jobs": table_html(_job_table(known)),
        "Verdicts": table_html(_verdict_table(known)),
        "Worst frames": _worst(batch, folder, known),
        "Base frames": table_html(_drift_table(drifts)),
        "Joints": table_html(_joint_table(joints)) + _joint_figure(folder, joints),
    }
    contents = " ".join(f'<a href="#{anchor(name)}">{escape(name)}</a>' for name in sections)
    body = "".join(section_html(name, html) for name, html in sections.items())
    page = _PAGE.substitute(title=escape(title), style=STYLE, contents=contents, sections=body)
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


def _job_table(known: Sequence[KnownJob]) -> Table:
    """Table of jobs, most urgent first."""
    counts = Counter(entry.status for entry in known)
    return Table(
        "Status of the jobs",
        ", ".join(f"{counts[status]} {status}" for status in ORDER if counts[status]),
        ("job", "recording", "status", "seconds", "error"),
        tuple(
            (
                Cell(entry.job.name),
                Cell(str(entry.job.recording)),
                Cell(entry.status),
                Cell(f"{sum(step.seconds for step in entry.state.steps.values()):.1f}"),
                Cell(entry.error),
            )
            for entry in most_urgent_first(known)
        ),
    )


def _verdicts(entry: KnownJob) -> dict[str, int]:
    counts = Counter(frame.verdict for frame in (entry.findings.frames if entry.findings else ()))
    return {verdict: counts[verdict] for verdict in _VERDICTS}


def _verdict_table(known: Sequence[KnownJob]) -> Table:
    """Table of verdicts, sorted by the share of failed frames."""
    counted = [(entry, _verdicts(entry)) for entry in known]
    rows = [(entry.job.name, counts) for entry, counts in counted if sum(counts.values())]
    rows.sort(key=lambda row: (-row[1]["failed"] / sum(row[1].values()), -row[1]["doubtful"] / sum(row[1].values())))
    total = {verdict: sum(counts[verdict] for _, counts in rows) for verdict in _VERDICTS}
    lines = [*([("all jobs", total)] if rows else []), *rows]
    return Table(
        "Reliability of the results",
        "Frames by verdict, from their images alone, without ground truth.",
        ("job", *_VERDICTS, "frames"),
        tuple(
            (Cell(name), *(Cell(str(counts[verdict])) for verdict in _VERDICTS), Cell(str(sum(counts.values()))))
            for name, counts in lines
        ),
    )


def _worst(batch: OutputPath, folder: OutputPath, known: Sequence[KnownJob]) -> str:
    """Gallery of the frames with the largest probability of a wrong mask; pictures are copied into the report."""
    frames: list[tuple[Job, FrameFinding]] = [
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
        shown.append(figure_html(caption, PurePath(name)))
    text = "<p>The outline of each mask over its image, the most doubtful frames of all jobs first.</p>"
    return text + f'<div class="gallery">{"".join(shown)}</div>' if shown else "<p>No frame has a verdict.</p>"


def _drifts(known: Sequence[KnownJob]) -> list[dict[str, object]]:
    """Change of each base frame since the job before, in the manifest's order."""
    found, before = [], {}
    for entry in known:
        for name, rows in (entry.findings.base_frames if entry.findings else {}).items():
            present = np.array(rows)
            angle, distance = pose_distance(before.get(name, present), present)
            found.append({"base_frame": name, "job": entry.job.name, "rotation_deg": angle, "translation_mm": distance})
            before[name] = present
    return found


def _drift_table(drifts: list[dict[str, object]]) -> Table:
    return Table(
        "Drift of base frames",
        "Change of each arm's base frame in a camera since the job before, in the manifest's order.",
        ("base frame", "job", "turned [deg]", "moved [mm]"),
        tuple(
            (
                Cell(str(row["base_frame"])),
                Cell(str(row["job"])),
                Cell(f"{row['rotation_deg']:.3f}"),
                Cell(f"{row['translation_mm']:.2f}"),
            )
            for row in sorted(drifts, key=lambda row: str(row["base_frame"]))
        ),
    )


_Values = tuple[list[float], list[float]]
"""Corrections and reported deviations of a joint [deg, mm]."""


def _joints(known: Sequence[KnownJob]) -> dict[str, _Values]:
    found: dict[str, _Values] = {}
    for entry in known:
        if entry.findings is not None:
            for name, values in entry.findings.corrections.items():
                corrections, deviations = found.setdefault(name, ([], []))
                corrections += values
                deviations += entry.findings.deviations.get(name, [])
    return found


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


def _joint_table(joints: Mapping[str, _Values]) -> Table:
    rows = []
    for name, values in joints.items():
        found = _statistics(*values)
        numbers = [found[key] for key in ("mean", "deviation", "median_size", "largest_size", "median_reported")]
        texts = ["–" if number is None else f"{number:.3f}" for number in numbers]
        rows.append((Cell(name), Cell(str(found["frames"])), *map(Cell, texts)))
    return Table(
        "Error of measured joints",
        "Corrected minus measured, over the frames of all jobs; degrees, or millimetres for prismatic joints.",
        ("joint", "frames", "mean", "deviation", "median size", "largest", "median reported deviation"),
        tuple(rows),
    )


def _joint_figure(folder: OutputPath, joints: Mapping[str, _Values]) -> str:
    if not joints:
        return ""
    figure = Figure(figsize=(max(5.0, 1.5 + 0.5 * len(joints)), 5.0), layout="constrained")
    axes = figure.subplots()
    axes.boxplot([corrections for corrections, _ in joints.values()], widths=0.6, showfliers=False)
    axes.set_xticks(range(1, len(joints) + 1), list(joints), fontsize=8, rotation=90)
    axes.axhline(0.0, color="gray", linewidth=0.8)
    axes.set_ylabel("corrected minus measured [deg, mm]")
    axes.grid(axis="y", alpha=0.3)
    with output_stream(folder / "joints.png") as stream:
        figure.savefig(stream, format="png", dpi=110)
    caption = "Corrections of each joint: median, quartiles, and 1.5 times their distance."
    return figure_html(caption, PurePath("joints.png"))
